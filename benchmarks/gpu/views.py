"""Views of a capture at other sizes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from smplxpp.capture import open_capture
from smplxpp.core.camera import Camera
from smplxpp.core.files.atomic import atomic_write_text


def enlarge(source: Path, folder: Path, size: tuple[int, int], *, frames: int = 2, cameras: int = 3) -> Path:
    """A few views of a capture, cut to the shape of `size` (width, height) and enlarged to it, in our own layout.

    The last camera is held out.
    """
    capture = open_capture(source)
    about: dict[str, Any] = {"cameras": []}
    chosen = [*capture.splits.train_cameras[: cameras - 1], *capture.splits.novel_view_cameras[:1]]
    shown = capture.splits.train_frames[:frames]
    for name in chosen:
        box, camera = cut(capture.cameras[name], size)
        for frame in shown:
            pictures = {"rgb": capture.image(name, frame), "mask": capture.mask(name, frame)}
            for tag, image in pictures.items():
                assert image is not None, f"{name} has no mask of frame {frame}"
                path = folder / f"{tag}s" / name / f"{name}_{tag}{frame:06d}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                eight = image if image.dtype == np.uint8 else np.round(255.0 * image).astype(np.uint8)
                Image.fromarray(eight).crop(box).resize(size, Image.Resampling.BICUBIC).save(path)
        R, T = camera.cam_from_world[:3, :3].tolist(), camera.cam_from_world[:3, 3].tolist()
        about["cameras"].append({"name": name, "w": size[0], "h": size[1], "K": camera.K.tolist(), "R": R, "T": T})
    (folder / "params").mkdir(parents=True, exist_ok=True)
    for frame in shown:
        params = capture.params(frame)
        assert params is not None
        params.save(folder / "params" / f"{frame:06d}.npz")
    atomic_write_text(folder / "cameras.json", json.dumps(about))
    atomic_write_text(folder / "capture.json", json.dumps({"name": "large", "novel_views": chosen[cameras - 1 :]}))
    return folder


def cut(camera: Camera, size: tuple[int, int]) -> tuple[tuple[int, int, int, int], Camera]:
    """The largest box (left, top, right, bottom) with the shape of `size`, and the camera of it, enlarged."""
    unit = min(camera.width / size[0], camera.height / size[1])
    width, height = round(unit * size[0]), round(unit * size[1])
    left, top = (camera.width - width) // 2, (camera.height - height) // 2
    K = camera.K.copy()
    K[:2, 2] -= left, top
    K[:2] *= np.array([[size[0] / width], [size[1] / height]])
    return (left, top, left + width, top + height), replace(camera, K=K, width=size[0], height=size[1])


def fitted(camera: Camera, width: int, height: int) -> Camera:
    """The camera with the largest part of its image that has the shape of another size."""
    return cut(camera, (width, height))[1]
