"""Writes the known scene in the exact layout of each data set."""

from __future__ import annotations

import json
import pickle
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from smplxpp.body import load_body
from tests.capture.scene import LENS, Scene


def _save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path, **({"quality": 98, "subsampling": 0} if path.suffix == ".jpg" else {}))


def _json(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def _opencv_K(camera) -> np.ndarray:
    """OpenCV's calibration puts pixel centres at whole numbers."""
    K = camera.K.copy()
    K[:2, 2] -= 0.5
    return K


def _turn(rotvec: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(np.array(rotvec))  # a copy: scipy takes no read-only arrays


def _rotvec(matrix: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(matrix).as_rotvec()


def write_simple(scene: Scene, root: Path) -> Path:
    """Our own layout, photographs through a lens."""
    entries = []
    for name, camera in scene.cameras.items():
        pose = camera.cam_from_world
        entry = {"name": name, "w": camera.width, "h": camera.height, "K": camera.K.tolist()}
        entry |= {"R": pose[:3, :3].tolist(), "T": pose[:3, 3].tolist()}
        entries.append(entry | ({"dist": list(scene.lens)} if scene.lens else {}))
    for (name, frame), image in scene.photographs.items():
        _save(root / f"rgbs/{name}/{name}_rgb{frame:06d}.jpg", image)
        _save(root / f"masks/{name}/{name}_mask{frame:06d}.png", scene.masks[name, frame])
    _json(root / "cameras.json", {"cameras": entries})
    _json(root / "capture.json", {"background": None})
    (root / "params").mkdir()
    for frame in range(len(scene.params)):
        scene.params.frame(frame).save(root / f"params/{frame:06d}.npz")
    return root


def write_actorshq(scene: Scene, root: Path) -> Path:
    """ActorsHQ: camera-to-world, intrinsics in units of the size, background removed."""
    rows = ["name,w,h,rx,ry,rz,tx,ty,tz,fx,fy,px,py"]
    for name, camera in scene.cameras.items():
        world_from_cam = np.linalg.inv(camera.cam_from_world)
        w, h, K = camera.width, camera.height, camera.K
        numbers = [*_rotvec(world_from_cam[:3, :3]), *world_from_cam[:3, 3]]
        numbers += [K[0, 0] / w, K[1, 1] / h, K[0, 2] / w, K[1, 2] / h]
        rows.append(",".join([name, str(w), str(h), *map(repr, map(float, numbers))]))
    folder = root / "Actor01" / "Sequence1" / "4x"
    for name, frame in scene.photographs:
        _save(folder / f"rgbs/{name}/{name}_rgb{frame:06d}.jpg", scene.on_black(name, frame))
        _save(folder / f"masks/{name}/{name}_mask{frame:06d}.png", scene.masks[name, frame])
    (folder / "calibration.csv").write_text("\n".join(rows) + "\n")
    (folder.parent / "aabbs.csv").write_text("")
    _smpl_params(scene, folder.parent / "smpl_params.npz")
    return folder.parent


def _smpl_params(scene: Scene, path: Path) -> None:
    """AvatarReX's and THuman4's file: one row of betas, no eyes."""
    p = scene.params
    names = ("global_orient", "transl", "body_pose", "jaw_pose", "expression", "left_hand_pose", "right_hand_pose")
    arrays = {name: getattr(p, name).astype(np.float32) for name in names}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, betas=p.betas[:1].astype(np.float32), **arrays)


def _tsinghua_calibration(scene: Scene) -> dict:
    return {
        name: {
            "K": _opencv_K(camera).ravel().tolist(),
            "R": camera.cam_from_world[:3, :3].ravel().tolist(),
            "T": camera.cam_from_world[:3, 3].tolist(),
            "distCoeff": list(scene.lens or (0.0,) * 5),
            "imgSize": [camera.width, camera.height],
            "rectifyAlpha": 0.0,
        }
        for name, camera in scene.cameras.items()
    }


def write_avatarrex(scene: Scene, root: Path) -> Path:
    """AvatarReX: calibration_full.json, mattes as JPEG in CAM/mask/pha."""
    _json(root / "calibration_full.json", _tsinghua_calibration(scene))
    for (name, frame), image in scene.photographs.items():
        _save(root / name / f"{frame:08d}.jpg", image)
        _save(root / name / "mask" / "pha" / f"{frame:08d}.jpg", scene.masks[name, frame])
    (root / "missing_img_files.txt").write_text("")
    _smpl_params(scene, root / "smpl_params.npz")
    return root


def write_thuman4(scene: Scene, root: Path) -> Path:
    """THuman4.0: calibration.json, images/camNN, masks/camNN."""
    _json(root / "calibration.json", _tsinghua_calibration(scene))
    for (name, frame), image in scene.photographs.items():
        _save(root / "images" / name / f"{frame:08d}.jpg", image)
        _save(root / "masks" / name / f"{frame:08d}.jpg", scene.masks[name, frame])
    _smpl_params(scene, root / "smpl_params.npz")
    return root


def write_talkbody4d(scene: Scene, root: Path) -> Path:
    """TalkBody4D: calibration in JSON, distorted images on black, mattes in `mattings/`, Rh and Th; its y is down."""
    cameras, poses = {}, {}
    for k, (name, camera) in enumerate(scene.cameras.items()):
        size = [camera.width, camera.height]
        cameras[name] = {
            "model": "standard",
            "image_size": size,
            "K": _opencv_K(camera).tolist(),
            "dist": [[*scene.lens]],
        }
        pose = camera.cam_from_world @ np.diag([1.0, -1, -1, 1])
        first = next(iter(scene.cameras))
        poses[name if k == 0 else f"{name}_to_{first}"] = {"R": pose[:3, :3].tolist(), "T": pose[:3, 3].tolist()}
    _json(root / "calibration.json", {"cameras": cameras, "camera_poses": poses})
    for name, frame in scene.photographs:
        _save(root / "images" / name / f"{frame:06d}.jpg", scene.on_black(name, frame))
        _save(root / "mattings" / name / f"{frame:06d}.png", scene.masks[name, frame])
    p, joint = scene.params, load_body().rest_joints(scene.params)[:, 0]
    outer = Rotation.from_rotvec([0.3, -0.8, 0.2])
    for frame in range(len(p)):
        inner = outer.inv() * _turn(p.global_orient[frame])
        shift = np.array([0.02, -0.3, 0.1])
        values = {name: getattr(p, name)[frame : frame + 1].tolist() for name in _BLOCKS if name != "global_orient"}
        values |= {"betas": p.betas[:1].tolist(), "expression": p.expression[frame : frame + 1].tolist()}
        values |= {"global_orient": [inner.as_rotvec().tolist()], "transl": [shift.tolist()]}
        values |= {"Rh": [(_Y_DOWN * outer).as_rotvec().tolist()]}
        values |= {"Th": [_Y_DOWN.apply(joint[frame] + p.transl[frame] - outer.apply(joint[frame] + shift)).tolist()]}
        _json(root / "smplx" / f"{frame:06d}.json", values)
    return root


_Y_DOWN = Rotation.from_matrix(np.diag([1.0, -1, -1]))
_BLOCKS = ("global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose", "left_hand_pose", "right_hand_pose")


def write_4ddress(scene: Scene, root: Path) -> Path:
    """4D-Dress: everything in pickles; extrinsics of OpenCV, which its loader turns into PyTorch3D's axes."""
    take = root / "00122" / "Outer" / "Take9"

    def dump(path: Path, content: object) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(content))

    cameras = {
        name: {"intrinsics": camera.K, "extrinsics": camera.cam_from_world[:3]}
        for name, camera in scene.cameras.items()
    }
    dump(take / "Capture" / "cameras.pkl", cameras)
    dump(take / "basic_info.pkl", {"scan_frames": ["00011", "00012"], "rotation": np.eye(3), "offset": None})
    for (name, frame), image in scene.photographs.items():
        number = f"{frame + 11:05d}"
        _save(take / "Capture" / name / "images" / f"capture-f{number}.png", image)
        _save(take / "Capture" / name / "masks" / f"mask-f{number}.png", scene.masks[name, frame])
    for frame, mesh in scene.meshes.items():
        number = f"{frame + 11:05d}"
        dump(take / "Meshes_pkl" / f"mesh-f{number}.pkl", {"vertices": mesh.vertices, "faces": mesh.faces, "uvs": None})
        one = scene.params.frame(frame)
        fit = {name: getattr(one, name)[0] for name in (*_BLOCKS, "betas", "expression", "transl")}
        dump(take / "SMPLX" / f"mesh-f{number}_smplx.pkl", fit)
    return take


def write_neus2(scene: Scene, root: Path) -> Path:
    """NeuS2, a dynamic scene: one JSON a frame in train/, RGBA images; camera-to-world."""
    for frame in scene.meshes:
        entries = []
        for k, (name, camera) in enumerate(scene.cameras.items()):
            file = Path("images") / f"{frame:06d}" / f"image_c_{k:03d}_f_{frame:06d}.png"
            alpha = scene.masks[name, frame][..., None]
            _save(root / file, np.concatenate([scene.photographs[name, frame], alpha], axis=-1))
            K = np.eye(4)
            K[:3, :3] = camera.K
            pose = np.linalg.inv(camera.cam_from_world)
            entries.append(
                {"file_path": f"../{file}", "transform_matrix": pose.tolist(), "intrinsic_matrix": K.tolist()}
            )
        size = {"w": camera.width, "h": camera.height}
        unit = {"aabb_scale": 1.0, "scale": 0.5, "offset": [0.5, 0.5, 0.5]}
        _json(root / "train" / f"transform_{frame:06d}.json", {"from_na": True, **size, **unit, "frames": entries})
    return root


def write_instant_ngp(scene: Scene, root: Path) -> Path:
    """Instant-NGP, a still: transforms.json with OpenGL's camera axes and one lens for all."""
    entries = []
    for name, camera in scene.cameras.items():
        _save(
            root / "images" / f"{name}.png",
            np.concatenate([scene.photographs[name, 0], scene.masks[name, 0][..., None]], -1),
        )
        pose = np.linalg.inv(camera.cam_from_world) @ np.diag([1, -1, -1, 1])
        K = camera.K
        lens = dict(zip(("k1", "k2", "p1", "p2", "k3"), scene.lens, strict=True))
        own = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
        entries.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist(), **own, **lens})
    _json(root / "transforms.json", {"w": camera.width, "h": camera.height, "frames": entries})
    return root


