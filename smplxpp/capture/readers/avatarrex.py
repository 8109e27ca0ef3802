"""Read AvatarReX (Zheng et al. 2023): `calibration_full.json`, `CAM/00000000.jpg`, `CAM/mask/pha/00000000.jpg`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.readers.common import ReaderOptions, chosen_params, numbered_images, pinhole, required
from smplxpp.capture.recording import Recording
from smplxpp.core import Camera, InputError
from smplxpp.core.files.json_file import as_numbers, read_json

NAME = "avatarrex"
LOOKS_FOR = "calibration_full.json"


def detect(root: Path) -> bool:
    """Tell whether a folder is a subject of AvatarReX."""
    return (root / "calibration_full.json").is_file()


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find the files of a subject: photographs, mattes, `smpl_params.npz` with a row for each of 30 frames a second.

    Raises:
        InputError: a broken calibration.
    """
    cameras, distortions = read_calibration(root / "calibration_full.json")
    return Recording(
        name=root.name,
        root=root,
        format=NAME,
        cameras=cameras,
        distortions=distortions,
        files={
            "image": numbered_images({name: root / name for name in cameras}),
            "mask": numbered_images({name: root / name / "mask" / "pha" for name in cameras}),
        },
        params=chosen_params(options, root / "smpl_params.npz"),
        fps=30.0,
    )


def read_calibration(path: Path) -> tuple[dict[str, Camera], dict[str, Distortion]]:
    """Read the cameras `{name: {K, R, T, imgSize, distCoeff}}` of AvatarReX and THuman4.

    Pixel centres are at whole numbers, because the authors' code rounds projected points to indices.

    Raises:
        InputError: a broken file, or missing fields.
    """
    content = read_json(path)
    if not isinstance(content, Mapping) or not content:
        raise InputError(f"file {path}", expected="an object of cameras", received=type(content).__name__)
    cameras, distortions = {}, {}
    for name, entry in content.items():
        source = f"file {path}: camera {name}"
        # x_cam = R x_world + T, metres; K in pixels of the stored image.
        K, R, T, size = (required(entry, key, source=source) for key in ("K", "R", "T", "imgSize"))
        width, height = as_numbers(size, (2,), subject=f"{source}: imgSize").tolist()
        cameras[name] = pinhole(name, K, R, T, (width, height), opencv_pixels=True)
        distortion = Distortion.from_opencv(entry.get("distCoeff", []), subject=source)
        if distortion is not None:
            distortions[name] = distortion
    return cameras, distortions
