"""Read ActorsHQ (Isik et al. 2023): `ActorNN/SequenceN/{1x,2x,4x}/calibration.csv`, `rgbs/`, `masks/`."""

from __future__ import annotations

from pathlib import Path

from smplxpp.capture.cameras import read_cameras
from smplxpp.capture.files import FileSeries, image_name
from smplxpp.capture.readers.common import ReaderOptions, chosen_params
from smplxpp.capture.recording import Recording
from smplxpp.core.errors import InputError

NAME = "actorshq"
LOOKS_FOR = "calibration.csv beside rgbs/, there or in a folder 1x, 2x or 4x"
_SCALES = ("1x", "2x", "4x", "8x")
# Files of the simple layout, which may contain a calibration.csv too.
_SIMPLE_LAYOUT = ("capture.json", "cameras.json", "scans")


def detect(root: Path) -> bool:
    """Tell whether a folder is a sequence or one of its scales."""
    return bool(_scales(root)) and not any((root / name).exists() for name in _SIMPLE_LAYOUT)


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find the files of a sequence; images are on black, and cameras are stored camera-to-world.

    SMPL-X parameters (`smpl_params.npz` in AvatarReX's layout, beside `calibration.csv` or beside the scales) are taken
    if present.

    Raises:
        InputError: several scales, no camera, a broken calibration.
    """
    # The images exist at several scales, each with its own calibration; more than one at a place is ambiguous.
    scales = _scales(root)
    if len(scales) != 1:
        raise InputError(
            f"ActorsHQ sequence {root}",
            expected=LOOKS_FOR,
            received=f"{', '.join(path.name for path in scales) or 'none'}",
            remedy=f"open one of them, for instance {scales[-1]}" if scales else "",
        )
    folder = scales[0]
    sequence = folder.parent if folder.name in _SCALES else folder
    cameras = {camera.name: camera for camera in read_cameras(folder / "calibration.csv")}
    # Names are CAM/CAM_rgbFFFFFF.jpg and CAM/CAM_maskFFFFFF.png.
    files = {
        kind: {name: FileSeries.find(folder / place / name, image_name(f"{name}_{tag}")) for name in cameras}
        for kind, place, tag in (("image", "rgbs", "rgb"), ("mask", "masks", "mask"))
    }
    fits = [place / "smpl_params.npz" for place in (folder, sequence)]
    return Recording(
        name=f"{sequence.parent.name}_{sequence.name}" if folder != sequence else sequence.name,
        root=root,
        format=NAME,
        cameras=cameras,
        files=files,
        background=(0.0, 0.0, 0.0),
        params=chosen_params(options, next((path for path in fits if path.is_file()), None)),
    )


def _scales(root: Path) -> list[Path]:
    """Return the folders of a sequence that hold a calibration and images: itself, or one for each scale."""
    folders = [root, *(root / scale for scale in _SCALES)]
    return [path for path in folders if (path / "calibration.csv").is_file() and (path / "rgbs").is_dir()]