def write_easymocap(scene: Scene, root: Path) -> Path:
    """EasyMocap: OpenCV's YAML as its own writer prints it, six digits; SMPL poses with Rh and Th."""
    root.mkdir(parents=True, exist_ok=True)

    def matrix(key: str, value: np.ndarray) -> str:
        data = ", ".join(f"{v:.6f}" for v in np.ravel(value))
        rows, cols = np.shape(value)
        return f"{key}: !!opencv-matrix\r\n  rows: {rows}\r\n  cols: {cols}\r\n  dt: d\r\n  data: [{data}]\r\n"

    head = "%YAML:1.0\r\n---\r\nnames:\r\n" + "".join(f'  - "{name}"\r\n' for name in scene.cameras)
    intri, extri = head, head
    for name, camera in scene.cameras.items():
        pose = camera.cam_from_world
        intri += matrix(f"K_{name}", _opencv_K(camera)) + matrix(f"dist_{name}", np.array([scene.lens]))
        extri += matrix(f"R_{name}", _rotvec(pose[:3, :3])[:, None]) + matrix(f"Rot_{name}", pose[:3, :3])
        extri += matrix(f"T_{name}", pose[:3, 3:])
    (root / "intri.yml").write_bytes(intri.encode())
    (root / "extri.yml").write_bytes(extri.encode())
    for (name, frame), image in scene.photographs.items():
        _save(root / "images" / name / f"{frame:06d}.jpg", image)
        _save(root / "mask" / name / f"{frame:06d}.png", scene.masks[name, frame])
    p, joint = scene.params, load_body().rest_joints(scene.params)[:, 0]
    for frame in range(len(p)):
        turn = _turn(p.global_orient[frame])
        shift = p.transl[frame] + joint[frame] - turn.apply(joint[frame])
        poses = np.concatenate([np.zeros(3), p.body_pose[frame], np.zeros(6)])
        record = {"id": 0, "Rh": [p.global_orient[frame].tolist()], "Th": [shift.tolist()]}
        record |= {"poses": [poses.tolist()], "shapes": [p.betas[frame].tolist()], "body": "open_body"}
        _json(root / "output" / "smpl" / "smpl" / f"{frame:06d}.json", [record])
    return root


