"""The doors: valid files of every kind that the program reads, and how it reads them."""

from __future__ import annotations

import json
import pickle
import warnings
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from smplxpp.body import load_params
from smplxpp.capture import find_problems, open_capture
from smplxpp.capture.calibrations import read_calibration
from smplxpp.capture.keypoint_files import read_keypoints
from smplxpp.capture.views import read_alpha, read_color, read_normals
from smplxpp.capture.views import read_labels as read_label_image
from smplxpp.core import BodyParams, GeometryWarning, SkinWeights, TriangleMesh
from smplxpp.core.files.array_file import read_array, read_arrays, write_arrays
from smplxpp.core.files.json_file import read_json
from smplxpp.core.files.safe_pickle import dense_array, safe_load, safe_npz
from smplxpp.core.mesh_files.mesh_io import read_mesh, read_raw_mesh, write_ply
from smplxpp.detect.model_card import load_card
from smplxpp.footage.keypoints import kept_rows
from smplxpp.register import read_landmarks, write_landmarks
from smplxpp.segment.corrections import BoxCorrection, Corrections, FaceCorrection, StrokeCorrection
from smplxpp.segment.label_files import read_label_map, read_labels
from smplxpp.segment.labels import find_label_set
from tests.capture.calibration_writers import WRITERS as CALIBRATIONS
from tests.capture.scene import make_scene
from tests.capture.test_calibrations import rig
from tests.capture.test_readers import CAMERA_NAMES
from tests.capture.writers import WRITERS
from tests.fuzz.examine import Door
from tests.fuzz.motion_light_sound import face_doors, light_doors, motion_doors, sound_doors
from tests.fuzz.run_doors import run_doors

_FRAMES = 3
_OWN_LABELS = """files: lip  # and two classes of one's own
classes:
  - name: hat
    rule: rigid:head
    ids: [hat, 255]
  - {name: obi, kind: upper, ids: 7, color: "#102030", layer: 3.5}
"""


def _open_capture(root: Path) -> None:
    """What `capture check`, a build and a training ask of a capture."""
    capture = open_capture(root)
    repr(capture)
    find_problems(capture, decode=False)
    views = capture.views()
    for camera, frame in views[:1]:
        capture.image(camera, frame)
        capture.mask(camera, frame)
        capture.keypoints(camera)
    for frame in capture.frames[:1]:
        capture.params(frame)
        capture.truth_mesh(frame)


def _capture_door(name: str) -> Door:
    _, write, lens = WRITERS[name]
    cameras = CAMERA_NAMES.get(name, ("Cam1", "Cam2", "Cam3"))[:2]

    def make(folder: Path) -> Path:
        return write(make_scene(lens=lens, square_pixels=name == "colmap-binary", names=cameras), folder / "set")

    described = ("**/*.json", "**/*.csv", "**/*.yml", "**/*.txt", "**/*.bin", "**/*.pkl", "**/*.npz", "**/*.toml")
    return Door(f"capture {name}", make, _open_capture, described)


def _calibration_door(name: str) -> Door:
    """A calibration file of a rig's tool, as a user names it."""
    described = ("**/*.toml", "**/*.txt", "**/*.xcp", "**/*.mcal", "**/*.json", "**/*.pickle", "**/*.pkl", "**/*.yml")
    return Door(
        f"calibration {name}", lambda folder: CALIBRATIONS[name](rig(count=2), folder), read_calibration, described
    )


@cache
def _params() -> BodyParams:
    return make_scene(names=("Cam1", "Cam2")).params


def _write_json(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, default=lambda array: np.asarray(array).tolist()))


