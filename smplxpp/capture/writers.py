"""Write the files of a capture: parameters and keypoints as npz, photographs, maps; cameras and descriptions."""

from __future__ import annotations

import csv
import io
import json
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8, UInt16
from PIL import Image

from smplxpp.capture.cameras import RigCamera
from smplxpp.capture.distortion import (
    FISHEYE,
    FOV,
    Distortion,
    FisheyeDistortion,
    FovDistortion,
    RationalDistortion,
)
from smplxpp.capture.recording import Recording, Splits
from smplxpp.core import ARRAY_NAMES, BodyParams, Camera, InputError, Keypoints2D, rotvec_from_matrix
from smplxpp.core.files import atomic_path, write_arrays
from smplxpp.core.files.atomic import atomic_write_bytes, atomic_write_text

QUANTUM = 2.0**-14
"""Metres (0.06 mm) to which coordinates of true meshes are rounded, because they then compress better."""
_CONVENTION = (
    "OpenCV: x_cam = R @ x_world + T, x right, y down, z forward; u = fx*x/z + cx in [0,w], pixel (i,j) has its centre "
    "at (j+0.5, i+0.5); no distortion; world y up, metres"
)
_CSV_FIELDS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")


def rounded(vertices: Float[np.ndarray, "*V 3"]) -> Float[np.ndarray, "*V 3"]:
    """Round coordinates to multiples of `QUANTUM`, as they are stored."""
    return np.round(vertices / QUANTUM) * QUANTUM


