"""Masks of any matting tool: a folder of mattes, matched to a capture's images by their names."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from smplxpp.capture.files import IMAGE_SUFFIXES, FileSeries, subfolders
from smplxpp.capture.recording import Recording
from smplxpp.core.errors import InputError


def with_masks(recording: Recording, folder: Path) -> Recording:
    """The recording with its masks taken from `folder` alone.

    A matte belongs to the image whose name it bears, with or without something behind it (`IMAGE.png`,
    `IMAGE_alpha.png`), else to the frame whose number ends its name (`CAM_mask000012.png`, `000012.png`). Mattes are
    in a folder for each camera, or all in one, where their names start with the camera's. The file's alpha channel
    counts if it has one (cut-outs), else its brightness.

    Raises:
        InputError: no such folder, no matte of any image.
    """
    if not folder.is_dir():
        raise InputError("folder of masks", expected="an existing folder", received=str(folder))
    images = recording.files.get("image", {})
    inside = set(subfolders(folder))
    masks = {}
    for camera, series in images.items():
        place = folder / camera if camera in inside else folder
        found = _match(place, camera, series, shared=camera not in inside)
        if found:
            masks[camera] = FileSeries.from_names(place, found)
    if not masks:
        first = next(iter(images.values()), None)
        example = "none" if first is None else first.required(int(first.numbers[0])).stem
        raise InputError(
            f"folder of masks {folder}",
            expected=f"mattes named as the images, such as {next(iter(images), 'CAM')}/{example}.png",
            received=", ".join(sorted(path.name for path in folder.iterdir())[:6]) or "nothing",
        )
    return replace(recording, files={**recording.files, "mask": masks})


def _match(folder: Path, camera: str, images: FileSeries, *, shared: bool) -> dict[int, str]:
    by_stem = {images.required(int(number)).stem: int(number) for number in images.numbers}
    known = set(by_stem.values())
    found: dict[int, str] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in IMAGE_SUFFIXES or path.name.startswith("."):
            continue
        own = path.stem
        if shared:
            named = re.match(rf"{re.escape(camera)}(?!\d)", own)
            if not named:
                continue
            own = own[named.end() :]
        frame = _by_image(path.stem, by_stem)
        if frame is None:
            numbers = re.findall(r"\d+", own)
            frame = int(numbers[-1]) if numbers and int(numbers[-1]) in known else None
        if frame is not None:
            found.setdefault(frame, path.name)
    return found


def _by_image(stem: str, by_stem: Mapping[str, int]) -> int | None:
    """The frame of the image with this name, or with this name up to a `.`, `_` or `-`."""
    while stem not in by_stem:
        shorter = re.sub(r"[._-][^._-]*$", "", stem)
        if shorter == stem:
            return None
        stem = shorter
    return by_stem[stem]
