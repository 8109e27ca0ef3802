"""Mistakes planted in a small rig, and the findings that name them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from smplxpp.body import load_body
from smplxpp.core import BodyParams, matrix_from_rotvec, rotvec_from_matrix

VIEWS = [(camera, frame) for camera in "ABC" for frame in range(4)]


def image(camera: str, frame: int) -> str:
    return f"rgbs/{camera}/{camera}_rgb{frame:06d}.jpg"


def mask(camera: str, frame: int) -> str:
    return f"masks/{camera}/{camera}_mask{frame:06d}.png"


def edit_mask(root: Path, camera: str, frame: int, change: Callable[[np.ndarray], np.ndarray]) -> None:
    Image.fromarray(change(np.array(Image.open(root / mask(camera, frame))))).save(root / mask(camera, frame))


def edit_json(path: Path, change: Callable[[dict], None]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def edit_cameras(root: Path, change: Callable[[dict], None], names: str = "ABC") -> None:
    """Change the calibration of some cameras; `change` gets arrays K, R, T."""

    def edit(content: dict) -> None:
        for entry in content["cameras"]:
            if entry["name"] in names:
                arrays = {key: np.array(entry[key], dtype=float) for key in "KRT"}
                change(arrays)
                entry |= {key: value.tolist() for key, value in arrays.items()}

    edit_json(root / "cameras.json", edit)


def edit_params(root: Path, change: Callable[[BodyParams], BodyParams], frames=range(4)) -> None:
    for frame in frames:
        path = root / f"params/{frame:06d}.npz"
        change(BodyParams.from_mapping(dict(np.load(path)))).save(path)


def truncate(root: Path) -> None:
    path = root / image("B", 1)
    path.write_bytes(path.read_bytes()[:-400])


def wider(root: Path) -> None:
    Image.open(root / mask("A", 2)).resize((96, 128)).save(root / mask("A", 2))


def uncalibrated(root: Path) -> None:
    edit_json(root / "cameras.json", lambda content: content["cameras"][0].update(name="Z"))


def composited(root: Path, colour: int) -> None:
    for camera, frame in VIEWS:
        share = np.array(Image.open(root / mask(camera, frame)))[..., None] / 255.0
        pixels = np.array(Image.open(root / image(camera, frame))) * share + (1 - share) * colour
        Image.fromarray(pixels.astype(np.uint8)).save(root / image(camera, frame), quality=95)


def black_with_another_frames_mask(root: Path) -> None:
    composited(root, 0)
    edit_json(root / "capture.json", lambda content: content.update(background=[0, 0, 0]))
    shutil.copy(root / mask("A", 0), root / mask("A", 1))


def nobody(root: Path) -> None:
    """A fourth camera that looks away from the person."""

    def add(content: dict) -> None:
        entry = dict(content["cameras"][0])
        R, T = np.diag([-1.0, 1.0, -1.0]) @ np.array(entry["R"]), np.diag([-1.0, 1.0, -1.0]) @ np.array(entry["T"])
        content["cameras"].append(entry | {"name": "D", "R": R.tolist(), "T": T.tolist()})

    edit_json(root / "cameras.json", add)
    for folder in ("rgbs", "masks"):
        (root / folder / "D").mkdir()
    for frame in range(4):
        shutil.copy(root / image("A", frame), root / image("D", frame))
        Image.fromarray(np.zeros((256, 192), np.uint8)).save(root / mask("D", frame))


def drop(*names: str) -> Callable[[Path], None]:
    return lambda root: [(root / name).unlink() for name in names]


def describe(**entries) -> Callable[[Path], None]:
    return lambda root: edit_json(root / "capture.json", lambda content: content.update(entries))


def tagged(root: Path, orientation: int) -> None:
    """An image as a phone stores it: pixels that lie, and a tag that asks for a turn; half a turn keeps its size."""
    path = root / image("B", 1)
    with Image.open(path) as found:
        pixels = np.array(found)
    exif = Image.Exif()
    exif[0x0112] = orientation
    turned = np.rot90(pixels, {6: 1, 8: -1}.get(orientation, 0))
    Image.fromarray(np.ascontiguousarray(turned)).save(path, exif=exif, quality=95)


FILE_FAULTS = {
    "an image that asks for a quarter turn": (lambda r: tagged(r, 6), "image-turned", "tion 6 asks for a turn or a"),
    "an image that asks for half a turn": (lambda r: tagged(r, 3), "image-turned", "which is not made"),
    "a truncated image": (truncate, "file-damaged", image("B", 1)),
    "a mask of another size": (wider, "file-size", mask("A", 2)),
    "a folder that is not calibrated": (uncalibrated, "camera-uncalibrated", "rgbs/A"),
    "a camera without images": (uncalibrated, "camera-without-images", "camera Z"),
    "a missing image": (drop(image("A", 1)), "image-missing", "camera A: no image of frame 1"),
    "a frame in one camera": (drop(image("A", 1), image("B", 1)), "frame-alone", "frame 1: an image in camera C alone"),
    "a missing mask": (drop(mask("C", 0)), "mask-missing", image("C", 0)),
    "no mask at all": (lambda root: shutil.rmtree(root / "masks"), "masks-none", "no masks"),
    "an empty mask": (lambda root: edit_mask(root, "B", 2, np.zeros_like), "mask-empty", mask("B", 2)),
    "a full mask": (lambda root: edit_mask(root, "B", 2, lambda m: m * 0 + 255), "mask-full", mask("B", 2)),
    "an inverted mask": (lambda root: edit_mask(root, "C", 3, lambda m: 255 - m), "mask-inverted", mask("C", 3)),
    "a mask of another frame": (black_with_another_frames_mask, "mask-mismatch", image("A", 1)),
    "photographs declared as composited": (describe(background=[0, 0, 0]), "background", image("A", 0)),
    "composited images declared as photographs": (lambda r: composited(r, 255), "background-plain", "[255, 255, 255]"),
    "a camera that sees nobody": (nobody, "camera-sees-nobody", "camera D"),
    "missing parameters": (drop("params/000002.npz"), "params-missing", "frame 2"),
    "no parameters": (lambda root: shutil.rmtree(root / "params"), "params-none", "no body parameters"),
    "a held-out camera without images": (
        lambda root: shutil.rmtree(root / "rgbs/C"),
        "split-empty",
        "camera C is held out",
    ),
    "splits without frames": (describe(train_frames=[100, 200]), "split-empty", "no frame with images is trained on"),
    "a camera in no split": (describe(train_views=["A"]), "split-leftover", "B"),
    "listed maps that are missing": (describe(labels={"A": [0, 2]}), "map-missing", "labels/A: no label of frame 2"),
    "frames in no split": (describe(train_frames=[0, 0]), "split-leftover", "1-2"),
}


def changed(**arrays: Callable[[np.ndarray], np.ndarray]) -> Callable[[BodyParams], BodyParams]:
    return lambda p: replace(p, **{name: change(getattr(p, name).copy()) for name, change in arrays.items()})


PARAMETER_FAULTS = {
    "betas out of range": (changed(betas=lambda b: b * 0 + 7), [2], "params-betas", "frame 2: betas reach 7"),
    "betas that vary": (changed(betas=lambda b: b + 0.4), [1], "params-betas-vary", "differ by up to 0.4"),
    "expression out of range": (changed(expression=lambda e: e - 30), [0], "params-expression", "frame 0"),
    "degrees": (changed(body_pose=np.degrees), range(4), "params-angles", "as degrees would"),
    "a jump": (changed(transl=lambda t: t + [1.5, 0, 0]), [2], "params-jump", "frame 2: transl jumps by"),
    "centimetres": (changed(transl=lambda t: t * 100), range(4), "params-units", "in centimetres it would be"),
    "more betas than the body": (
        changed(betas=lambda b: np.zeros((1, 300))),
        range(4),
        "params-body",
        "at most 20 numbers",
    ),
}


def pose(change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]) -> Callable[[Path], None]:
    """What is written down instead of the right R and T."""

    def apply(arrays: dict) -> None:
        arrays["R"], arrays["T"] = change(arrays["R"], arrays["T"])

    return lambda root: edit_cameras(root, apply)


def intrinsics(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    return lambda root: edit_cameras(root, lambda arrays: arrays.update(K=change(arrays["K"])))


def swap_axes_of_K(K: np.ndarray) -> np.ndarray:
    return np.array([[K[1, 1], 0, K[1, 2]], [0, K[0, 0], K[0, 2]], [0, 0, 1]])


def turn_parameters(rotation: np.ndarray) -> Callable[[Path], None]:
    """The same person in a turned world."""

    def change(p: BodyParams) -> BodyParams:
        root = load_body().rest_joints(p)[:, 0]
        orient = rotation @ matrix_from_rotvec(p.global_orient)
        return replace(p, global_orient=rotvec_from_matrix(orient), transl=(root + p.transl) @ rotation.T - root)

    return lambda root: edit_params(root, change)


def as_easymocap(p: BodyParams) -> BodyParams:
    root = load_body().rest_joints(p)[:, 0]
    return replace(p, transl=p.transl + root - (matrix_from_rotvec(p.global_orient) @ root[..., None])[..., 0])


def swap_folders(root: Path) -> None:
    for frame in range(4):
        for name in (image, mask):
            a, b = root / name("A", frame), root / name("B", frame)
            first, second = a.read_bytes(), b.read_bytes()
            a.write_bytes(second)
            b.write_bytes(first)


FLIP, Z_UP = np.diag([1.0, -1.0, -1.0]), np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
CALIBRATION_FAULTS = {
    "camera to world": (pose(lambda R, T: (R.T, -R.T @ T)), "R and T are camera to world"),
    "R alone transposed": (pose(lambda R, T: (R.T, T)), "R is camera to world, T is not"),
    "the position as T": (pose(lambda R, T: (R, -R.T @ T)), "T is the camera's position"),
    "OpenGL's axes": (pose(lambda R, T: (FLIP @ R, FLIP @ T)), "OpenGL"),
    "PyTorch3D's axes": (pose(lambda R, T: (np.diag([-1, -1, 1]) @ R, np.diag([-1, -1, 1]) @ T)), "PyTorch3D"),
    "OpenGL's camera to world": (
        pose(lambda R, T: ((FLIP @ R).T, -R.T @ T)),
        "R and T are camera to world, and the camera looks along -z",
    ),
    "millimetres": (pose(lambda R, T: (R, 1000 * T)), "T is in millimetres"),
    "T's sign": (pose(lambda R, T: (R, -T)), "T has the wrong sign"),
    "x and y of K": (intrinsics(swap_axes_of_K), "x and y are swapped in K"),
    "K of larger images": (intrinsics(lambda K: np.diag([2.0, 2.0, 1.0]) @ K), "K is of images twice as large"),
    "parameters with z up": (turn_parameters(Z_UP), "the parameters are in a world with z up"),
    "Rh and Th": (lambda root: edit_params(root, as_easymocap), "global_orient turns about the origin"),
}
