"""Radiance pictures: read as they were written, flat and packed, and refused where they are something else."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.core.errors import InputError
from smplxpp.core.files.panorama_file import read_radiance
from tests.core.files.radiance import write_radiance


def picture(height: int = 12, width: int = 300) -> np.ndarray:
    """Five decades of light, a dark band and even stretches, which make runs."""
    light = 10.0 ** np.random.default_rng(0).uniform(-3.0, 2.0, (height, width, 3))
    light[3], light[4, 20:290] = 0.0, 7.0
    return light


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("width", [5, 300])  # narrow rows are never packed
def test_light_comes_back(tmp_path, packed, width):
    light = picture(width=width)
    write_radiance(tmp_path / "a.hdr", light, packed=packed and width >= 8)
    read = read_radiance(tmp_path / "a.hdr")
    assert read.shape == light.shape and read.dtype == np.float32
    # Eight bits, cut off, of the brightest channel.
    assert (read <= light + 1e-6).all() and (light - read <= light.max(axis=2, keepdims=True) / 127.0).all()
    assert not read[3].any()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data.replace(b"#?RADIANCE", b"#?SOMETHING"), "another kind"),
        (lambda data: data.replace(b"_rgbe", b"_xyze"), "xyze"),
        (lambda data: data.replace(b"-Y 12", b"+Y 12"), "-Y height"),
        (lambda data: data.replace(b"-Y 12 +X 300", b"-Y 99999 +X 99999"), "pixels"),
        (lambda data: data[: len(data) // 2], "rows"),
        (lambda data: data.replace(b"\x02\x02\x01\x2c", b"\x02\x02\x01\x2b"), "damaged"),
    ],
)
def test_others_are_refused(tmp_path, change, words):
    write_radiance(tmp_path / "a.hdr", picture(), packed=True)
    (tmp_path / "a.hdr").write_bytes(change((tmp_path / "a.hdr").read_bytes()))
    with pytest.raises(InputError, match=words):
        read_radiance(tmp_path / "a.hdr")
    with pytest.raises(InputError, match="existing file"):
        read_radiance(tmp_path / "none.hdr")
