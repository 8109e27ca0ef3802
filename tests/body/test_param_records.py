"""Files with a row a frame number, in which rows of frames that were not registered hold NaN."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_params
from smplxpp.build.register import stacked_rows
from smplxpp.core import BodyParams, GeometryWarning, InputError


def params(frames: int) -> BodyParams:
    pose = np.zeros((frames, 55, 3))
    pose[:, 16, 2] = np.linspace(0.0, 1.2, frames)
    pose[:, 0, 1] = np.linspace(3.0, 3.4, frames)  # past half a turn, where rotation vectors change sign
    still = {"betas": np.full((1, 10), 0.3), "expression": np.zeros((1, 10))}
    return BodyParams.from_full_pose(pose, transl=np.linspace([0.0, 1, 0], [0.4, 1, 0], frames), fps=30.0, **still)


def test_what_register_writes_for_every_second_frame_is_a_motion(tmp_path):
    """Rows of NaN between the registered frames were refused by the commands that read motions."""
    true = params(5)
    rows = stacked_rows((2, 4, 6), true.select([0, 2, 4]))
    path = tmp_path / "params.npz"
    np.savez(path, **rows)
    with pytest.warns(GeometryWarning, match=r"4 of 7 frames hold nothing \(0, 1, 3, 5\)"):
        read = load_params(path)
    assert len(read) == 7 and read.fps == 30.0
    # Frames 2 to 6 are those of the true motion, also between; those before the first repeat it.
    np.testing.assert_allclose(read.transl[2:], true.transl, atol=1e-12)
    turn = read.full_pose[2:, 16, 2] - true.full_pose[:, 16, 2]
    np.testing.assert_allclose(turn, 0.0, atol=1e-9)
    spin = np.exp(1j * read.full_pose[2:, 0, 1]) - np.exp(1j * true.full_pose[:, 0, 1])
    np.testing.assert_allclose(np.abs(spin), 0.0, atol=1e-9)
    np.testing.assert_allclose(read.full_pose[:2], np.stack([read.full_pose[2]] * 2), atol=1e-9)
    np.testing.assert_allclose(read.betas, 0.3)


def test_a_frame_with_some_numbers_missing_is_still_refused(tmp_path):
    rows = stacked_rows((0, 1, 2), params(3))
    rows["body_pose"][1, 5] = np.nan
    np.savez(tmp_path / "params.npz", **rows)
    with pytest.raises(InputError, match="finite"):
        load_params(tmp_path / "params.npz")
