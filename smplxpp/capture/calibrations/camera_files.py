"""Calibrations of one file a camera, or of two files for all: OpenCap's pickles, OpenCV's YAML.

A file stands for its whole rig: files of the same kind in its folder, or in the folders beside its own, belong to it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.capture.calibrations.file_camera import FileCamera, RigFile, entry, file_camera
from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import ascii_numbers, read_text
from smplxpp.core.files.safe_pickle import dense_array, safe_load

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


def _value(key: str, block: list[str], path: Path) -> np.ndarray | list[str] | float | str:
    # The forms that occur: an OpenCV matrix with or without its tag, a scalar, and lists in brackets or of dashed
    # lines, as Python's YAML libraries write them, of texts or of rows.
    if block[0].startswith("!!opencv-matrix") or (not block[0] and block[1:2] and block[1].startswith("rows:")):
        return _matrix(key, " ".join(block[1:]), path)
    if len(block) == 1 and block[0] and not block[0].startswith("["):
        try:
            return float(ascii_numbers(block[0]))
        except ValueError:
            return block[0].strip('"')
    text = " ".join(block).strip()
    if re.match(r"\[\s*\[|-\s+(-\s|\[)", text):
        return _rows(key, text, path)
    if text.startswith("["):
        items = text.strip("[] ").split(",")
    else:
        items = [line.removeprefix("-") for line in block if line.startswith("-")]
    return [item.strip().strip('"') for item in items if item.strip()]


def _rows(key: str, text: str, path: Path) -> np.ndarray:
    """Return the matrix of a list of lists: `[[1, 2], [3, 4]]`, `- [1, 2] - [3, 4]` or `- - 1 - 2 - - 3 - 4`."""
    rows = [part for part in re.split(r"-\s+-\s|\[", text.strip()) if part.strip(" -,")]
    values = [re.sub(r"[\],]", " ", re.sub(r"(?<!\S)-\s", " ", row)).split() for row in rows]
    try:
        return np.array([[float(ascii_numbers(item).removeprefix(".")) for item in row] for row in values])
    except ValueError as error:
        raise InputError(
            f"file {path}: {key}", expected="rows of as many numbers each", received=str(error)[:200]
        ) from None


def _matrix(key: str, text: str, path: Path) -> np.ndarray:
    size = {name: re.search(rf"{name}:\s*(\d+)", text) for name in ("rows", "cols")}
    data = re.search(r"data:\s*\[([^\]]*)\]", text)
    rows, cols = size["rows"], size["cols"]
    try:
        if data is None or rows is None or cols is None:
            raise ValueError("one of them is missing")
        # OpenCV writes `.Nan` and `.Inf`, which float() reads without the dot.
        values = [float(re.sub(r"\.(?=[NI])", "", item)) for item in ascii_numbers(data[1]).split(",")]
        return np.array(values).reshape(int(rows[1]), int(cols[1]))
    except ValueError as error:
        raise InputError(
            f"file {path}: {key}", expected="rows, cols and as many numbers in data", received=str(error)
        ) from None


# Names that OpenCV users give to the parts of a camera, the commonest first, in any case and with or without signs.
_K = ("camera_matrix", "K", "intrinsic_matrix", "intrinsics", "M", "mtx")
_DIST = ("distortion_coefficients", "dist_coeffs", "dist_coefs", "dist_coeff", "dist", "D", "distortion")
_ROTATION = ("R", "rotation_matrix", "rotation", "rvec", "Rot", "rotation_vector")
_TRANSLATION = ("T", "t", "tvec", "translation", "translation_vector")
_POSE = ("extrinsics", "extrinsic", "RT", "Rt", "cam_from_world", "extrinsic_matrix")
_WIDTH, _HEIGHT = ("image_width", "width", "w"), ("image_height", "height", "h")
OPENCAP_FILE = "cameraIntrinsicsExtrinsics.pickle"
"""Name of OpenCap's file in the folder of each camera."""


def is_opencap(content: Any) -> bool:
    """Tell `intrinsicMat` with a rotation and a translation."""
    return isinstance(content, Mapping) and {"intrinsicMat", "rotation", "translation"} <= set(content)


def is_opencv_yaml(content: Any) -> bool:
    """Tell a camera's intrinsics and pose in one file, or EasyMocap's pair (`names`)."""
    if not isinstance(content, Mapping):
        return False
    return "names" in content or (_first(content, _K) is not None and _has_pose(content))


