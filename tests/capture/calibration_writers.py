"""Calibration files of many tools for known cameras, each written from its tool's own projection."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from smplxpp.core import Camera

# Directions of each world's x, y, z in ours: metres, y up.
Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
Y_DOWN = np.diag([1.0, -1.0, -1.0])
FLIP = np.diag([1.0, -1.0, -1.0])
DIST = (-0.12, 0.05, 0.001, -0.002)

Rig = dict[str, Camera]
Writer = Callable[[Rig, Path], Path]


def opencv_K(camera: Camera) -> np.ndarray:
    """Intrinsics with pixel centres at whole numbers."""
    K = camera.K.copy()
    K[:2, 2] -= 0.5
    return K


def pose_in(camera: Camera, axes: np.ndarray, metres: float) -> tuple[np.ndarray, np.ndarray]:
    """R and T of the camera in a world of other axes and units."""
    return camera.cam_from_world[:3, :3] @ axes, camera.cam_from_world[:3, 3] / metres


def _toml(rig: Rig, axes: np.ndarray, metres: float, more: str, *, decimals: bool = False, matrix: bool = False) -> str:
    text = ""
    for k, (name, camera) in enumerate(rig.items()):
        R, T = pose_in(camera, axes, metres)
        size = f"[{camera.width}.0, {camera.height}.0]" if decimals else f"[{camera.width}, {camera.height}]"
        turn = R.tolist() if matrix else Rotation.from_matrix(R).as_rotvec().tolist()
        text += (
            f"[{more.format(k=k, name=name).splitlines()[0]}]\nsize = {size}\nmatrix = {opencv_K(camera).tolist()}\n"
        )
        text += f"distortions = {list(DIST)}\nrotation = {turn}\ntranslation = {T.tolist()}\n"
        text += "\n".join(more.format(k=k, name=name).splitlines()[1:]) + "\n\n"
    return text


def pose2sim(rig: Rig, folder: Path) -> Path:
    more = 'cam_{k}\nname = "{name}"\nfisheye = false'
    path = folder / "Calib_scene.toml"
    path.write_text(_toml(rig, Z_UP, 1.0, more, decimals=True) + "[metadata]\nadjusted = false\nerror = 0.0\n")
    return path


def anipose(rig: Rig, folder: Path) -> Path:
    """Millimetres of the board, which the file does not say."""
    path = folder / "calibration.toml"
    path.write_text(_toml(rig, Z_UP, 1e-3, 'cam_{k}\nname = "{name}"') + "[metadata]\nerror = 0.4\n")
    return path


def freemocap(rig: Rig, folder: Path) -> Path:
    path = folder / "recording_camera_calibration.toml"
    more = '{name}\nname = "{name}"\nworld_position = [0.0, 0.0, 0.0]'
    path.write_text(_toml(rig, Y_DOWN, 1e-3, more) + "[metadata]\ncharuco_square_size = 58.0\n")
    return path


def caliscope(rig: Rig, folder: Path) -> Path:
    """Cameras have numbers; one has no pose yet."""
    path = folder / "camera_array.toml"
    numbered = {str(k + 1): camera for k, camera in enumerate(rig.values())}
    text = _toml(
        numbered, Z_UP, 1.0, "cameras.{name}\ncam_id = {name}\nrotation_count = 0\nignore = false", matrix=True
    )
    path.write_text(text + "[cameras.9]\ncam_id = 9\nrotation_count = 0\nsize = [640, 480]\nignore = true\n")
    return path


def qualisys(rig: Rig, folder: Path) -> Path:
    """Subpixels of a sensor of which a window is shown; a marker camera beside the video cameras."""
    left, top = 16, 8
    text = '<?xml version="1.0"?>\n<calibration source="x"><results std-dev="1."/><cameras>\n'
    for model, (name, camera) in [
        ("Miqus M3", next(iter(rig.items()))),
        *(("Miqus Video", one) for one in rig.items()),
    ]:
        R, T = pose_in(camera, Z_UP, 1e-3)
        K, place = opencv_K(camera), -R.T @ T
        rows = "".join(f' r{i + 1}{j + 1}="{(FLIP @ R)[i, j]!r}"' for i in range(3) for j in range(3))
        serial = name if "Video" in model else "marker"
        text += f'<camera active="1" model="{model}" serial="{serial}" viewrotation="0">'
        box = f'left="{left}" top="{top}" right="{left + camera.width - 1}" bottom="{top + camera.height - 1}"'
        text += f"<fov_marker {box}/><fov_video {box}/>"
        text += f'<transform{rows} x="{place[0]!r}" y="{place[1]!r}" z="{place[2]!r}"/>'
        text += f'<intrinsic focalLengthU="{64 * K[0, 0]!r}" focalLengthV="{64 * K[1, 1]!r}" '
        text += f'centerPointU="{64 * (K[0, 2] + left)!r}" centerPointV="{64 * (K[1, 2] + top)!r}" '
        k1, k2, p1, p2 = (64 * value for value in DIST)
        text += f'radialDistortion1="{k1!r}" radialDistortion2="{k2!r}" radialDistortion3="0" '
        text += f'tangentalDistortion1="{p1!r}" tangentalDistortion2="{p2!r}"/></camera>\n'
    path = folder / "rig.qca.txt"
    path.write_text(text.replace("np.float64(", "").replace(')"', '"') + "</cameras></calibration>\n")
    return path


def vicon(rig: Rig, folder: Path) -> Path:
    """Without lens: Vicon's polynomial runs the other way and is tested by itself."""
    text = '<?xml version="1.0" encoding="UTF-8" standalone="no"?>\n<Cameras>\n'
    for name, camera in rig.items():
        R, T = pose_in(camera, Z_UP, 1e-3)
        x, y, z, w = Rotation.from_matrix(R).as_quat().tolist()
        K, place = opencv_K(camera), (-R.T @ T).tolist()
        text += f'<Camera DEVICEID="{name}" TYPE="Vue 2 Video" SENSOR_SIZE="{camera.width} {camera.height}" '
        text += f'PIXEL_ASPECT_RATIO="{float(K[0, 0] / K[1, 1])}"><KeyFrames><KeyFrame FOCAL_LENGTH="{float(K[0, 0])}" '
        text += f'FRAME="0" ORIENTATION="{x} {y} {z} {w}" POSITION="{place[0]} {place[1]} {place[2]}" '
        text += f'PRINCIPAL_POINT="{float(K[0, 2])} {float(K[1, 2])}" WORLD_ERROR="0.5" '
        text += f'VICON_RADIAL2="ViconRadial2 {float(K[0, 2])} {float(K[1, 2])} 0 0 0"/></KeyFrames></Camera>\n'
    path = folder / "take.xcp"
    path.write_text(text + "</Cameras>\n")
    return path


