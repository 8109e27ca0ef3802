"""Read EasyMocap: `intri.yml`, `extri.yml`, `images/CAM/000000.jpg`, `annots/CAM/000000.json`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.capture.calibrations.camera_files import read_opencv_yaml
from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import FileSeries, images_beside
from smplxpp.capture.keypoints import found_keypoints
from smplxpp.capture.readers.common import (
    ReaderOptions,
    chosen_params,
    first_folder,
    numbered_images,
    pinhole,
    required,
    size_of_first_image,
)
from smplxpp.capture.recording import Problem, Recording
from smplxpp.capture.sources import ParamFiles
from smplxpp.core import InputError, matrix_from_rotvec

NAME = "easymocap"
LOOKS_FOR = "intri.yml and extri.yml"
# Name that EasyMocap's FileStorage.read drops from a list of cameras.
_NO_CAMERA = "none"
# Folders of fitted parameters, the preferred model first.
_PARAMS = ("output/smplx/smpl", "output/smplx", "output/smpl/smpl", "output/smpl", "smplx", "smpl")


def detect(root: Path) -> bool:
    """Tell whether a folder holds both camera files."""
    return (root / "intri.yml").is_file() and (root / "extri.yml").is_file()


def read(root: Path, options: ReaderOptions) -> Recording:
    """Find the files of a recording: photographs, masks in `masks/` or `mask/`, keypoints in `annots/`.

    Photographs are distorted on disk. The calibration follows OpenCV, with pixel centres at whole numbers. The image
    size is `H_CAM`, `W_CAM`, or that of the camera's first image. A camera named `none` is left out, as EasyMocap does,
    and so are cameras with intrinsics alone: lenses are calibrated once, poses for each session.

    Raises:
        InputError: a broken camera file, or one without a single camera that has intrinsics and a pose.
    """
    intri, extri = read_opencv_yaml(root / "intri.yml"), read_opencv_yaml(root / "extri.yml")
    listed = required(intri, "names", source=f"file {root / 'intri.yml'}")
    if not isinstance(listed, list):
        raise InputError(f"file {root / 'intri.yml'}: names", expected="a list", received=type(listed).__name__)
    posed = [name for name in listed if any(f"{part}_{name}" in extri for part in ("R", "Rot", "T"))]
    names = [name for name in posed if name != _NO_CAMERA]
    without = [name for name in listed if name not in posed and name != _NO_CAMERA]
    if not names:
        raise InputError(f"file {root / 'extri.yml'}", expected="the pose of a camera of intri.yml", received="none")
    notes = [f"camera {_NO_CAMERA}, which EasyMocap itself drops: left aside"] if _NO_CAMERA in listed else []
    if without:
        notes.append(f"cameras without a pose in extri.yml ({', '.join(without)}): left aside")
    images, masks = _files(root, "images", names), first_folder(root, ("masks", "mask"))
    cameras, distortions = {}, {}
    for name in names:
        size: Any = (intri.get(f"W_{name}", 0.0), intri.get(f"H_{name}", 0.0))
        if any(isinstance(side, float) and side == 0.0 for side in size):  # EasyMocap reads 0 for a missing size
            size = size_of_first_image(name, images)
        K = required(intri, f"K_{name}", source=f"file {root / 'intri.yml'}")
        cameras[name] = pinhole(name, K, *_pose(extri, name, root / "extri.yml"), size, opencv_pixels=True)
        # Either name of the coefficients occurs.
        coefficients = intri.get(f"dist_{name}", intri.get(f"D_{name}", []))
        distortion = Distortion.from_opencv(
            np.ravel(coefficients).tolist(), subject=f"file {root / 'intri.yml'}: {name}"
        )
        if distortion is not None:
            distortions[name] = distortion
    return Recording(
        name=root.name,
        root=root,
        format=NAME,
        cameras=cameras,
        distortions=distortions,
        files={
            "image": images,
            "mask": {} if masks is None else _files(root, masks.name, names),
        },
        params=_params(root, options),
        problems=tuple(Problem(note) for note in notes),
        keypoints=found_keypoints(root / "annots", cameras, format="easymocap", person=options.person),
    )


def _files(root: Path, folder: str, names: list[str]) -> dict[str, FileSeries]:
    """Return the images in a folder for each camera, else those in the folder itself that its cameras name."""
    return numbered_images({name: root / folder / name for name in names}) or images_beside(root / folder, names)


def _pose(extri: dict[str, Any], name: str, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose R, T of a camera, by the rotation vector `R_` as in EasyMocap, else by the matrix `Rot_`."""
    T = required(extri, f"T_{name}", source=f"file {path}")
    if f"R_{name}" not in extri:
        return required(extri, f"Rot_{name}", source=f"file {path}"), T
    rotation = np.ravel(extri[f"R_{name}"])
    if len(rotation) != 3:
        raise InputError(f"file {path}: R_{name}", expected="3 numbers", received=f"{len(rotation)}")
    return matrix_from_rotvec(rotation), T


def _params(root: Path, options: ReaderOptions) -> Any:
    """Return the parameters of the options, else those of the first folder of fits; None without any."""
    if options.params is not None:
        return chosen_params(options)
    for name in _PARAMS:
        files = FileSeries.find(root / name, r"(?P<frame>\d+)\.json")
        if len(files):
            return ParamFiles(files, "easymocap", options.body)
    return None