def _params_doors() -> list[Door]:
    rng = np.random.default_rng(0)
    T = _FRAMES

    def numbers(*shape: int) -> np.ndarray:
        return rng.normal(size=shape) * 0.1

    amass = {"poses": numbers(T, 156), "trans": numbers(T, 3), "betas": numbers(16), "gender": "neutral"}
    amass |= {"mocap_framerate": 30.0}
    smpl = {"pose": np.pad(numbers(T, 66), ((0, 0), (0, 6))), "shape": numbers(10), "trans": numbers(T, 3)}
    avatarrex = {"betas": numbers(1, 10), "global_orient": numbers(T, 3), "transl": numbers(T, 3)}
    avatarrex |= {"body_pose": numbers(T, 63), "jaw_pose": numbers(T, 3), "expression": numbers(T, 10)}
    avatarrex |= {f"{side}_hand_pose": numbers(T, 45) for side in ("left", "right")}
    person = {"id": 0, "Rh": numbers(1, 3), "Th": numbers(1, 3), "poses": numbers(1, 87), "shapes": numbers(1, 10)}
    person |= {"expression": numbers(1, 10)}
    talk = {"betas": numbers(1, 10), "expression": numbers(1, 10), "body_pose": numbers(1, 63), "Rh": numbers(1, 3)}
    talk |= {f"{name}_pose": numbers(1, 3) for name in ("jaw", "leye", "reye")} | {"Th": numbers(1, 3)}
    talk |= {f"{side}_hand_pose": numbers(1, 45) for side in ("left", "right")}
    talk |= {"global_orient": numbers(1, 3), "transl": numbers(1, 3)}
    ours = {name: np.asarray(value) for name, value in _params().as_dict().items()}
    makers = {
        "smplx npz": ("p.npz", lambda path: np.savez(path, **ours)),
        "smplx pkl": ("p.pkl", lambda path: path.write_bytes(pickle.dumps(ours, protocol=4))),
        "amass": ("p.npz", lambda path: np.savez(path, **amass)),
        "smpl": ("p.npz", lambda path: np.savez(path, **smpl)),
        "avatarrex": ("p.npz", lambda path: np.savez(path, **avatarrex)),
        "easymocap": ("000000.json", lambda path: _write_json(path, [person])),
        "talkbody4d": ("000000.json", lambda path: _write_json(path, talk)),
    }
    return [
        Door(
            f"params {name}",
            lambda folder, file=file, write=write: write(folder / file),
            lambda folder, file=file: load_params(folder / file, whose="body", up="y").frame(0),
        )
        for name, (file, write) in makers.items()
    ]


def _keypoint_doors() -> list[Door]:
    rng = np.random.default_rng(1)

    def flat(count: int, width: int = 3) -> list[float]:
        return (rng.random((count, width)) * 100).ravel().round(2).tolist()

    def rows(count: int, width: int = 3) -> list[list[float]]:
        return (rng.random((count, width)) * 100).round(2).tolist()

    hands = {f"hand_{side}_keypoints_2d": flat(21) for side in ("left", "right")}
    openpose = {"people": [{"pose_keypoints_2d": flat(25), "face_keypoints_2d": flat(70), **hands}]}
    easymocap = {"annots": [{"personID": 0, "keypoints": rows(25), "handl2d": rows(21), "handr2d": rows(21)}]}
    instance = {"keypoints": rows(133, 2), "keypoint_scores": rng.random(133).round(3).tolist()}
    mmpose = {"instance_info": [{"frame_id": k, "instances": [instance]} for k in range(2)]}
    coco = [{"image_id": k, "keypoints": flat(17), "foot_kpts": flat(6), "score": 0.9} for k in range(2)]
    points = [{"x": float(x), "y": float(y), "z": 0.0, "visibility": 1.0} for x, y in rng.random((33, 2)).round(3)]
    mediapipe = {"frames": [{"pose_landmarks": points}], "normalized": False}
    ours = {"keypoints": rng.random((2, 3, 3)), "joint_names": np.array(["pelvis", "nose", "left_hip"])}
    ours |= {"frames": np.arange(2)}
    packed = {"pose": rng.random((2, 33, 4)), "left_hand": rng.random((2, 21, 3)) * 90, "frames": np.arange(2)}
    packed |= {"normalized": np.array(False)}
    contents = {"openpose": openpose, "easymocap": easymocap, "mmpose": mmpose, "coco": coco, "mediapipe": mediapipe}
    doors = [
        Door(
            f"keypoints {name}",
            lambda folder, content=content: _write_json(folder / "000000.json", content),
            lambda folder: read_keypoints(folder / "000000.json"),
        )
        for name, content in contents.items()
    ]
    return doors + [
        Door(
            f"keypoints {name}",
            lambda folder, arrays=arrays: np.savez(folder / "k.npz", **arrays),
            lambda folder: read_keypoints(folder / "k.npz"),
        )
        for name, arrays in (("ours", ours), ("mediapipe npz", packed))
    ]