def optitrack(rig: Rig, folder: Path) -> Path:
    """UTF-16, metres, y up; the camera looks along its own -z."""
    text = '<?xml version="1.0" encoding="UTF-16LE"?>\n<calibrationProfile version="1"><Calibration><Cameras>\n'
    for name, camera in rig.items():
        R, T = pose_in(camera, np.eye(3), 1.0)
        K, place, turn = opencv_K(camera), (-R.T @ T).tolist(), (FLIP @ R).T.ravel().tolist()
        orient = " ".join(f'OrientMatrix{k}="{value}"' for k, value in enumerate(turn))
        text += f'<Camera Serial="{name}"><Attributes ImagerPixelWidth="{camera.width}" '
        text += f'ImagerPixelHeight="{camera.height}"/><IntrinsicStandardCameraModel LensCenterX="{float(K[0, 2])}" '
        text += f'LensCenterY="{float(K[1, 2])}" HorizontalFocalLength="{float(K[0, 0])}" '
        text += f'VerticalFocalLength="{float(K[1, 1])}" k1="{DIST[0]}" k2="{DIST[1]}" k3="0.0" '
        text += f'TangentialX="{DIST[2]}" TangentialY="{DIST[3]}"/>'
        text += f'<Extrinsic X="{place[0]}" Y="{place[1]}" Z="{place[2]}" {orient}/></Camera>\n'
    path = folder / "rig.mcal"
    path.write_text(text + "</Cameras></Calibration></calibrationProfile>\n", encoding="utf-16")
    return path


def panoptic(rig: Rig, folder: Path) -> Path:
    """Centimetres, y down; VGA cameras beside the HD cameras."""
    cameras = []
    for kind, (name, camera) in [("vga", next(iter(rig.items()))), *(("hd", one) for one in rig.items())]:
        R, T = pose_in(camera, Y_DOWN, 1e-2)
        numbers = {"K": opencv_K(camera).tolist(), "distCoef": [*DIST, 0.0], "R": R.tolist(), "t": T[:, None].tolist()}
        about = {"name": name if kind == "hd" else "01_01", "type": kind, "resolution": [camera.width, camera.height]}
        cameras.append({**about, "panel": 0, "node": 1, **numbers})
    path = folder / "calibration_160906_band1.json"
    path.write_text(json.dumps({"calibDataSource": "x", "cameras": cameras}))
    return path


