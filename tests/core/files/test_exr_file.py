"""OpenEXR pictures: read as they were written, and refused where they are something else."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.panorama_file import read_panorama
from tests.core.files.openexr import write_openexr
from tests.core.files.radiance import write_radiance

LIGHT = 10.0 ** np.random.default_rng(0).uniform(-3.0, 3.0, (12, 31, 3))


@pytest.mark.parametrize(("kind", "steps"), [("zip", 1.0 / 1024), ("piz", 1e-6)])
def test_light_comes_back(tmp_path, kind, steps):
    write_openexr(tmp_path / "a.exr", LIGHT, kind=kind)
    read = read_panorama(tmp_path / "a.exr")
    assert read.dtype == np.float32
    np.testing.assert_allclose(read, LIGHT, rtol=steps)


def test_luminance_alone_and_channels_beside_the_colours(tmp_path):
    write_openexr(tmp_path / "y.exr", LIGHT[..., :1], kind="piz", channels="Y")
    np.testing.assert_allclose(read_panorama(tmp_path / "y.exr"), np.repeat(LIGHT[..., :1], 3, axis=2), rtol=1e-6)
    more = np.concatenate([LIGHT, np.ones((12, 31, 1))], axis=2)
    write_openexr(tmp_path / "a.exr", more, kind="piz", channels="RGBA")
    np.testing.assert_allclose(read_panorama(tmp_path / "a.exr"), LIGHT, rtol=1e-6)


def test_what_a_file_is_its_bytes_say_not_its_name(tmp_path):
    write_openexr(tmp_path / "a.hdr", LIGHT, kind="piz")
    write_radiance(tmp_path / "b.exr", LIGHT)
    np.testing.assert_allclose(read_panorama(tmp_path / "a.hdr"), LIGHT, rtol=1e-6)
    assert read_panorama(tmp_path / "b.exr").shape == LIGHT.shape


def test_others_are_refused(tmp_path):
    path = tmp_path / "a.exr"
    window = (np.array([0, 0], np.int32), np.array([60, 60], np.int32))
    for write, words in (
        (lambda: write_openexr(path, LIGHT[..., :2], channels="RG"), "channels"),
        (lambda: write_openexr(path, LIGHT, header={"displayWindow": window}), "part of the picture"),
        (lambda: path.write_bytes(b"\x76\x2f\x31\x01" + bytes(200)), "damaged"),
    ):
        write()
        with pytest.raises(InputError, match=words):
            read_panorama(path)
    write_openexr(path, LIGHT)
    path.write_bytes(path.read_bytes()[:600])
    with pytest.raises(InputError, match="light"):
        read_panorama(path)
    with pytest.raises(InputError, match="existing file"):
        read_panorama(tmp_path / "none.exr")


def test_without_the_library_the_extra_is_named(tmp_path, monkeypatch):
    write_openexr(tmp_path / "a.exr", LIGHT)
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(MissingExtraError, match=r"extra exr"):
        read_panorama(tmp_path / "a.exr")