@cache
def _patch() -> tuple[TriangleMesh, np.ndarray]:
    """A small curved mesh and colours of its vertices."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 6)))
    corner = (np.arange(5)[:, None] * 7 + np.arange(6)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + 1, corner + 8], 1), np.stack([corner, corner + 8, corner + 7], 1)]
    )
    mesh = TriangleMesh(np.stack([x, y, np.sin(3 * x) * 0.2], axis=1), faces)
    return mesh, np.random.default_rng(2).integers(0, 255, (len(x), 3)).astype(np.uint8)


def _write_mesh(path: Path) -> None:
    import trimesh

    mesh, colors = _patch()
    if path.suffix == ".npz":
        np.savez(path, vertices=mesh.vertices, faces=mesh.faces, vertex_colors=colors)
    elif path.suffix == ".pkl":
        path.write_bytes(pickle.dumps({"vertices": mesh.vertices, "faces": mesh.faces, "colors": colors}, protocol=4))
    elif path.name == "binary.ply":
        write_ply(path, mesh, vertex_colors=colors, face_properties={"label": np.zeros(mesh.face_count, np.int32)})
    elif path.name == "textured.obj":
        uv = mesh.vertices[:, :2]
        lines = ["mtllib m.mtl", "usemtl cloth", *(f"v {x:.4f} {y:.4f} {z:.4f}" for x, y, z in mesh.vertices)]
        lines += [f"vt {u:.3f} {v:.3f}" for u, v in uv]
        lines += ["f " + " ".join(f"{k + 1}/{k + 1}" for k in face) for face in mesh.faces]
        path.write_text("\n".join(lines) + "\n")
        (path.parent / "m.mtl").write_text("newmtl cloth\nKd 0.5 0.5 0.5\nmap_Kd t.png\n")
        Image.fromarray(np.full((8, 8, 3), 120, np.uint8)).save(path.parent / "t.png")
    else:
        ours = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colors, process=False)
        kind = path.suffix[1:]
        written = ours.export(file_type=kind, **({"encoding": "ascii"} if kind == "ply" else {}))
        if isinstance(written, dict):
            for name, content in written.items():
                (path.parent / (path.name if name.endswith(".gltf") else name)).write_bytes(content)
        else:
            path.write_bytes(written if isinstance(written, bytes) else written.encode())


def _write_cloud(path: Path) -> None:
    mesh, colors = _patch()
    if path.suffix == ".npz":
        np.savez(path, points=mesh.vertices, normals=mesh.vertex_normals, colors=colors)
        return
    normals = dict(zip(("nx", "ny", "nz"), mesh.vertex_normals.T, strict=True))
    empty = TriangleMesh(mesh.vertices, np.empty((0, 3), np.int64))
    write_ply(path, empty, vertex_colors=colors, vertex_properties=normals)


def _mesh_doors() -> list[Door]:
    files = ("ascii.ply", "binary.ply", "textured.obj", "m.glb", "m.gltf", "m.stl", "m.off", "m.npz", "m.pkl")
    return [
        Door(
            f"mesh {file}",
            lambda folder, file=file: _write_mesh(folder / file),
            lambda f, file=file: read_mesh(f / file),
        )
        for file in files
    ] + [
        Door(
            f"cloud {file}",
            lambda folder, file=file: _write_cloud(folder / file),
            lambda f, file=file: read_raw_mesh(f / file, clouds=True),
        )
        for file in ("c.ply", "c.npz")
    ]


def _write_labels(path: Path) -> None:
    mesh, _ = _patch()
    labels = np.arange(mesh.face_count) % 5
    match path.suffix:
        case ".npz":
            np.savez(path, scan_labels=labels)
        case ".npy":
            np.save(path, labels)
        case ".pkl":
            path.write_bytes(pickle.dumps({"scan_labels": labels}))
        case _:
            write_ply(path, mesh, face_properties={"label": labels})


def _label_doors() -> list[Door]:
    mesh, _ = _patch()
    doors = [
        Door(
            f"labels {suffix}",
            lambda folder, suffix=suffix: _write_labels(folder / f"l.{suffix}"),
            lambda folder, suffix=suffix: read_labels(
                folder / f"l.{suffix}", vertex_count=mesh.vertex_count, face_count=mesh.face_count
            ),
        )
        for suffix in ("npz", "npy", "pkl", "ply")
    ]
    grid = (np.arange(400).reshape(20, 20) % 5).astype(np.uint8)
    return [
        *doors,
        Door(
            "label map npy",
            lambda folder: np.save(folder / "m.npy", grid),
            lambda folder: (read_label_map(folder / "m.npy", label_set="4ddress"), read_label_image(folder / "m.npy")),
        ),
        Door(
            "label set",
            lambda folder: _write_json(folder / "set.json", {"0": "skin", "7": "upper", "9": "background"}),
            lambda folder: find_label_set(folder / "set.json"),
        ),
        Door(
            "label set of one's own",
            lambda folder: (folder / "labels.yaml").write_text(_OWN_LABELS),
            lambda folder: find_label_set(folder / "labels.yaml"),
        ),
    ]


def _hand_doors() -> list[Door]:
    """What is placed and corrected by hand."""
    mesh, _ = _patch()
    stroke = StrokeCorrection(3, mesh.vertices[:4], 0.2, mesh.vertex_normals[:4])
    box = BoxCorrection(4, np.array([0.5, 0.5, 0.0]), np.array([0.5, 0.2, 1.0]), np.eye(3))
    points = {"nose": np.array([0.01, 1.62, 0.11]), "left_hip": np.array([0.1, 0.9, 0.0])}
    return [
        Door(
            "landmarks",
            lambda folder: write_landmarks(folder / "landmarks.json", points),
            lambda folder: read_landmarks(folder / "landmarks.json"),
        ),
        Door(
            "corrections",
            lambda folder: Corrections((stroke, box, FaceCorrection.of(mesh, 2, np.arange(5)))).save(folder / "c.json"),
            lambda folder: Corrections.load(folder / "c.json").face_labels(mesh, np.zeros(mesh.face_count, np.int64)),
        ),
    ]


def _image_doors() -> list[Door]:
    noise = np.random.default_rng(3).integers(0, 255, (24, 20, 4)).astype(np.uint8)

    def read(folder: Path, suffix: str) -> None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GeometryWarning)  # of coloured noise that is read as a mask
            for reader in (read_color, read_alpha, read_normals):
                reader(folder / f"x.{suffix}")

    def write(folder: Path, suffix: str) -> None:
        pixels = noise[..., :3] if suffix in ("jpg", "bmp") else noise
        Image.fromarray(pixels).save(folder / f"x.{suffix}")

    return [
        Door(f"image {suffix}", lambda f, suffix=suffix: write(f, suffix), lambda f, suffix=suffix: read(f, suffix))
        for suffix in ("png", "jpg", "webp", "tif", "bmp")
    ]


def _detector_doors() -> list[Door]:
    """The card of a user's keypoint model, and the record of what was detected."""
    card = {"names": ["nose", None, "left_ear"], "size": [192, 256], "mean": [1.5, 2, 3], "std": [1, 1, 1]}
    card |= {"channels": "bgr", "padding": 1.2, "simcc_split": 2.0, "alignment": "corners"}
    record = {"keypoints": np.ones((2, 2, 3)), "joint_names": np.array(["nose", "left_ear"]), "frames": np.arange(2)}
    record |= {"image_digest": np.array(["a", "b"]), "people": np.array([1, 0]), "detector": np.array(["fuzz"])}

    class Known:
        names, identity = ("nose", "left_ear"), "fuzz"

    return [
        Door("model card", lambda f: _write_json(f / "m.json", card), lambda f: load_card(f / "m.onnx")),
        Door(
            "detected keypoints",
            lambda folder: np.savez(folder / "k.npz", **record),
            lambda folder: kept_rows(folder / "k.npz", Known()),
        ),
    ]