def _colmap_images(scene: Scene) -> list[tuple[int, np.ndarray, np.ndarray, str]]:
    rows = []
    for k, (name, camera) in enumerate(scene.cameras.items()):
        x, y, z, w = Rotation.from_matrix(camera.cam_from_world[:3, :3]).as_quat()
        rows.append((k + 1, np.array([w, x, y, z]), camera.cam_from_world[:3, 3], f"{name}/000000.jpg"))
    return rows


def _colmap_files(scene: Scene, root: Path) -> None:
    for (name, frame), image in scene.photographs.items():
        _save(root / "images" / name / f"{frame:06d}.jpg", image)
        _save(root / "masks" / name / f"{frame:06d}.jpg.png", scene.masks[name, frame])


def write_colmap_text(scene: Scene, root: Path) -> Path:
    """COLMAP, a rig whose first frame was reconstructed: text, model OPENCV."""
    _colmap_files(scene, root)
    model = root / "sparse" / "0"
    model.mkdir(parents=True)
    cameras, images = ["# Camera list with one line of data per camera:"], ["# Image list", "# ..."]
    for (number, q, t, name), camera in zip(_colmap_images(scene), scene.cameras.values(), strict=True):
        K = camera.K
        numbers = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *scene.lens[:4]]
        cameras.append(f"{number} OPENCV {camera.width} {camera.height} " + " ".join(map(repr, map(float, numbers))))
        images += [f"{number} " + " ".join(map(repr, map(float, [*q, *t]))) + f" {number} {name}"]
        images += ["" if number == 1 else "10.5 20.5 -1 30.0 40.0 7"]
    (model / "cameras.txt").write_text("\n".join(cameras) + "\n")
    (model / "images.txt").write_text("\n".join(images) + "\n")
    (model / "points3D.txt").write_text("")
    return root