def shelf(rig: Rig, folder: Path) -> Path:
    """Millimetres, z up, the position as T; sizes are not in the file."""
    content = {}
    for k, camera in enumerate(rig.values()):
        R, T = pose_in(camera, Z_UP, 1e-3)
        K = opencv_K(camera)
        lens = {"k": [[DIST[0]], [DIST[1]], [0.0]], "p": [[DIST[2]], [DIST[3]]]}
        focal = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        content[str(k)] = {**lens, "R": R.tolist(), "T": (-R.T @ T)[:, None].tolist(), **focal}
    path = folder / "calibration_shelf.json"
    path.write_text(json.dumps(content))
    return path


def mvhumannet(rig: Rig, folder: Path) -> Path:
    """One intrinsic matrix for all, thousandths of a scale, z down."""
    axes, scale, content = -Z_UP @ np.diag([-1.0, 1.0, 1.0]), 1.8, {}
    for k, (name, camera) in enumerate(rig.items()):
        R, T = pose_in(camera, axes, 1e-3 * scale)
        pose = {"rotation": R.tolist(), "translation": T.tolist(), "camera_pos": (-R.T @ T).tolist()}
        content[f"{k}_{name}.png"] = pose
    (folder / "camera_scale.pkl").write_bytes(pickle.dumps(scale))
    K = opencv_K(next(iter(rig.values()))).tolist()
    (folder / "camera_intrinsics.json").write_text(json.dumps({"intrinsics": K, "dist": list(DIST)}))
    path = folder / "camera_extrinsics.json"
    path.write_text(json.dumps(content))
    return path


def opencap(rig: Rig, folder: Path) -> Path:
    """A pickle a camera, millimetres, y down."""
    for name, camera in rig.items():
        R, T = pose_in(camera, Y_DOWN, 1e-3)
        content = {
            "distortion": np.array([[*DIST, 0.0]]),
            "intrinsicMat": opencv_K(camera),
            "imageSize": np.array([[float(camera.height)], [float(camera.width)]]),
            "rotation": R,
            "translation": T[:, None],
            "rotation_EulerAngles": Rotation.from_matrix(R).as_rotvec()[:, None],
        }
        path = folder / "Videos" / name / "cameraIntrinsicsExtrinsics.pickle"
        path.parent.mkdir(parents=True)
        path.write_bytes(pickle.dumps(content))
    return path


def opencv(rig: Rig, folder: Path) -> Path:
    """A YAML a camera, as `cv2.FileStorage` writes it, z up."""

    def matrix(key: str, value: np.ndarray) -> str:
        rows, cols = np.shape(value)
        data = ", ".join(repr(float(v)) for v in np.ravel(value))
        return f"{key}: !!opencv-matrix\n   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ {data} ]\n"

    for name, camera in rig.items():
        R, T = pose_in(camera, Z_UP, 1.0)
        text = f"%YAML:1.0\n---\nimage_width: {camera.width}\nimage_height: {camera.height}\n"
        text += matrix("camera_matrix", opencv_K(camera)) + matrix("distortion_coefficients", np.array([DIST]))
        path = folder / f"{name}.yml"
        path.write_text(text + matrix("R", R) + matrix("T", T[:, None]))
    return path


def aist(rig: Rig, folder: Path) -> Path:
    """A list of aniposelib's tables, centimetres, y up."""
    path, cameras = folder / "setting1.json", []
    for name, camera in rig.items():
        R, T = pose_in(camera, np.eye(3), 0.01)
        one = {"name": name, "size": [camera.width, camera.height], "matrix": opencv_K(camera).tolist()}
        turn = Rotation.from_matrix(R).as_rotvec().tolist()
        cameras.append(one | {"rotation": turn, "translation": T.tolist(), "distortions": [*DIST, 0.0]})
    path.write_text(json.dumps(cameras))
    return path


def humman(rig: Rig, folder: Path) -> Path:
    """Cameras by name, metres, y down; with a lens, which HuMMan's pinholes have not."""
    path, cameras = folder / "cameras.json", {}
    for name, camera in rig.items():
        R, T = pose_in(camera, Y_DOWN, 1.0)
        cameras[name] = {"K": opencv_K(camera).tolist(), "R": R.tolist(), "T": T.tolist(), "dist": [*DIST, 0.0]}
    path.write_text(json.dumps(cameras))
    return path


WRITERS: dict[str, Writer] = {
    one.__name__: one
    for one in (
        pose2sim, anipose, freemocap, caliscope, qualisys, vicon,
        optitrack, panoptic, shelf, mvhumannet, aist, humman, opencap, opencv,
    )
}  # fmt: skip