def _basic_doors() -> list[Door]:
    arrays = {"a": np.arange(12.0).reshape(3, 4), "names": np.array(["x", "yz"]), "n": np.array(3)}
    content = {"array": arrays["a"], "list": [1, 2.5, "x", None, {"k": (1, 2)}], "objects": np.array([{}, 1], object)}

    def read_pickle(folder: Path) -> None:
        value = safe_load(folder / "x.pkl")
        for entry in value.values() if isinstance(value, dict) else [value]:
            dense_array(entry, subject="entry")

    def write_objects(folder: Path) -> None:
        np.savez(folder / "x.npz", **arrays, objects=content["objects"])

    def write_pickle(folder: Path) -> None:
        good = {"array": arrays["a"], "list": [1.0, 2.0], "number": np.float32(2)}
        (folder / "x.pkl").write_bytes(pickle.dumps(good, protocol=2))

    return [
        Door(
            "npz", lambda folder: write_arrays(folder / "x.npz", arrays), lambda folder: read_arrays(folder / "x.npz")
        ),
        Door("npz with objects", write_objects, lambda folder: safe_npz(folder / "x.npz")),
        Door("npy", lambda folder: np.save(folder / "x.npy", arrays["a"]), lambda folder: read_array(folder / "x.npy")),
        Door("pickle", write_pickle, read_pickle),
        Door("json", lambda f: _write_json(f / "x.json", [{"a": [1, 2]}, "b"]), lambda f: read_json(f / "x.json")),
    ]


@cache
def _weight_doors() -> list[Door]:
    weights = SkinWeights.from_dense(np.random.default_rng(0).dirichlet([1.0] * 4, 6))

    def make(folder: Path, suffix: str) -> Path:
        weights.save(folder / f"w{suffix}", joint_names=["a", "b", "c", "d"])
        return folder / f"w{suffix}"

    return [Door(f"skin weights {s}", lambda f, s=s: make(f, s), SkinWeights.load) for s in (".npz", ".json")]


def doors() -> dict[str, Door]:
    """Every door by name."""
    every = [_capture_door(name) for name in WRITERS] + [_calibration_door(name) for name in CALIBRATIONS]
    every += _params_doors() + _keypoint_doors()
    every += (
        _mesh_doors()
        + _label_doors()
        + _hand_doors()
        + _image_doors()
        + motion_doors()
        + light_doors()
        + sound_doors()
        + face_doors()
        + _detector_doors()
        + _weight_doors()
        + _basic_doors()
    )
    every += run_doors()
    return {door.name: door for door in every}
