"""Traits of files that others write, for sets whose usual folders tests/capture/test_readers.py reads."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.capture import find_problems, open_capture
from tests.capture.scene import make_scene
from tests.capture.writers import (
    write_actorshq,
    write_avatarrex,
    write_easymocap,
)

LENS = (0.02, -0.01, 0.001, -0.001, 0.0)


@pytest.mark.parametrize("place", ["beside the calibration", "beside the scales"])
def test_actorshq_fits_lie_beside_the_calibration_or_the_scales(tmp_path, place):
    root = write_actorshq(make_scene(), tmp_path / "set")
    if place == "beside the calibration":
        (root / "smpl_params.npz").rename(root / "4x" / "smpl_params.npz")
    for folder in (root, root / "4x"):
        assert open_capture(folder).params(1) is not None
        assert find_problems(open_capture(folder), decode=False) == []


def test_easymocap_leaves_out_a_camera_called_none(tmp_path):
    """As its FileStorage does, which once wrote the brackets of a list under this name."""
    root = write_easymocap(make_scene(lens=LENS), tmp_path / "set")
    path = root / "intri.yml"
    path.write_bytes(path.read_bytes().replace(b"names:\r\n", b'names:\r\n  - "none"\r\n'))
    capture = open_capture(root)
    assert list(capture.cameras) == ["A", "B", "C"]
    problems = find_problems(capture, decode=False)
    assert [problem.message for problem in problems] == ["camera none: left out, as EasyMocap itself does"]
    assert len(capture.without(problems).views()) == 6


def test_stacked_v_shape_follows_the_rows(tmp_path):
    """A row a frame, one of them not finite, and one row for all."""
    root = write_avatarrex(make_scene(), tmp_path / "set")
    with np.load(root / "smpl_params.npz") as file:
        arrays = dict(file)
    offsets = np.random.default_rng(0).normal(size=(2, 50, 3)).astype(np.float32)
    np.savez(root / "smpl_params.npz", **arrays, v_shape=offsets)
    np.testing.assert_array_equal(open_capture(root).params(1).v_shape, offsets[1:])
    spoiled = arrays | {"transl": arrays["transl"] * [[np.nan], [1.0]]}
    np.savez(root / "smpl_params.npz", **spoiled, v_shape=offsets)
    np.testing.assert_array_equal(open_capture(root).params(1).v_shape, offsets[1:])
    np.savez(root / "smpl_params.npz", **spoiled, v_shape=offsets[0])
    np.testing.assert_array_equal(open_capture(root).params(1).v_shape, offsets[:1])
