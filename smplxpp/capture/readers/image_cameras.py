"""Cameras' names from the paths of their images, where a set lists images and has no names for cameras."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import pairwise
from pathlib import PurePosixPath

from smplxpp.capture.files import IMAGE_SUFFIXES
from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import check_name

# Folders that say nothing of a camera, with nerfstudio's reductions (images_4).
_IMAGE_FOLDER = re.compile(r"(?:images?|imgs?|rgbs?)(?:_\d+)?")
# What an int64 holds.
_NUMBERED = re.compile(r"(.*?)([0-9]{1,18})", re.DOTALL)


def camera_names(paths: Iterable[PurePosixPath], *, subject: str) -> dict[PurePosixPath, str]:
    """A name of its own for each path: its parts joined by `_`.

    Left out are a first folder such as `images` and the suffix, as long as names stay different without.

    Raises:
        InputError: names that remain alike, or that no file can bear.
    """
    distinct = list(dict.fromkeys(paths))
    for folder, suffix in ((False, False), (True, False), (True, True)):
        names = {path: _spelled(path, folder=folder, suffix=suffix) for path in distinct}
        if len(set(names.values())) == len(distinct):
            return {path: check_name(name, subject=f"{subject}: image {path}") for path, name in names.items()}
    alike = sorted(names, key=lambda path: names[path])
    pair = next((a, b) for a, b in pairwise(alike) if names[a] == names[b])
    raise InputError(
        f"{subject}: images {pair[0]} and {pair[1]}",
        expected="paths that give cameras different names",
        received=f"{names[pair[0]]} for both",
        remedy="rename one of the folders",
    )


def without_suffix(path: PurePosixPath) -> PurePosixPath:
    """The path without the suffix of an image; a dot in a name alone is none."""
    return path.with_suffix("") if path.suffix.lower() in IMAGE_SUFFIXES else path


def number_at_end(path: PurePosixPath) -> tuple[str, int] | None:
    """What precedes the number at the end of an image's name, and the number; None where there is none."""
    match = _NUMBERED.fullmatch(without_suffix(path).name)
    return None if match is None else (match[1], int(match[2]))


def _spelled(path: PurePosixPath, *, folder: bool, suffix: bool) -> str:
    parts = (path if suffix else without_suffix(path)).parts
    if not folder and len(parts) > 1 and _IMAGE_FOLDER.fullmatch(parts[0].lower()):
        parts = parts[1:]
    return "_".join(parts) or "camera"