def read_opencap(path: Path, content: Any) -> RigFile:
    """OpenCap: `Videos/CAM/cameraIntrinsicsExtrinsics.pickle`, millimetres, the world of its checkerboard.

    `x_cam = rotation X + translation`. Of a board that stands y points down, of one that lies on the ground z does; the
    file does not say which, the lower edges of the pictures do. `imageSize` is height, width.
    """
    beside = sorted(path.parent.parent.glob(f"*/{OPENCAP_FILE}")) if path.name == OPENCAP_FILE else [path]
    cameras = []
    for file in beside or [path]:
        found = content if file == path else safe_load(file)
        source, name = f"calibration {file}", file.parent.name if len(beside) > 1 else path.stem
        K, R, T = (
            dense_array(entry(found, key, source=source), subject=f"{source}: {key}")
            for key in ("intrinsicMat", "rotation", "translation")
        )
        dist, size = (
            None if key not in found else dense_array(found[key], subject=f"{source}: {key}")
            for key in ("distortion", "imageSize")
        )
        cameras.append(
            file_camera(
                name,
                K,
                R,
                T,
                source=source,
                size=None if size is None or size.size != 2 else size.ravel()[::-1],
                dist=() if dist is None else dist,
            )
        )
    down = sum(camera.R[1] for camera in cameras)
    return RigFile(tuple(cameras), 1e-3, "-y" if down[1] > down[2] else "-z")


def read_opencv_cameras(path: Path, content: Any) -> RigFile:
    """OpenCV's `FileStorage`: a file a camera with intrinsics and pose; or EasyMocap's intri.yml and extri.yml."""
    if "names" in content:
        return _read_pair(path)
    cameras = []
    for file in sorted(path.parent.glob(f"*{path.suffix}")):
        found = content if file == path else read_opencv_yaml(file)
        if "names" not in found and _first(found, _K) is not None and _has_pose(found):
            cameras.append(_yaml_camera(file, found))
    return RigFile(tuple(cameras))


def _yaml_camera(path: Path, content: Mapping[str, Any]) -> FileCamera:
    source = f"calibration {path}"
    pose = _first(content, _POSE)
    if pose is not None:
        pose = np.asarray(pose, dtype=np.float64)
        if pose.shape not in ((3, 4), (4, 4)):
            raise InputError(f"{source}: pose", expected="shape (3, 4) or (4, 4)", received=f"{pose.shape}")
        R, T = pose[:3, :3], pose[:3, 3]
    else:
        R, T = _first(content, _ROTATION), _first(content, _TRANSLATION)
    K = _first(content, _K)
    if np.shape(K) == (3, 3) and not np.any(K[:2, 2]) and np.any(K[2, :2]):
        # Points are rows times matrices there, as in MATLAB: both are transposed.
        K, R = K.T, np.asarray(R, dtype=np.float64).T if np.shape(R) == (3, 3) else R
    sides = [_first(content, names) for names in (_WIDTH, _HEIGHT)]
    size = content.get("image_size") if any(side is None for side in sides) else sides
    dist = _first(content, _DIST)
    return file_camera(path.stem, K, R, T, source=source, size=size, dist=() if dist is None else dist)


def _read_pair(path: Path) -> RigFile:
    """Read EasyMocap's two files: `K_CAM`, `dist_CAM`; `R_CAM` or `Rot_CAM`, `T_CAM`. Metres.

    Lenses are calibrated once, poses for each session: cameras with intrinsics alone are left out with a note.
    """
    intri, extri = (read_opencv_yaml(path.with_name(name)) for name in ("intri.yml", "extri.yml"))
    source, cameras, without = f"calibration {path.with_name('intri.yml')}", [], []
    for name in entry(intri, "names", source=source):
        if not any(f"{part}_{name}" in extri for part in ("R", "Rot", "T")):
            without.append(name)
            continue
        K, T = entry(intri, f"K_{name}", source=source), entry(extri, f"T_{name}", source=f"calibration {path}")
        R = extri[f"R_{name}"] if f"R_{name}" in extri else entry(extri, f"Rot_{name}", source=f"calibration {path}")
        size = (intri.get(f"W_{name}", 0.0), intri.get(f"H_{name}", 0.0))
        dist = intri.get(f"dist_{name}", intri.get(f"D_{name}", ()))
        known = all(isinstance(side, float) and side >= 1 for side in size)
        cameras.append(file_camera(name, K, R, T, source=source, size=size if known else None, dist=dist))
    notes = (f"cameras without a pose in extri.yml are left out: {', '.join(without)}",) if without else ()
    return RigFile(tuple(cameras), 1.0, notes=notes)


def _first(content: Mapping[str, Any], names: tuple[str, ...]) -> Any:
    """Return the entry of the first of some names that is there, a list as the text of its items; None without one."""
    spelled = {_plain(key): value for key, value in content.items()}
    found = next((spelled[_plain(name)] for name in names if _plain(name) in spelled), None)
    return " ".join(found) if isinstance(found, list) else found


def _plain(name: str) -> str:
    return name.lower().replace("_", "")


def _has_pose(content: Mapping[str, Any]) -> bool:
    return _first(content, _POSE) is not None or (
        _first(content, _ROTATION) is not None and _first(content, _TRANSLATION) is not None
    )
