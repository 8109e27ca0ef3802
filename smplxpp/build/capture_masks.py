"""Write masks of a capture's images by a matting model, empty plates or MediaPipe; a folder has one origin."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from smplxpp.capture import Capture, write_mattes
from smplxpp.capture.files import IMAGE_SUFFIXES, subfolders
from smplxpp.capture.views import read_color
from smplxpp.core.errors import InputError
from smplxpp.core.files import as_object, atomic_write_text, read_bytes, read_json
from smplxpp.detect.plates import PlateConfig, PlateModel

MatteModel = Callable[[UInt8[np.ndarray, "H W 3"]], UInt8[np.ndarray, "H W"]]
"""Returns the matte of an sRGB image: the opacity of the person, 0 to 255."""
_RECORD = "masks.json"


class Plates:
    """Matte models of cameras from their empty plates, each built when its camera is needed.

    Plates are images with the cameras' names in the folder (`CAM.png`, `CAM_empty.jpg`), or a folder a camera with one
    or several images. Several give the camera's noise.

    Raises:
        InputError: no such folder, or no plate of some camera.
    """

    def __init__(self, folder: Path, cameras: Sequence[str], config: PlateConfig | None = None) -> None:
        if not folder.is_dir():
            raise InputError("folder of plates", expected="an existing folder", received=str(folder))
        # 64 plates are enough to estimate a camera's noise.
        self.config = config or PlateConfig()
        self.files = {camera: _plates_of(folder, camera)[:64] for camera in cameras}
        without = [camera for camera, files in self.files.items() if not files]
        if without:
            raise InputError(
                f"folder of plates {folder}",
                expected=f"an image or a folder of images for each camera, such as {without[0]}.png",
                received=f"none for {', '.join(without[:8])}",
            )
        # Settings and plates identify the masks that they give.
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
    """Write missing files `folder/CAM/CAM_maskFFFFFF.png` of a capture's views, for `open_capture(masks=folder)`.

    Args:
        capture: the capture.
        model_of: returns the matte model of a camera.
        folder: folder of the masks.
        identity: identity of the matte models, which the folder records.
        cameras: names of cameras; None: all, held-out ones too, because results are measured within masks.
        frames: numbers of frames; None: all.

    Yields:
        The path of each file once it exists.

    Raises:
        InputError: a folder with masks of another origin.
    """
    _own_folder(folder, identity)
    for camera in capture.cameras if cameras is None else cameras:
        views = capture.views([camera], frames)
        if views:
            yield from write_mattes(capture, model_of(camera), folder, views=views)


def _own_folder(folder: Path, identity: str) -> None:
    """Refuse a folder with masks of another origin, and record the origin of a new one."""
    # Masks of two origins in one folder could not be told apart.
    record = folder / _RECORD
    if record.is_file():
        present = as_object(read_json(record), subject=f"file {record}").get("identity")
    else:
        present = None if not folder.is_dir() or not any(folder.iterdir()) else "files of unknown origin"
    if present is not None and present != identity:
        raise InputError(
            "--out",
            expected="a new folder, or the one of the same masks",
            received=f"{folder} with {present}",
            remedy="name another folder",
        )
    atomic_write_text(record, json.dumps({"identity": identity}, indent=1) + "\n")


def _plates_of(folder: Path, camera: str) -> list[Path]:
    # A folder of plates for the camera, or images that begin with its name and no further digit.
    if camera in subfolders(folder):
        found = sorted((folder / camera).iterdir())
    else:
        found = sorted(path for path in folder.iterdir() if re.match(rf"{re.escape(camera)}(?![0-9])", path.stem))
    return [path for path in found if path.suffix.lower() in IMAGE_SUFFIXES and not path.name.startswith(".")]