def write_colmap_binary(scene: Scene, root: Path) -> Path:
    """The same in binary files with model SIMPLE_PINHOLE, and points that have to be skipped."""
    _colmap_files(scene, root)
    model = root / "sparse"
    model.mkdir(parents=True)
    cameras, images = struct.pack("<Q", len(scene.cameras)), struct.pack("<Q", len(scene.cameras))
    for (number, q, t, name), camera in zip(_colmap_images(scene), scene.cameras.values(), strict=True):
        K = camera.K
        cameras += struct.pack("<iiQQ3d", number, 0, camera.width, camera.height, K[0, 0], K[0, 2], K[1, 2])
        images += struct.pack("<i7di", number, *q, *t, number) + name.encode() + b"\0"
        images += struct.pack("<Q", number) + struct.pack("<ddq", 1.0, 2.0, -1) * number
    (model / "cameras.bin").write_bytes(cameras)
    (model / "images.bin").write_bytes(images)
    return root


def write_rig(scene: Scene, root: Path) -> Path:
    """A laboratory's rig: Pose2Sim's TOML with z up, folders named otherwise than its cameras, no parameters."""
    root.mkdir(parents=True, exist_ok=True)
    z_up = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # y of this package from the file's axes
    text = ""
    for name, camera in scene.cameras.items():
        R, T = camera.cam_from_world[:3, :3] @ z_up, camera.cam_from_world[:3, 3]
        text += f'[{name}]\nname = "{name}"\nsize = [ {camera.width}.0, {camera.height}.0]\n'
        text += f"matrix = {_opencv_K(camera).tolist()}\ndistortions = {list(scene.lens or (0.0,) * 4)}\n"
        text += f"rotation = {_rotvec(R).tolist()}\ntranslation = {T.tolist()}\nfisheye = false\n\n"
    (root / "calibration").mkdir()
    (root / "calibration" / "Calib_board.toml").write_text(text + "[metadata]\nadjusted = false\nerror = 0.0\n")
    for (name, frame), image in scene.photographs.items():
        _save(root / "images" / f"{name.lower()}_img" / f"{name}_{frame:06d}.jpg", image)
        _save(root / "masks" / f"{name.lower()}" / f"{frame:06d}.png", scene.masks[name, frame])
    return root


# Format, writer, and the lens that the layout can express.
WRITERS: dict[str, tuple[str, Callable[[Scene, Path], Path], tuple[float, ...] | None]] = {
    "simple": ("simple", write_simple, LENS),
    "actorshq": ("actorshq", write_actorshq, None),
    "talkbody4d": ("talkbody4d", write_talkbody4d, LENS),
    "avatarrex": ("avatarrex", write_avatarrex, LENS),
    "thuman4": ("thuman4", write_thuman4, None),
    "4ddress": ("4ddress", write_4ddress, None),
    "neus2": ("neus2", write_neus2, None),
    "instant-ngp": ("neus2", write_instant_ngp, LENS),
    "easymocap": ("easymocap", write_easymocap, LENS),
    "colmap-text": ("colmap", write_colmap_text, (*LENS[:4], 0.0)),
    "colmap-binary": ("colmap", write_colmap_binary, None),
    "rig": ("rig", write_rig, LENS),
}