def save_compact(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write an npz file with LZMA in column order, two thirds the size of deflate; `np.load` reads it."""
    write_arrays(path, {name: np.asfortranarray(value) for name, value in arrays.items()}, packing=zipfile.ZIP_LZMA)


def save_params_by_row(path: Path, params: Mapping[int, BodyParams]) -> None:
    """Write parameters with frame n in row n; rows of other frames are NaN, which only makes these frames empty."""
    # 14 hours at 20 frames per second, two gigabytes.
    max_rows = 1_000_000
    joined = BodyParams.concatenate(list(params.values()))
    rows = np.array(list(params))
    if rows.max() >= max_rows:
        raise InputError(
            "parameters of the capture",
            expected=f"frames numbered below {max_rows}: their row is the frame's number",
            received=f"frame {rows.max()}",
            remedy="number the frames from 0",
        )
    arrays: dict[str, np.ndarray] = {"flat_hand_mean": np.array(joined.flat_hand_mean, dtype=bool)}
    for name in ARRAY_NAMES:
        values = getattr(joined, name)
        arrays[name] = np.full((rows.max() + 1, values.shape[1]), np.nan)
        arrays[name][rows] = values
    arrays |= joined.offsets_by_row(rows)
    with atomic_path(path) as temporary, open(temporary, "wb") as stream:
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]  # numpy: the names might be `allow_pickle`


def write_keypoints(path: Path, keypoints: Keypoints2D, extra: Mapping[str, np.ndarray] | None = None) -> None:
    """Write the keypoints of one camera, rounded to 1/16 pixel; a confidence above 0 stays above 0.

    Args:
        path: path of the npz file.
        keypoints: keypoints of the camera.
        extra: further arrays for the file, which readers of keypoints ignore.
    """
    # Rounding is far below the accuracy of detectors, and halves the size of the file.
    pixel, confidence_step = 2.0**-4, 2.0**-7
    points = np.round(keypoints.points / pixel) * pixel
    confidence = np.round(keypoints.confidence / confidence_step) * confidence_step
    confidence = np.where(keypoints.confidence > 0, np.maximum(confidence, confidence_step), 0.0)
    table = np.concatenate([points, confidence[..., None]], axis=2).astype(np.float32)
    names = np.array(keypoints.names, dtype=str)
    save_compact(path, {"keypoints": table, "joint_names": names, "frames": keypoints.frames, **(extra or {})})


# For each kind of file its folder, and the tag before the frame number in file names.
VIEW_FOLDERS = {
    "image": ("rgbs", "rgb"),
    "mask": ("masks", "mask"),
    "label": ("labels", "label"),
    "normal": ("normals", "normal"),
}
JPEG_SUFFIXES = (".jpg", ".jpeg")


def view_path(root: Path, kind: str, camera: str, frame: int, suffix: str) -> Path:
    """Return the path of a view's file: `kind` is a key of `VIEW_FOLDERS`, `suffix` starts with a dot."""
    folder, tag = VIEW_FOLDERS[kind]
    return root / folder / camera / f"{camera}_{tag}{frame:06d}{suffix}"


def write_jpeg(path: Path, image: UInt8[np.ndarray, "H W 3"], *, quality: int) -> None:
    """Write an sRGB image as an optimised JPEG file."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=quality, optimize=True)
    atomic_write_bytes(path, buffer.getvalue())


def write_gray_png(path: Path, image: UInt8[np.ndarray, "H W"]) -> None:
    """Write a mask or labels as an 8-bit PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    atomic_write_bytes(path, buffer.getvalue())


def write_normal_png(path: Path, normals: Float[np.ndarray, "H W 3"]) -> None:
    """Write unit normals as 16-bit RGB, n = value / 65535 * 2 - 1; zero rows (background) become 0, 0, 0."""
    # 12 bits of 16 are kept, because the others are noise that does not compress.
    step = 16
    value = np.round((normals + 1.0) * (0.5 * 65535 / step)) * step
    value = np.where((normals == 0.0).all(axis=2, keepdims=True), 0, np.clip(value, step, 65535))
    atomic_write_bytes(path, png16(value.astype(np.uint16)))


def normal_codes(normals: Float[np.ndarray, "H W 3"]) -> UInt16[np.ndarray, "H W 3"]:
    """Encode unit normals with all 16 bits, n = value / 65535 * 2 - 1; zero rows (background) become 0, 0, 0."""
    codes = np.clip(np.round((normals + 1.0) * 32767.5), 1, 65535)
    return np.where(normals.any(axis=2, keepdims=True), codes, 0).astype(np.uint16)


def encoded_image(image: UInt8[np.ndarray, "H W *D"] | UInt16[np.ndarray, "H W 3"], suffix: str, quality: int) -> bytes:
    """Return the bytes of an image file: JPEG without chroma subsampling by its suffixes, else PNG of 8 or 16 bits."""
    if image.dtype == np.uint16:
        return png16(image)
    buffer = io.BytesIO()
    if suffix in JPEG_SUFFIXES:
        Image.fromarray(image).save(buffer, "JPEG", quality=quality, subsampling=0)
    else:
        Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()


def png16(image: UInt16[np.ndarray, "H W 3"]) -> bytes:
    """Return the bytes of a 16-bit RGB PNG, which Pillow cannot write; all rows use the `Up` filter."""
    height, width = image.shape[:2]
    rows = np.ascontiguousarray(image.astype(">u2")).view(np.uint8).reshape(height, -1)
    # Filter type 2 (Up) stores each byte minus the one above it modulo 256, with zeros above the first row.
    filtered = np.empty((height, 1 + rows.shape[1]), np.uint8)
    filtered[:, 0] = 2
    filtered[:, 1:] = np.diff(rows, axis=0, prepend=np.zeros((1, rows.shape[1]), np.uint8))

    def chunk(kind: bytes, data: bytes) -> bytes:
        # Length, type, data, and the CRC of type and data (PNG specification, section 5.3).
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    # Bit depth 16 and colour type 2 (RGB); no interlacing.
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = [chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(filtered.tobytes(), 9)), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def write_cameras_json(path: Path, rig: list[RigCamera]) -> None:
    """Write cameras.json in OpenCV's convention, with the kind and split of each camera."""
    entries = [
        {**camera_entry(item.camera, item.camera.name), "kind": item.kind, "split": "novel" if item.novel else "train"}
        for item in rig
    ]
    atomic_write_text(path, json.dumps({"convention": _CONVENTION, "cameras": entries}, indent=1) + "\n")


def write_plain_cameras_json(path: Path, cameras: Mapping[str, Camera]) -> None:
    """Write cameras.json in OpenCV's convention, without kind and split."""
    entries = [camera_entry(camera, name) for name, camera in cameras.items()]
    atomic_write_text(path, json.dumps({"cameras": entries}, indent=1) + "\n")


def camera_entry(camera: Camera, name: str) -> dict[str, object]:
    """Return the entry of a camera in cameras.json."""
    return {
        "name": name,
        "w": camera.width,
        "h": camera.height,
        "K": camera.K.tolist(),
        "R": camera.cam_from_world[:3, :3].tolist(),
        "T": camera.cam_from_world[:3, 3].tolist(),
    }


def lens_entry(distortion: Distortion | None) -> dict[str, object]:
    """Return what cameras.json says of a lens; nothing for a pinhole."""
    if isinstance(distortion, RationalDistortion):
        (k1, k2, k3, *rest), (p1, p2) = distortion.radial, distortion.tangential
        return {"dist": [k1, k2, p1, p2, k3, *rest]}
    if isinstance(distortion, FisheyeDistortion):
        return {"dist": list(distortion.k), "dist_model": FISHEYE}
    return {"dist": [distortion.omega], "dist_model": FOV} if isinstance(distortion, FovDistortion) else {}


def write_calibration_csv(path: Path, rig: list[RigCamera]) -> None:
    """Write ActorsHQ's calibration.csv: camera-to-world, intrinsics in units of the image size."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_CSV_FIELDS)
    for item in rig:
        camera = item.camera
        world_from_cam = camera.cam_from_world[:3, :3].T
        size = np.array([camera.width, camera.height])
        focal, center = np.diag(camera.K)[:2] / size, camera.K[:2, 2] / size
        numbers = [*rotvec_from_matrix(world_from_cam), *camera.position, *focal, *center]
        writer.writerow([camera.name, *size.tolist(), *(f"{value:.12g}" for value in numbers)])
    atomic_write_text(path, text.getvalue())


def write_actorshq_scene(folder: Path, boxes: Float[np.ndarray, "T 2 3"], fps: float) -> None:
    """Write `aabbs.csv` and `scene.json` beside the scale folders; `boxes` are the corners of each frame's bounds."""
    corners = [f"aabb_{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    rows = [",".join(["frame_number", *corners])]
    rows += [",".join([str(frame), *(f"{value:.6g}" for value in box.ravel())]) for frame, box in enumerate(boxes)]
    atomic_write_text(folder / "aabbs.csv", "\n".join(rows) + "\n")
    atomic_write_text(folder / "scene.json", json.dumps({"num_frames": len(boxes), "fps": fps}, indent=1) + "\n")


def write_description(path: Path, recording: Recording, splits: Splits, frames: Sequence[int]) -> None:
    """Write capture.json, the description of a capture in the simple layout.

    Args:
        path: path of the file.
        recording: source of name, frame rate, background and label set.
        splits: training and held-out cameras and frames.
        frames: all frames of the written capture, ascending.
    """
    description: dict[str, object] = {"name": recording.name}
    if recording.fps is not None:
        description["fps"] = recording.fps
    description |= {
        "background": None if recording.background is None else list(recording.background),
        "label_set": recording.label_set,
        "train_views": list(splits.train_cameras),
        "novel_views": list(splits.novel_view_cameras),
        "train_frames": _ranges(splits.train_frames, frames),
        "novel_pose_frames": _ranges(splits.novel_pose_frames, frames),
    }
    atomic_write_text(path, json.dumps(description, indent=1) + "\n")


def _ranges(chosen: Sequence[int], frames: Sequence[int]) -> list[list[int]]:
    """Return [first, last] of every run of consecutive `frames` that are chosen."""
    marks = np.concatenate([[0], np.isin(frames, chosen).astype(np.int8), [0]])
    starts, ends = np.flatnonzero(np.diff(marks) == 1), np.flatnonzero(np.diff(marks) == -1) - 1
    return [[int(frames[int(first)]), int(frames[int(last)])] for first, last in zip(starts, ends, strict=True)]
