"""Calibrations in XML of marker systems: Qualisys, Vicon, OptiTrack."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from scipy.spatial.transform import Rotation

from smplxpp.capture.calibrations.file_camera import FileCamera, RigFile, file_camera, numbers_of
from smplxpp.core.errors import InputError

# From axes with y up and z backwards (OpenGL's) to those of OpenCV.
_FLIP = np.diag([1.0, -1.0, -1.0])


def is_qualisys(content: Any) -> bool:
    """Recognise Qualisys by `calibration/cameras/camera/transform`."""
    return isinstance(content, Element) and content.find("cameras/camera/transform") is not None


def is_vicon(content: Any) -> bool:
    """Recognise Vicon by `Cameras/Camera/KeyFrames/KeyFrame` with a FOCAL_LENGTH."""
    frame = content.find("Camera/KeyFrames/KeyFrame") if isinstance(content, Element) else None
    return frame is not None and "FOCAL_LENGTH" in frame.attrib


def is_optitrack(content: Any) -> bool:
    """Recognise OptiTrack by `Camera/Extrinsic` with an OrientMatrix0."""
    pose = content.find(".//Camera/Extrinsic") if isinstance(content, Element) else None
    return pose is not None and "OrientMatrix0" in pose.attrib


def read_qualisys(path: Path, content: Element) -> RigFile:
    """Qualisys Track Manager: `*.qca.txt`, millimetres, z up; the video cameras if any are marked as such.

    `transform` holds the position and, row by row, the rotation from the world to a camera with y up that looks along
    its own -z. Lengths of `intrinsic` are in subpixels of the sensor, whose shown part is `fov_video`. The lens follows
    OpenCV's model on lengths in subpixels: its coefficients are divided by 64 as by Qualisys' own projection.
    """
    cameras, notes = _video_cameras(content.findall("cameras/camera"), attribute="model")
    return RigFile(tuple(_qualisys_camera(path, camera) for camera in cameras), 1e-3, "z", notes)


def _video_cameras(cameras: list[Element], *, attribute: str) -> tuple[list[Element], tuple[str, ...]]:
    """Keep the cameras marked as video cameras in an attribute, all if none is; the note counts those left out."""
    video = [camera for camera in cameras if "video" in camera.get(attribute, "").lower()]
    notes = (f"{len(cameras) - len(video)} marker cameras left out",) if video and len(video) < len(cameras) else ()
    return video or cameras, notes


def _qualisys_camera(path: Path, camera: Element) -> FileCamera:
    source = f"calibration {path}"
    name = camera.get("serial", "")
    shown = camera.find("fov_video")
    shown = camera.find("fov_marker") if shown is None else shown
    inside, pose = (_child(camera, tag, source, name) for tag in ("intrinsic", "transform"))
    if shown is None:
        raise InputError(f"{source}: camera {name}", expected="an element fov_video", received="none")
    left, top, right, bottom = (_number(shown, key, source, name) for key in ("left", "top", "right", "bottom"))
    # Qualisys counts 64 subpixels a pixel.
    subpixels = 64.0
    fu, fv, cu, cv = (
        _number(inside, key, source, name) / subpixels
        for key in ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV")
    )
    k1, k2, p1, p2 = (
        _number(inside, key, source, name) / subpixels
        for key in ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2")
    )
    R = _FLIP @ np.array([[_number(pose, f"r{i}{j}", source, name) for j in (1, 2, 3)] for i in (1, 2, 3)])
    position = np.array([_number(pose, axis, source, name) for axis in "xyz"])
    return file_camera(
        name,
        [[fu, 0.0, cu - left], [0.0, fv, cv - top], [0.0, 0.0, 1.0]],
        R,
        -R @ position,
        source=source,
        size=(right - left + 1, bottom - top + 1),
        dist=(k1, k2, p1, p2),
    )


def read_vicon(path: Path, content: Element) -> RigFile:
    """Vicon Nexus and Shogun: `*.xcp`, millimetres, z up; the video cameras if any are marked as such.

    ORIENTATION is the quaternion x, y, z, w of the rotation from the world to the camera, POSITION the camera's place.
    VICON_RADIAL2 holds a model's name, the centre of distortion and k1, k2, k3, VICON_RADIAL k1, k2: Vicon's polynomial
    takes a distorted radius in pixels to the undistorted one, which is inverted by least squares over the image.
    """
    cameras, notes = _video_cameras(content.findall("Camera"), attribute="TYPE")
    return RigFile(tuple(_vicon_camera(path, camera) for camera in cameras), 1e-3, "z", notes)


def _vicon_camera(path: Path, camera: Element) -> FileCamera:
    source = f"calibration {path}"
    name = camera.get("DEVICEID", camera.get("NAME", ""))
    frame = _child(camera, "KeyFrames/KeyFrame", source, name)
    focal = _number(frame, "FOCAL_LENGTH", source, name)
    aspect = _number(camera, "PIXEL_ASPECT_RATIO", source, name) if "PIXEL_ASPECT_RATIO" in camera.attrib else 1.0
    centre, quaternion, position, size = (
        numbers_of(_text(element, key, source, name), subject=f"{source}: camera {name}: {key}")
        for element, key in (
            (frame, "PRINCIPAL_POINT"),
            (frame, "ORIENTATION"),
            (frame, "POSITION"),
            (camera, "SENSOR_SIZE"),
        )
    )
    if (centre.size, quaternion.size, position.size, size.size) != (2, 4, 3, 2) or not quaternion.any() or aspect <= 0:
        raise InputError(
            f"{source}: camera {name}",
            expected="PRINCIPAL_POINT of 2 numbers, ORIENTATION of 4, POSITION of 3, SENSOR_SIZE of 2",
            received=f"{centre.size}, {quaternion.size}, {position.size}, {size.size}",
        )

    R = Rotation.from_quat(quaternion).as_matrix()
    radial = _vicon_radial(frame, source, name)
    return file_camera(
        name,
        [[focal, 0.0, centre[0]], [0.0, focal / aspect, centre[1]], [0.0, 0.0, 1.0]],
        R,
        -R @ position,
        source=source,
        size=size,
        dist=_inverted_radial(radial, focal, float(np.hypot(*size) / 2)),
    )


def _vicon_radial(frame: Element, source: str, name: str) -> np.ndarray:
    """Return k1, k2, k3 of Vicon's polynomial in pixels."""
    if "VICON_RADIAL2" in frame.attrib:
        parts = frame.attrib["VICON_RADIAL2"].split()
        values = numbers_of(" ".join(parts[3:6]), subject=f"{source}: camera {name}: VICON_RADIAL2")
    else:
        values = numbers_of(frame.get("VICON_RADIAL", ""), subject=f"{source}: camera {name}: VICON_RADIAL")
    return np.concatenate([values, np.zeros(3)])[:3]


