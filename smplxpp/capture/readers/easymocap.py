"""Read EasyMocap: `intri.yml`, `extri.yml`, `images/CAM/000000.jpg`, `annots/CAM/000000.json`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import FileSeries
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
from smplxpp.core.files.paths import read_text

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
    size is `H_CAM`, `W_CAM`, or that of the camera's first image. A camera named `none` is left out, as EasyMocap does.

    Raises:
        InputError: a broken camera file, or a camera in only one of the two files.
    """
    intri, extri = read_opencv_yaml(root / "intri.yml"), read_opencv_yaml(root / "extri.yml")
    listed = required(intri, "names", source=f"file {root / 'intri.yml'}")
    if not isinstance(listed, list):
        raise InputError(f"file {root / 'intri.yml'}: names", expected="a list", received=type(listed).__name__)
    names = [name for name in listed if name != _NO_CAMERA]
    images = numbered_images({name: root / "images" / name for name in names})
    masks = first_folder(root, ("masks", "mask"))
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
            "mask": {} if masks is None else numbered_images({name: masks / name for name in names}),
        },
        params=_params(root, options),
        problems=()
        if len(names) == len(listed)
        else (Problem(f"camera {_NO_CAMERA}, which EasyMocap itself drops: left aside"),),
        keypoints=found_keypoints(root / "annots", cameras, format="easymocap", person=options.person),
    )


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


_KEY = re.compile(r"^(?P<key>[^\s:#%-][^:]*):\s*(?P<value>.*)$")


def read_opencv_yaml(path: Path) -> dict[str, np.ndarray | list[str] | float | str]:
    """Read a YAML file of `cv2.FileStorage`: matrices as float64 arrays, lists of texts, and numbers by name.

    Only the subset of calibration files is read: entries at the top level.

    Raises:
        InputError: a missing file, not a text, or a matrix whose numbers do not match its size.
    """
    lines = read_text(path).splitlines()
    # `cv2.FileStorage` writes "%YAML:1.0" and "!!opencv-matrix", which YAML libraries refuse; hence our own parser.
    blocks: dict[str, list[str]] = {}
    current: list[str] | None = None
    for line in lines:
        if match := _KEY.match(line):
            current = blocks.setdefault(match["key"].strip().strip('"'), [])
            current.append(match["value"].strip())
        elif current is not None and line.strip() and not line.startswith(("%", "---")):
            current.append(line.strip())
    return {key: _value(key, block, path) for key, block in blocks.items()}


# Matrices, numbers, texts, and lists in either of YAML's notations.
def _value(key: str, block: list[str], path: Path) -> np.ndarray | list[str] | float | str:
    # The four forms that occur: an OpenCV matrix, a scalar, a list in brackets, and a list of dashed lines.
    if block[0].startswith("!!opencv-matrix"):
        return _matrix(key, " ".join(block[1:]), path)
    if len(block) == 1 and block[0] and not block[0].startswith("["):
        try:
            return float(block[0])
        except ValueError:
            return block[0].strip('"')
    if block[0].startswith("["):
        items = " ".join(block).strip("[] ").split(",")
    else:
        items = [line.removeprefix("-") for line in block if line.startswith("-")]
    return [item.strip().strip('"') for item in items if item.strip()]


def _matrix(key: str, text: str, path: Path) -> np.ndarray:
    size = {name: re.search(rf"{name}:\s*(\d+)", text) for name in ("rows", "cols")}
    data = re.search(r"data:\s*\[([^\]]*)\]", text)
    rows, cols = size["rows"], size["cols"]
    try:
        if data is None or rows is None or cols is None:
            raise ValueError("one of them is missing")
        # OpenCV writes `.Nan` and `.Inf`, which float() reads without the dot.
        values = [float(re.sub(r"\.(?=[NI])", "", item)) for item in data[1].split(",")]
        return np.array(values).reshape(int(rows[1]), int(cols[1]))
    except ValueError as error:
        raise InputError(
            f"file {path}: {key}", expected="rows, cols and as many numbers in data", received=str(error)
        ) from None
