"""`smplxpp talk`: what is refused before work starts, and a film with sound."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pipelines.commands.talk import Talk
from smplxpp.core.errors import InputError
from smplxpp.core.files.sound_file import Sound
from smplxpp.figures.film import write_film


@pytest.mark.parametrize(
    ("out", "options", "word"),
    [
        ("a.gif", {"text": "hello"}, "output"),
        ("a.mp4", {}, "--text"),
        ("a.mp4", {"text": " "}, "text"),
        ("a.mp4", {"audio": Path("a.wav"), "voice": Path("v.onnx")}, "voice"),
        ("a.npz", {"text": "hello", "sound_out": Path("a.mp3")}, "wav"),
        ("a.npz", {"text": "hello", "device": "cuda"}, "device"),
        ("a.npz", {"text": "hello"}, "run nowhere"),
        ("a.mp4", {"text": "hello", "height": 2}, "height"),
        (None, {"text": "hello"}, "--web"),
        (None, {"text": "hello", "web": Path("page.txt")}, "html"),
        (None, {"text": "hello", "web": Path("page.html")}, "run nowhere"),
    ],
)
def test_what_cannot_be_is_refused_at_once(tmp_path, out, options, word):
    with pytest.raises(InputError, match=word):
        Talk(Path("nowhere"), out and tmp_path / out, **options).run()
    assert not list(tmp_path.iterdir())


def test_a_film_has_its_sound(tmp_path):
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="the extra video writes films").get_ffmpeg_exe()
    frames = [np.full((32, 32, 3), 8 * k, np.uint8) for k in range(20)]
    tone = Sound(np.sin(np.arange(22050 // 2) * 0.1).astype(np.float32), 22050)
    write_film(tmp_path / "a.mp4", frames, fps=20.0, size=(32, 32), sound=tone)
    told = subprocess.run([ffmpeg, "-i", str(tmp_path / "a.mp4")], capture_output=True, text=True, check=False).stderr
    assert re.search(r"Audio: aac.*22050 Hz", told) and "Video: h264" in told
    with pytest.raises(InputError, match="mp4"):
        write_film(tmp_path / "a.gif", frames, fps=20.0, size=(32, 32), sound=tone)
