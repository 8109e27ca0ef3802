"""Files of a capture: cameras, images, 16-bit normals, compact arrays."""

from __future__ import annotations

import csv
import io
import json
import struct
import zipfile
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

from pipelines.makers.synth.camera_rig import RigCamera
from smplxpp.core.atomic import atomic_path, atomic_write_bytes, atomic_write_text
from smplxpp.core.rotations import rotvec_from_matrix

# Coordinates of truth meshes are rounded to this many metres (0.06 mm): they compress better.
QUANTUM = 2.0**-14
# Components of normals keep 12 bits of 16: the rest would be noise that does not compress.
_NORMAL_STEP = 16
_CONVENTION = (
    "OpenCV: x_cam = R @ x_world + T, x right, y down, z forward; u = fx*x/z + cx in [0,w], pixel (i,j) has its centre "
    "at (j+0.5, i+0.5); no distortion; world y up, metres"
)
_CSV_FIELDS = ("name", "w", "h", "rx", "ry", "rz", "tx", "ty", "tz", "fx", "fy", "px", "py")


def rounded(vertices: np.ndarray) -> np.ndarray:
    """Coordinates as they are stored: multiples of `QUANTUM`."""
    return np.round(vertices / QUANTUM) * QUANTUM


def save_compact(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """An npz file packed with LZMA, columns stored one after the other: two thirds of deflate; np.load reads it."""
    with atomic_path(path) as temporary, zipfile.ZipFile(temporary, "w", zipfile.ZIP_LZMA) as archive:
        for name, value in arrays.items():
            buffer = io.BytesIO()
            np.save(buffer, np.asfortranarray(value))
            # A fixed date: the same arrays give the same file.
            info = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            archive.writestr(info, buffer.getvalue(), compress_type=zipfile.ZIP_LZMA)


def write_cameras_json(path: Path, rig: list[RigCamera]) -> None:
    """Cameras in OpenCV's form, with kind and split."""
    entries = [
        {
            "name": item.camera.name,
            "w": item.camera.width,
            "h": item.camera.height,
            "K": item.camera.K.tolist(),
            "R": item.camera.cam_from_world[:3, :3].tolist(),
            "T": item.camera.cam_from_world[:3, 3].tolist(),
            "kind": item.kind,
            "split": "novel" if item.novel else "train",
        }
        for item in rig
    ]
    atomic_write_text(path, json.dumps({"convention": _CONVENTION, "cameras": entries}, indent=1) + "\n")


def write_calibration_csv(path: Path, rig: list[RigCamera]) -> None:
    """ActorsHQ's calibration: camera-to-world, intrinsics in units of the image's size."""
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


def write_actorshq_scene(folder: Path, boxes: np.ndarray, fps: float) -> None:
    """`aabbs.csv` and `scene.json` beside the scale folders; `boxes` (T, 2, 3) corners of each frame's bounds."""
    corners = [f"aabb_{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    rows = [",".join(["frame_number", *corners])]
    rows += [",".join([str(frame), *(f"{value:.6g}" for value in box.ravel())]) for frame, box in enumerate(boxes)]
    atomic_write_text(folder / "aabbs.csv", "\n".join(rows) + "\n")
    atomic_write_text(folder / "scene.json", json.dumps({"num_frames": len(boxes), "fps": fps}, indent=1) + "\n")


def write_jpeg(path: Path, image: np.ndarray, *, quality: int) -> None:
    """(H, W, 3) uint8 sRGB."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "JPEG", quality=quality, optimize=True)
    atomic_write_bytes(path, buffer.getvalue())


def write_gray_png(path: Path, image: np.ndarray) -> None:
    """(H, W) uint8: masks and labels."""
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    atomic_write_bytes(path, buffer.getvalue())


def write_normal_png(path: Path, normals: np.ndarray) -> None:
    """(H, W, 3) unit normals as 16-bit RGB, n = value / 65535 * 2 - 1; zero rows (background) become 0, 0, 0."""
    value = np.round((normals + 1.0) * (0.5 * 65535 / _NORMAL_STEP)) * _NORMAL_STEP
    value = np.where((normals == 0.0).all(axis=2, keepdims=True), 0, np.clip(value, _NORMAL_STEP, 65535))
    atomic_write_bytes(path, png16(value.astype(np.uint16)))


def png16(image: np.ndarray) -> bytes:
    """(H, W, 3) uint16 as a 16-bit RGB PNG (Pillow writes none); every row with the `Up` filter."""
    height, width = image.shape[:2]
    rows = np.ascontiguousarray(image.astype(">u2")).view(np.uint8).reshape(height, -1)
    filtered = np.empty((height, 1 + rows.shape[1]), np.uint8)
    filtered[:, 0] = 2
    filtered[:, 1:] = np.diff(rows, axis=0, prepend=np.zeros((1, rows.shape[1]), np.uint8))

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    parts = [chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(filtered.tobytes(), 9)), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
