"""Files and folders that appear whole or not at all: what the system's errors name."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from smplxpp.core.files import atomic
from smplxpp.core.files.atomic import atomic_folder, atomic_path, atomic_write_bytes
from tests.full_disk import file_size_limit


def test_an_error_names_the_file_that_was_wanted_and_leaves_the_old(tmp_path):
    path = tmp_path / "result.bin"
    path.write_bytes(b"old")
    with file_size_limit(1000), pytest.raises(OSError) as caught:
        atomic_write_bytes(path, b"x" * 5000)
    assert (caught.value.errno, caught.value.filename) == (errno.EFBIG, str(path))
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["result.bin"]


def test_a_file_in_a_folder_is_named_where_it_would_have_been(tmp_path):
    with file_size_limit(1000), pytest.raises(OSError) as caught, atomic_folder(tmp_path / "stage") as folder:
        atomic_write_bytes(folder / "weights.npz", b"x" * 5000)
    assert caught.value.filename == str(tmp_path / "stage" / "weights.npz") and os.listdir(tmp_path) == []


def test_a_name_that_is_too_long_is_the_wanted_one(tmp_path):
    path = tmp_path / f"{'n' * 250}.npz"
    with pytest.raises(OSError) as caught:
        atomic_write_bytes(path, b"")
    assert caught.value.filename == str(path)


def test_errors_about_other_files_keep_their_names(tmp_path):
    with pytest.raises(FileNotFoundError) as caught, atomic_path(tmp_path / "a"):
        (tmp_path / "other").read_bytes()
    assert caught.value.filename == str(tmp_path / "other")
    with pytest.raises(OSError) as nameless, atomic_path(tmp_path / "a"):
        raise OSError(errno.ECONNRESET, "reset")
    assert nameless.value.filename is None


_KILLED = """
import os, signal, sys
from smplxpp.core.files import atomic
from smplxpp.core.files.atomic import atomic_folder, atomic_path
with atomic_path(sys.argv[1]) as file, atomic_folder(sys.argv[2]) as folder:
    file.write_bytes(b"half"), (folder / "x").write_bytes(b"half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_process_left_is_removed_by_the_next_and_nothing_else(tmp_path):
    """A film's `.name.xxxxxxxx.mp4` stayed beside the output for ever."""
    film, folder = tmp_path / "film.mp4", tmp_path / "frames"
    done = subprocess.run([sys.executable, "-c", _KILLED, film, folder], timeout=900, check=False)
    left = sorted(os.listdir(tmp_path))
    assert done.returncode == -signal.SIGKILL and [name.split(".")[1] for name in left] == ["film", "frames"]
    (tmp_path / ".film.mp4").write_bytes(b"mine")
    atomic._hidden_names.cache_clear()
    # A writer of the same file that runs holds its own; names that are not such are the user's.
    with atomic_path(film) as first:
        assert not (tmp_path / left[0]).exists()
        atomic._hidden_names.cache_clear()
        atomic_write_bytes(film, b"other")
        assert first.exists()
    with atomic_folder(folder):
        pass
    assert sorted(os.listdir(tmp_path)) == [".film.mp4", "film.mp4", "frames"]


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_where_no_locks_are_nothing_is_open_when_it_is_moved(tmp_path, monkeypatch, kind):
    """Windows refuses to move what is open, and opens no folders."""
    moved = []

    def move(source, target, move=os.replace):
        if Path(source).name.startswith("."):
            held = {os.path.realpath(f"/proc/self/fd/{n}") for n in os.listdir("/proc/self/fd")}
            assert str(source) not in held
            moved.append(Path(target))
        move(source, target)

    monkeypatch.setattr(atomic, "fcntl", None)
    monkeypatch.setattr(os, "replace", move)
    path = tmp_path / "wanted"
    for text in ("first", "second"):
        if kind == "file":
            atomic.atomic_write_text(path, text)
        else:
            with atomic.atomic_folder(path) as folder:
                (folder / "inner").write_text(text)
    assert (path if kind == "file" else path / "inner").read_text() == "second"
    assert moved == [path, path] and [one.name for one in tmp_path.iterdir()] == ["wanted"]
