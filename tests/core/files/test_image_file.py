import os
import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from smplxpp.core.errors import InputError
from smplxpp.core.files.image_file import image_mode, image_size, open_image


def png_of_size(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp", "tif", "bmp"])
def test_formats_of_captures_are_read(tmp_path, suffix):
    pixels = np.full((5, 7, 3), 90, np.uint8)
    Image.fromarray(pixels).save(tmp_path / f"x.{suffix}")
    path = tmp_path / f"x.{suffix}"
    assert image_size(path) == (7, 5) and image_mode(path) == "RGB"
    assert np.abs(np.asarray(open_image(path)).astype(int) - pixels).max() < 8


def test_too_many_pixels_are_refused_before_they_are_made(tmp_path):
    (tmp_path / "x.png").write_bytes(png_of_size(60_000, 60_000))
    for read in (open_image, image_size):
        with pytest.raises(InputError, match="pixels"):
            read(tmp_path / "x.png")


def test_formats_that_run_programs_are_not_known(tmp_path):
    (tmp_path / "x.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\nshowpage\n")
    with pytest.raises(InputError, match="whole image"):
        open_image(tmp_path / "x.png")


def test_a_pipe_does_not_hang(tmp_path):
    os.mkfifo(tmp_path / "x.png")
    with pytest.raises(InputError, match="pipe"):
        open_image(tmp_path / "x.png")


@settings(deadline=None)
@given(st.data())
def test_a_damaged_image_is_an_image_or_an_input_error(tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp()
    suffix = data.draw(st.sampled_from(["png", "jpg", "webp", "tif", "bmp"]))
    path = folder / f"damaged.{suffix}"
    Image.fromarray(np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3)).save(path)
    raw = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(raw[: data.draw(st.integers(1, len(raw)))]))
    try:
        open_image(path)
    except InputError as error:
        assert "damaged" in str(error)