def _inverted_radial(k: np.ndarray, focal: float, reach: float) -> tuple[float, ...]:
    """Return OpenCV's k1, k2, 0, 0, k3 that undo `r_u = r_d (1 + k1 r_d^2 + k2 r_d^4 + k3 r_d^6)` within the image.

    Vicon corrects a seen radius r_d in pixels; OpenCV distorts a true radius on the plane z = 1.
    """
    if not k.any():
        return ()
    seen = np.linspace(0.02, 1.0, 64) * reach
    with np.errstate(over="ignore", invalid="ignore"):
        true = seen * (1 + k[0] * seen**2 + k[1] * seen**4 + k[2] * seen**6) / focal
        # seen / focal = true (1 + c1 true^2 + c2 true^4 + c3 true^6), linear in c.
        terms = np.stack([true**3, true**5, true**7], axis=1)
        right = seen / focal - true
    if not (np.isfinite(terms).all() and math.isfinite(float(np.abs(right).max())) and (np.diff(true) > 0).all()):
        raise InputError("VICON_RADIAL", expected="a polynomial that grows within the image", received=f"{k.tolist()}")
    scale = np.abs(terms).max(axis=0)
    c = np.linalg.lstsq(terms / scale, right, rcond=None)[0] / scale
    return (float(c[0]), float(c[1]), 0.0, 0.0, float(c[2]))


def read_optitrack(path: Path, content: Element) -> RigFile:
    """OptiTrack Motive: `*.mcal`, metres, y up.

    `Extrinsic` holds the position and, row by row, the rotation from a camera with y up that looks along its own -z to
    the world; `IntrinsicStandardCameraModel` the lens in OpenCV's model (`Intrinsic` is Motive's own).
    """
    cameras, missing = [], []
    for camera in content.iter("Camera"):
        name = camera.get("Serial", "")
        lens, pose, about = (camera.find(t) for t in ("IntrinsicStandardCameraModel", "Extrinsic", "Attributes"))
        if lens is None or pose is None or about is None:
            missing.append(name)
            continue
        cameras.append(_optitrack_camera(path, name, {"lens": lens, "pose": pose, "about": about}))
    notes = (f"cameras without a standard camera model left out: {', '.join(missing)}",) if missing else ()
    return RigFile(tuple(cameras), 1.0, "y", notes)


def _optitrack_camera(path: Path, name: str, parts: Mapping[str, Element]) -> FileCamera:
    source = f"calibration {path}"

    def number(part: str, key: str) -> float:
        return _number(parts[part], key, source, name)

    fu, fv, cu, cv = (
        number("lens", key) for key in ("HorizontalFocalLength", "VerticalFocalLength", "LensCenterX", "LensCenterY")
    )
    k1, k2, p1, p2, k3 = (number("lens", key) for key in ("k1", "k2", "TangentialX", "TangentialY", "k3"))
    world_from_cam = np.array([number("pose", f"OrientMatrix{k}") for k in range(9)]).reshape(3, 3)
    position = np.array([number("pose", axis) for axis in "XYZ"])
    R = _FLIP @ world_from_cam.T
    return file_camera(
        name,
        [[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]],
        R,
        -R @ position,
        source=source,
        size=(number("about", "ImagerPixelWidth"), number("about", "ImagerPixelHeight")),
        dist=(k1, k2, p1, p2, k3),
    )


def _child(element: Element, tag: str, source: str, name: str) -> Element:
    found = element.find(tag)
    if found is None:
        raise InputError(f"{source}: camera {name}", expected=f"an element {tag}", received="none")
    return found


def _text(element: Element, key: str, source: str, name: str) -> str:
    if key not in element.attrib:
        raise InputError(f"{source}: camera {name}", expected=f"an attribute {key}", received=", ".join(element.attrib))
    return element.attrib[key]


def _number(element: Element, key: str, source: str, name: str) -> float:
    values = numbers_of(_text(element, key, source, name), subject=f"{source}: camera {name}: {key}").ravel()
    if values.size != 1:
        raise InputError(f"{source}: camera {name}: {key}", expected="one number", received=f"{values.size}")
    return float(values[0])
