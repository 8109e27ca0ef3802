"""Find the numbered files of a folder and hold them compactly, because a capture may have a million files."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int, Int64, Shaped

from smplxpp.core.errors import InputError

# Largest frame number, above which float64 does not hold every integer.
_LAST_FRAME = 1 << 53
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts", ".mpg", ".mpeg")
# What tools add to a camera's name: folders of keypoints, images and videos, results of detectors.
_ADDED = (
    "json", "img", "imgs", "images", "image", "video", "videos", "pose", "poses", "keypoints", "openpose", "rgb", "mp4",
    "results", "synchronized", "synced", "sync", "undistorted", "halpe26", "body25b", "body25", "coco17", "int", "ext",
)  # fmt: skip


def require_folder(path: str | Path) -> None:
    """Check that a capture is a folder.

    Raises:
        InputError: it is none; the film of one camera is no capture yet, and the message says how it becomes one.
    """
    if Path(path).is_dir():
        return
    film = Path(path).is_file() and Path(path).suffix.lower() in VIDEO_SUFFIXES
    remedy = (
        "a film of a person who turns before one camera becomes a capture with "
        f"`smplxpp capture turntable {path} --out DIR`; films of several cameras lie in a folder with their calibration"
    )
    raise InputError("capture", expected="an existing folder", received=str(path), remedy=remedy if film else "")


@dataclass(frozen=True, eq=False)
class FileSeries:
    """The files of a camera or capture by frame number.

    Attributes:
        folder: folder that the names are relative to.
        numbers: (F,) int64 frame numbers, ascending.
        names: (F,) bytes, the encoded path of each file below `folder`. Fixed-width bytes take a tenth of the memory
            of a dictionary of paths.
    """

    folder: Path
    numbers: Int64[np.ndarray, " F"]
    names: Shaped[np.ndarray, " F"]

    @staticmethod
    def from_names(folder: Path, names: Mapping[int, str]) -> FileSeries:
        """Make a series of the file name of each frame.

        Raises:
            InputError: a frame number over 2^53.
        """
        # float64, in which tables may hold frame numbers, represents every integer up to 2^53.
        if max(names, default=0) > _LAST_FRAME:
            raise InputError(f"frames of {folder}", expected=f"numbers up to {_LAST_FRAME}", received=f"{max(names)}")
        numbers = np.array(sorted(names), dtype=np.int64)
        # Names as one array of bytes, far smaller than as many Python strings and paths.
        encoded = np.array([os.fsencode(names[int(n)]) for n in numbers], dtype=bytes)
        return FileSeries(folder, numbers, encoded)

    @staticmethod
    def find(folder: Path, pattern: str) -> FileSeries:
        """Find the files of `folder` whose whole name matches `pattern` with a group `frame`; may be empty.

        Of two files with one number the first in alphabetical order is taken; numbers over 2^53 are ignored.
        """
        compiled = re.compile(pattern)
        found: dict[int, str] = {}
        if folder.is_dir():
            with os.scandir(folder) as entries:
                # Sorted, because `scandir` returns an order that differs between file systems.
                for name in sorted(entry.name for entry in entries):
                    if (match := compiled.fullmatch(name)) and (frame := int(match["frame"])) <= _LAST_FRAME:
                        found.setdefault(frame, name)
        return FileSeries.from_names(folder, found)

    def __repr__(self) -> str:
        """A line: a series may have a million files."""
        span = f" {self.numbers[0]} to {self.numbers[-1]}" if len(self.numbers) else ""
        return f"FileSeries({len(self.numbers)} files{span} in {str(self.folder)!r})"

    def __len__(self) -> int:
        return len(self.numbers)

    def path(self, frame: int) -> Path | None:
        """Return the file of a frame, None without one."""
        index = int(np.searchsorted(self.numbers, frame))
        if index == len(self.numbers) or self.numbers[index] != frame:
            return None
        return self.folder / os.fsdecode(bytes(self.names[index]))

    def required(self, frame: int) -> Path:
        """Return the file of a frame that must exist.

        Raises:
            InputError: no file of this frame.
        """
        path = self.path(frame)
        if path is None:
            raise InputError(f"frame {frame}", expected=f"a file in {self.folder}", received="none")
        return path

    def has(self, frames: Int[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
        """Return for each frame whether it has a file."""
        return np.isin(frames, self.numbers)

    def sizes(self) -> Int64[np.ndarray, " F"]:
        """Return the bytes of each file; -1 where it is gone.

        A call of the system a file and little beside: captures have a million files.
        """
        out, folder = np.full(len(self), -1), os.fsencode(self.folder) + b"/"
        for row, name in enumerate(self.names.tolist()):
            with suppress(OSError):
                out[row] = os.stat(folder + name).st_size
        return out

    def only(self, keep: Bool[np.ndarray, " F"]) -> FileSeries:
        """Return the files that a (F,) bool array selects."""
        return FileSeries(self.folder, self.numbers[keep], self.names[keep])


def image_name(before: str = "", *, after: str = "", suffixes: Sequence[str] = IMAGE_SUFFIXES) -> str:
    """Return a pattern of file names: `before`, the digits of the frame, the pattern `after`, a suffix of any case."""
    endings = "|".join(re.escape(suffix[1:]) for suffix in suffixes)
    return rf"{re.escape(before)}(?P<frame>\d+){after}\.(?i:{endings})"


def subfolders(folder: Path) -> list[str]:
    """Return the sorted names of the folders in a folder; none if it does not exist."""
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        return sorted(entry.name for entry in entries if entry.is_dir() and not entry.name.startswith("."))


def images_beside(folder: Path, cameras: Sequence[str]) -> dict[str, FileSeries]:
    """Find the images of cameras that lie in one folder: `cam1_000012.jpg`, `007_0001.png`, `1.jpg`.

    The camera is the name before its last numbers, or the whole name, spelled as `matched_names` compares it; the frame
    is the last number after it, 0 without one.

    Returns:
        The series of each camera. Nothing where an image is no camera's, or two are one camera's of one frame: the
        folder then holds something else.
    """
    names = sorted(p.name for p in folder.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES) if folder.is_dir() else []
    own = {_tokens(camera): camera for camera in cameras}
    found: dict[str, dict[int, str]] = {}
    for name in names:
        # Numbers are taken off the end until a camera is left.
        stem, numbers = Path(name).stem, list[int]()
        while _tokens(stem) not in own and (match := re.fullmatch(r"(.*[^0-9])([0-9]{1,15})", stem)):
            stem = match[1].rstrip("_-. ")
            numbers.append(int(match[2]))
        frame = numbers[0] if numbers else 0
        files = found.setdefault(own.get(_tokens(stem), ""), {})
        if "" in found or frame in files:
            return {}
        files[frame] = name
    return {camera: FileSeries.from_names(folder, files) for camera, files in found.items()}


def matched_names(cameras: Sequence[str], files: Sequence[str]) -> dict[str, str]:
    """Return for each camera the file or folder (without its suffix) that is its own; cameras without one are left out.

    Names are compared without case, signs, zeros before numbers and what tools add to them. Equal names go first, then
    names that hold the camera's whole (a serial number in a video's name), then the only one with the same last number.
    No file is given to two cameras.

    Args:
        cameras: names of the calibration.
        files: names to choose from.
    """
    out: dict[str, str] = {}
    free = list(dict.fromkeys(files))
    for same in (_exactly, _within, _by_number):
        for camera in cameras:
            if camera in out:
                continue
            # Additions make names longer: of several the shortest is the camera's own.
            fitting = sorted((file for file in free if same(camera, file)), key=lambda name: (len(name), name))
            if not fitting or (same is _by_number and _shared(camera, fitting, cameras, out)):
                continue
            out[camera] = fitting[0]
            free.remove(fitting[0])
    return {camera: out[camera] for camera in cameras if camera in out}


def _shared(camera: str, fitting: Sequence[str], cameras: Sequence[str], matched: Mapping[str, str]) -> bool:
    """Tell whether several files, or several cameras without one, have the number."""
    others = (other for other in cameras if other != camera and other not in matched)
    return len(fitting) > 1 or any(_by_number(other, fitting[0]) for other in others)


def _tokens(name: str) -> tuple[str, ...]:
    """Return the words and numbers of a name, in lower case, without what tools add."""
    parts = re.findall(r"[a-z]+|\d+", name.lower())
    kept = [part for part in parts if part not in _ADDED]
    return tuple(part.lstrip("0") or "0" if part.isdigit() else part for part in kept or parts)


def _exactly(camera: str, file: str) -> bool:
    return camera == file or _tokens(camera) == _tokens(file)


def _within(camera: str, file: str) -> bool:
    """Tell whether the words of the camera stand one after another in those of the file.

    anipose calls cameras by a letter that their files end with: `A` is that of `vid1-camA`.
    """
    own, other = _tokens(camera), _tokens(file)
    if len(camera) == 1 and re.search(rf"cam(era)?[-_ ]?{re.escape(camera)}$", file, re.IGNORECASE):
        return True
    return any(other[k : k + len(own)] == own for k in range(len(other) - len(own) + 1))


def _by_number(camera: str, file: str) -> bool:
    """Tell whether the last numbers are the same."""
    own, other = (re.findall(r"\d+", name) for name in (camera, file))
    return bool(own) and bool(other) and int(own[-1]) == int(other[-1])
