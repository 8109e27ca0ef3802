"""Masks of a capture's images, by a matting model, empty plates or MediaPipe; a folder has one origin."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from smplxpp.capture import Capture
from smplxpp.capture.files import IMAGE_SUFFIXES, subfolders
from smplxpp.capture.masks import write_mattes
from smplxpp.capture.views import read_color
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_text
from smplxpp.core.files.json_file import as_object, read_json
from smplxpp.core.files.paths import read_bytes
from smplxpp.detect.plates import PlateConfig, PlateModel

MatteModel = Callable[[UInt8[np.ndarray, "H W 3"]], UInt8[np.ndarray, "H W"]]
"""Returns the matte of an sRGB image: the opacity of the person, 0 to 255."""
_RECORD = "masks.json"
_MOST_PLATES = 64


class Plates:
    """Matte models of cameras from their empty plates, each made when its camera is needed.

    Plates are images with the cameras' names in the folder (`CAM.png`, `CAM_empty.jpg`), or a folder a camera with one
    or several images. Several give the camera's noise.

    Raises:
        InputError: no such folder, or no plate of some camera.
    """

    def __init__(self, folder: Path, cameras: Sequence[str], config: PlateConfig | None = None) -> None:
        if not folder.is_dir():
            raise InputError("folder of plates", expected="an existing folder", received=str(folder))
        self.config = config or PlateConfig()
        self.files = {camera: _plates_of(folder, camera)[:_MOST_PLATES] for camera in cameras}
        without = [camera for camera, files in self.files.items() if not files]
        if without:
            raise InputError(
                f"folder of plates {folder}",
                expected=f"an image or a folder of images for each camera, such as {without[0]}.png",
                received=f"none for {', '.join(without[:8])}",
            )
        digest = hashlib.sha256(repr(self.config).encode())
        for camera, files in self.files.items():
            for path in files:
                digest.update(f"{camera} {hashlib.sha256(read_bytes(path)).hexdigest()}".encode())
        self.identity = f"plates {digest.hexdigest()}"

    def of_camera(self, camera: str) -> MatteModel:
        """Return the matte model of a camera."""
        return PlateModel([np.asarray(read_color(path)) for path in self.files[camera]], self.config)


def write_masks(
    capture: Capture,
    model_of: Callable[[str], MatteModel],
    folder: Path,
    *,
    identity: str,
    cameras: Sequence[str] | None = None,
    frames: Iterable[int] | None = None,
) -> Iterator[Path]:
    """Write `folder/CAM/CAM_maskFFFFFF.png` for a capture's views, which `open_capture(masks=folder)` reads; those that
    stand there are kept.

    Args:
        model_of: returns the matte model of a camera.
        identity: of the matters; the folder remembers it.
        cameras, frames: None: all, held-out ones too: their masks are what results are measured in.

    Yields:
        Each file when it stands.

    Raises:
        InputError: a folder with masks of another origin.
    """
    _own_folder(folder, identity)
    for camera in capture.cameras if cameras is None else cameras:
        views = capture.views([camera], frames)
        if views:
            yield from write_mattes(capture, model_of(camera), folder, views=views)


def _own_folder(folder: Path, identity: str) -> None:
    """Refuse a folder with anything else in it; write down what is put into a new one."""
    record = folder / _RECORD
    if record.is_file():
        stands = as_object(read_json(record), subject=f"file {record}").get("identity")
    else:
        stands = None if not folder.is_dir() or not any(folder.iterdir()) else "files of unknown origin"
    if stands is not None and stands != identity:
        raise InputError(
            "--out",
            expected="a new folder, or the one of the same masks",
            received=f"{folder} with {stands}",
            remedy="name another folder",
        )
    atomic_write_text(record, json.dumps({"identity": identity}, indent=1) + "\n")


def _plates_of(folder: Path, camera: str) -> list[Path]:
    if camera in subfolders(folder):
        found = sorted((folder / camera).iterdir())
    else:
        found = sorted(path for path in folder.iterdir() if re.match(rf"{re.escape(camera)}(?![0-9])", path.stem))
    return [path for path in found if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")]
