"""Numbered files of a folder, held compactly: a capture may have a million of them."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Int, Int64, Shaped

from smplxpp.core.errors import InputError

_LAST_FRAME = 1 << 53
IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")


@dataclass(frozen=True, eq=False)
class FileSeries:
    """The file of each frame.

    Attributes:
        folder: what the names are relative to.
        numbers: (F,) int64 frames, ascending.
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
            InputError: a frame's number beyond 2^53, which is none.
        """
        if max(names, default=0) > _LAST_FRAME:
            raise InputError(f"frames of {folder}", expected=f"numbers up to {_LAST_FRAME}", received=f"{max(names)}")
        numbers = np.array(sorted(names), dtype=np.int64)
        encoded = np.array([os.fsencode(names[int(n)]) for n in numbers], dtype=bytes)
        return FileSeries(folder, numbers, encoded)

    @staticmethod
    def find(folder: Path, pattern: str) -> FileSeries:
        """Files of `folder` whose whole name matches `pattern`; its group `frame` is the number. May be empty.

        Of two files with one number the first in alphabetical order counts; numbers beyond 2^53 are no frames'.
        """
        compiled = re.compile(pattern)
        found: dict[int, str] = {}
        if folder.is_dir():
            with os.scandir(folder) as entries:
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
        """The file of a frame, None where there is none."""
        index = int(np.searchsorted(self.numbers, frame))
        if index == len(self.numbers) or self.numbers[index] != frame:
            return None
        return self.folder / os.fsdecode(bytes(self.names[index]))

    def required(self, frame: int) -> Path:
        """The file of a frame that is among `numbers`.

        Raises:
            InputError: there is none.
        """
        path = self.path(frame)
        if path is None:
            raise InputError(f"frame {frame}", expected=f"a file in {self.folder}", received="none")
        return path

    def has(self, frames: Int[np.ndarray, " N"]) -> Bool[np.ndarray, " N"]:
        """Tell which of the frames have a file."""
        return np.isin(frames, self.numbers)

    def only(self, keep: Bool[np.ndarray, " F"]) -> FileSeries:
        """The files selected by a (F,) bool array."""
        return FileSeries(self.folder, self.numbers[keep], self.names[keep])


def image_name(before: str = "", *, after: str = "", suffixes: Sequence[str] = IMAGE_SUFFIXES) -> str:
    """Pattern of a file's name: `before`, the frame's digits, the pattern `after`, a suffix in either case."""
    endings = "|".join(re.escape(suffix[1:]) for suffix in suffixes)
    return rf"{re.escape(before)}(?P<frame>\d+){after}\.(?i:{endings})"


def subfolders(folder: Path) -> list[str]:
    """Names of the folders in a folder, sorted; none if it does not exist."""
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        return sorted(entry.name for entry in entries if entry.is_dir() and not entry.name.startswith("."))
