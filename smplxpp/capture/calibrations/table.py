"""The table of calibration formats, and how a file or a folder is read by it.

A format is a name, the suffixes of its files, a function that tells its content, and one that reads it into
`FileCamera`s; what comes after (units, axes, image sizes, lenses) is the same for all. A new format is a line of
`FORMATS` and these two functions in the module of its kind of files.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.capture.calibrations import camera_files, data_set_files, xml_files
from smplxpp.capture.calibrations.camera_files import read_opencv_yaml
from smplxpp.capture.calibrations.file_camera import AXES, FileCamera, RigFile, scaled_intrinsics
from smplxpp.capture.calibrations.world import UNITS, metres_of, upright_from_world
from smplxpp.capture.distortion import Distortion
from smplxpp.capture.files import matched_names
from smplxpp.capture.readers.common import pinhole
from smplxpp.core import Camera
from smplxpp.core.errors import InputError, require_choice
from smplxpp.core.files.json_file import read_json
from smplxpp.core.files.markup_file import read_toml, read_xml
from smplxpp.core.files.safe_pickle import safe_load


@dataclass(frozen=True)
class CalibrationFormat:
    """A file format of calibrations: how it is recognised and read.

    Attributes:
        name: of the format.
        kind: key of `_LOADERS`, which names how its files are opened.
        tells: whether opened content is of this format.
        read: from a file and its opened content to the cameras.
        files: description of its files, for messages.
    """

    name: str
    kind: str
    tells: Callable[[Any], bool]
    read: Callable[[Path, Any], RigFile]
    files: str


_LOADERS: Mapping[str, tuple[tuple[str, ...], Callable[[Path], Any]]] = {
    "toml": ((".toml",), lambda path: read_toml(path, subject="calibration")),
    "xml": ((".xml", ".txt", ".xcp", ".mcal"), lambda path: read_xml(path, subject="calibration")),
    "json": ((".json",), lambda path: read_json(path, subject="calibration")),
    "pickle": ((".pickle", ".pkl"), safe_load),
    "yaml": ((".yml", ".yaml"), read_opencv_yaml),
}
FORMATS: tuple[CalibrationFormat, ...] = (
    CalibrationFormat(
        "caliscope", "toml", data_set_files.is_caliscope, data_set_files.read_caliscope, "camera_array.toml"
    ),
    CalibrationFormat(
        "freemocap", "toml", data_set_files.is_freemocap, data_set_files.read_freemocap, "*_camera_calibration.toml"
    ),
    CalibrationFormat("pose2sim", "toml", data_set_files.is_pose2sim, data_set_files.read_pose2sim, "Calib*.toml"),
    CalibrationFormat("anipose", "toml", data_set_files.is_anipose, data_set_files.read_anipose, "calibration.toml"),
    CalibrationFormat("qualisys", "xml", xml_files.is_qualisys, xml_files.read_qualisys, "*.qca.txt"),
    CalibrationFormat("vicon", "xml", xml_files.is_vicon, xml_files.read_vicon, "*.xcp"),
    CalibrationFormat("optitrack", "xml", xml_files.is_optitrack, xml_files.read_optitrack, "*.mcal"),
    CalibrationFormat(
        "panoptic", "json", data_set_files.is_panoptic, data_set_files.read_panoptic, "calibration_*.json"
    ),
    CalibrationFormat("shelf", "json", data_set_files.is_shelf, data_set_files.read_shelf, "calibration_shelf.json"),
    CalibrationFormat(
        "mvhumannet", "json", data_set_files.is_mvhumannet, data_set_files.read_mvhumannet, "camera_extrinsics.json"
    ),
    CalibrationFormat("aist", "json", data_set_files.is_aist, data_set_files.read_aist, "setting*.json"),
    CalibrationFormat("humman", "json", data_set_files.is_humman, data_set_files.read_humman, "cameras.json"),
    CalibrationFormat(
        "opencap", "pickle", camera_files.is_opencap, camera_files.read_opencap, "cameraIntrinsicsExtrinsics.pickle"
    ),
    CalibrationFormat(
        "opencv", "yaml", camera_files.is_opencv_yaml, camera_files.read_opencv_cameras, "CAM.yml, or intri.yml"
    ),
)
"""All formats; of two that tell a file the first is taken."""
# Files of these names are settings of the same tools.
_NOT_CALIBRATIONS = ("config.toml", "charuco.toml", "project_settings.toml", "pyproject.toml")


@dataclass(frozen=True, eq=False)
class Calibration:
    """Cameras of a calibration file in this package's conventions: metres, +y up, pixel centres at +0.5.

    Attributes:
        path: of the file.
        format: name of its format.
        cameras: pinhole cameras by name, of the undistorted images.
        distortions: of the cameras whose images are distorted.
        notes: sentences about what was guessed or left out.
    """

    path: Path
    format: str
    cameras: Mapping[str, Camera]
    distortions: Mapping[str, Distortion]
    notes: tuple[str, ...] = ()


def read_calibration(
    path: str | Path,
    *,
    units: str | None = None,
    up: str | None = None,
    sizes: Mapping[str, tuple[int, int]] | None = None,
) -> Calibration:
    """Read a calibration of Pose2Sim, anipose, FreeMoCap, caliscope, Qualisys, Vicon, OptiTrack, OpenCap, CMU Panoptic,
    Shelf, MVHumanNet, AIST++, HuMMan or OpenCV's YAML.

    Args:
        path: the file, or a folder with one.
        units: unit of its lengths (m, cm, mm, inch); None: that of the format, else guessed by the cameras' distances.
        up: axis of its world that points up (x, y, z, -x, -y, -z); None: that of the format, else of the pictures.
        sizes: width and height of the images by a name that tells the camera. Intrinsics follow images of another
            resolution; images that are up to 2 % larger or smaller on one side keep those of the file.

    Raises:
        InputError: no calibration, a broken one, images of another shape than calibrated.

    Example:
        >>> calibration = read_calibration("session/calibration")  # doctest: +SKIP
        >>> calibration.format, list(calibration.cameras)  # doctest: +SKIP
        ('qualisys', ['cam_01', 'cam_02', 'cam_03', 'cam_04'])
    """
    if units is not None:
        require_choice("--units", units, tuple(UNITS))
    if up is not None:
        require_choice("--up", up, tuple(AXES))
    path = Path(path)
    file, format, rig = _opened(path)
    source = f"calibration {file}"
    if not rig.cameras:
        raise InputError(source, expected="at least one calibrated camera", received="none")
    metres, notes = metres_of(rig, units, source=source)
    turn, turned = upright_from_world(rig, up, source=source)
    # Names of images, matched to those of the file.
    names = [camera.name for camera in rig.cameras]
    matched = matched_names(names, list(sizes or {}))
    cameras, distortions = {}, {}
    notes = [*rig.notes, *notes, *turned]
    for camera in rig.cameras:
        shown = None if sizes is None or camera.name not in matched else sizes[matched[camera.name]]
        K, size, resized = _sized(camera, shown, source=source)
        notes += resized
        # x_cam = R X + T with X = turn^T X_y metres-scaled: the rotation takes the turn, the translation the unit.
        cameras[camera.name] = pinhole(camera.name, K, camera.R @ turn.T, metres * camera.T, size, opencv_pixels=False)
        lens = Distortion.from_opencv(camera.dist, subject=f"{source}: camera {camera.name}", model=camera.model)
        if lens is not None:
            distortions[camera.name] = lens
    if len(cameras) < len(names):
        twice = sorted({name for name in names if names.count(name) > 1})
        raise InputError(source, expected="every name once", received=f"{', '.join(twice[:5])} several times")
    return Calibration(file, format.name, cameras, distortions, tuple(notes))


def find_calibration(folder: Path) -> Path | None:
    """Return the calibration file in a folder; None without one.

    Of several the one whose name has "calib" is taken, or "cam", else the first in alphabetical order.
    """
    most_candidates = 200  # files of a folder that are opened in the search for a calibration
    suffixes = {suffix for own, _ in _LOADERS.values() for suffix in own}
    files = [path for path in sorted(folder.iterdir()) if path.suffix.lower() in suffixes and path.is_file()]
    # Of a candidate: 500 cameras of the Panoptic studio take 250 kB.
    most_bytes = 16 << 20
    files = [p for p in files if p.name.lower() not in _NOT_CALIBRATIONS and p.stat().st_size <= most_bytes]
    files.sort(key=lambda path: ("calib" not in path.name.lower(), "cam" not in path.name.lower(), path.name))
    return next((path for path in files[:most_candidates] if format_of(path) is not None), None)


def format_of(path: Path) -> CalibrationFormat | None:
    """Recognise the format of a file by its content; None if no format fits or the file cannot be read."""
    try:
        return _recognised(path)[0]
    except (InputError, OSError, TypeError, ValueError, KeyError, AttributeError):
        return None


def _recognised(path: Path) -> tuple[CalibrationFormat | None, Any]:
    """Open a calibration file; return its format, None where no format recognises it, and its content."""
    kind = next((kind for kind, (suffixes, _) in _LOADERS.items() if path.suffix.lower() in suffixes), None)
    if kind is None:
        return None, None
    content = _LOADERS[kind][1](path)
    return next((one for one in FORMATS if one.kind == kind and one.tells(content)), None), content


def _opened(path: Path) -> tuple[Path, CalibrationFormat, RigFile]:
    """Return the file of a path, its format and its cameras in the file's own terms."""
    file = find_calibration(path) if path.is_dir() else path
    known = ", ".join(f"{one.name} ({one.files})" for one in FORMATS)
    if file is None:
        raise InputError(f"folder {path}", expected=f"a calibration file of {known}", received="none that is known")
    try:
        format, content = _recognised(file)
        if format is None:
            raise InputError(f"calibration {file}", expected=f"a file of {known}", received="content of none of them")
        return file, format, format.read(file, content)
    except InputError:
        raise
    except (TypeError, ValueError, KeyError, AttributeError, IndexError, OverflowError) as error:
        raise InputError(
            f"calibration {file}",
            expected="the layout of its format",
            received=f"{type(error).__name__}: {error}"[:200],
        ) from None


