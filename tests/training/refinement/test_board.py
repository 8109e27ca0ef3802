"""A refinement in chunks of frames that processes share: the bits of one, whoever computes what and is killed."""

from __future__ import annotations

import errno
import os
import threading
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avatar.training.refinement import board as module
from avatar.training.refinement.board import Board, OvertakenError, RefinementStoppedError
from avatar.training.refinement.config import Level
from avatar.training.refinement.refine import Refinement, refine_poses
from tests.dolls.gesturing import disturbed, gestures, sequence, write_gestures
from tests.training.refinement.test_refine import QUICK

CHUNKS = replace(QUICK, levels=(Level(1, 1), Level(1, 1)), chunk_frames=2, cameras=True)


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    capture = write_gestures(tmp_path_factory.mktemp("captures") / "gestures")
    return sequence(capture, disturbed(gestures()), tmp_path_factory.mktemp("start"))


@pytest.fixture(scope="module")
def alone(frames, tmp_path_factory) -> Refinement:
    """Three chunks of five frames, by one process."""
    return refine_poses(frames, CHUNKS, state=tmp_path_factory.mktemp("alone") / "state.npz")


def assert_same(one: Refinement, other: Refinement) -> None:
    for name, array in one.params.as_dict().items():
        np.testing.assert_array_equal(array, other.params.as_dict()[name])
    np.testing.assert_array_equal(one.after, other.after)
    np.testing.assert_array_equal(one.gaussians.dc, other.gaussians.dc)
    for name, pose in one.cameras.items():
        np.testing.assert_array_equal(pose, other.cameras[name])
    assert one.history == other.history


@pytest.mark.long
def test_chunks_are_the_whole_but_for_the_order_of_sums(frames, alone):
    whole = refine_poses(frames, replace(CHUNKS, chunk_frames=200))
    apart = 1e3 * np.abs(whole.params.transl - alone.params.transl).max()
    assert apart < 1e-3 and np.abs(whole.params.full_pose - alone.params.full_pose).max() < 1e-5  # mm, radians
    assert_same(refine_poses(frames, CHUNKS), alone)  # also without a state


@pytest.mark.long
def test_processes_that_share_a_folder_get_the_bits_of_one(frames, alone, tmp_path):
    found: list[Refinement] = []
    threads = [
        threading.Thread(target=lambda: found.append(refine_poses(frames, CHUNKS, state=tmp_path / "state.npz")))
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 3
    for one in found:
        assert_same(one, alone)
    # One that comes when all is over has nothing left to compute.
    assert_same(refine_poses(frames, CHUNKS, state=tmp_path / "state.npz"), alone)


@pytest.mark.long
def test_processes_that_stop_after_every_chunk_come_to_the_same_bits(frames, alone, tmp_path):
    found, stops, shares = None, 0, []
    while found is None:
        with suppress(RefinementStoppedError):
            found = refine_poses(
                frames,
                CHUNKS,
                state=tmp_path / "state.npz",
                stop=lambda: True,
                progress=lambda step, share: shares.append(share),
            )
        stops += found is None
    # The reference frame, three chunks in each of four passes, and of the losses of start and result.
    assert stops >= 12 and shares[-1] == 1.0
    assert_same(found, alone)


def test_a_chunk_of_a_process_that_died_is_computed_again(tmp_path, monkeypatch):
    board, made = Board(tmp_path), []

    def compute(chunk: int) -> dict[str, np.ndarray]:
        made.append(chunk)
        return {"value": np.array(float(chunk))}

    monkeypatch.setattr(Board, "_who", property(lambda self: f"{module.platform.node()} 999999999"))
    assert board._claim(tmp_path / "pass_0000.npz")
    monkeypatch.undo()
    assert [float(part["value"]) for part in board.gather("pass", 2, compute)] == [0.0, 1.0] and made == [0, 1]
    # On another machine it is believed for ten minutes after its last frame.
    claim = tmp_path / "next_0000.claim"
    claim.write_text("elsewhere 1")
    waiting = Board(tmp_path, stop=lambda: True)
    with pytest.raises(RefinementStoppedError):
        waiting.gather("next", 1, compute)
    os.utime(claim, (time.time() - 700.0,) * 2)
    assert len(board.gather("next", 1, compute)) == 1
    # What is over is told, and not computed again.
    board.end("next")
    with pytest.raises(OvertakenError):
        board.gather("next", 1, compute)


def test_a_disk_that_takes_no_claim_ends_the_work_and_makes_nobody_wait(tmp_path, monkeypatch):
    def full(self, **options):
        raise OSError(errno.ENOSPC, "no space left on device")

    board = Board(tmp_path)
    monkeypatch.setattr(Path, "touch", full)
    with pytest.raises(OSError, match="no space"):
        board.gather("pass_00", 1, lambda chunk: {"sum": np.zeros(1)})
