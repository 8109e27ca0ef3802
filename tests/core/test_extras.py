"""Optional packages: missing, broken, interrupted, and what pip is asked for."""

from __future__ import annotations

import sys

import pytest

from smplxpp.core.errors import MissingExtraError, requirements_of_extra
from smplxpp.core.lazy import import_extra


def test_an_extra_names_the_packages_that_it_installs():
    (video,) = requirements_of_extra("video")
    assert video.startswith("imageio-ffmpeg>=")
    # One that consists of others has theirs, each once.
    names = [one.split(">")[0] for one in requirements_of_extra("chat")]
    assert {"imageio-ffmpeg", "onnxruntime", "websockets"} <= set(names) and len(set(names)) == len(names)
    assert requirements_of_extra("nothing") == []


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, r"needs some-package, which is not installed: pip install 'imageio-ffmpeg>=.*' \(extra video\)"),
        ("import another_that_is_not_there", "installed and does not start: No module named 'another_that"),
        ("raise ImportError('lib.so: wrong ELF class')", "installed and does not start: lib.so: wrong ELF class"),
    ],
)
def test_missing_and_broken_packages_are_told_apart(tmp_path, monkeypatch, content, words):
    if content is not None:
        (tmp_path / "some_package.py").write_text(content)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingExtraError, match=words):
        import_extra("some_package", extra="video", purpose="a test", named="some-package")
    assert "some_package" not in sys.modules


def test_an_interrupt_stays_one(tmp_path, monkeypatch):
    (tmp_path / "slow_package.py").write_text("raise KeyboardInterrupt")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        import_extra("slow_package", extra="video", purpose="a test")