def _sized(
    camera: FileCamera, shown: tuple[int, int] | None, *, source: str
) -> tuple[np.ndarray, tuple[int, int], list[str]]:
    """Return the intrinsics with pixel centres at +0.5, the image size, and notes, for images of the size `shown`."""
    K = camera.K.copy()
    if not camera.centred:
        K[:2, 2] += 0.5 * K[2, 2]
    subject = f"{source}: camera {camera.name}"
    if camera.size is None:
        if shown is not None:
            return K, shown, []
        # Principal points lie near the middle of the image.
        middle = (max(1, round(2 * float(K[0, 2]))), max(1, round(2 * float(K[1, 2]))))
        return (
            K,
            middle,
            [f"camera {camera.name}: image size taken for {middle[0]} x {middle[1]}, by the principal point"],
        )
    if shown is None or shown == camera.size:
        return K, camera.size, []
    wide, high = shown[0] / camera.size[0], shown[1] / camera.size[1]
    received = f"{shown[0]} x {shown[1]}"
    # A codec or a converter changes some pixels of one side; a change of resolution changes both alike.
    if abs(wide - high) > 0.02 * max(wide, high):
        turned = shown == camera.size[::-1]
        raise InputError(
            subject,
            expected=f"images of {camera.size[0]} x {camera.size[1]} pixels, as calibrated, or of their shape",
            received=received,
            remedy="rotate the images as they were when the camera was calibrated" if turned else "",
        )
    if max(abs(wide - 1), abs(high - 1)) <= 0.02:
        note = f"camera {camera.name}: images of {received} pixels, calibrated {camera.size[0]} x {camera.size[1]}"
        return K, camera.size, [f"{note}; taken for resized ones"]
    return scaled_intrinsics(K, (wide, high)), shown, []
