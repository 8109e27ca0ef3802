"""Small avatars for the player, what Python draws of them, and what Python asks of a page."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from avatar.export.bundle import BundleExtras, write_bundle
from avatar.runtime import AvatarPlayer
from smplxpp.core.camera import Camera
from smplxpp.core.params import BodyParams
from tests.dolls.dancing import dance
from tests.dolls.doll import place_camera
from tests.runtime.bundles import student

FPS = 10.0
BACKGROUND = (0.2, 0.4, 0.6)
NAME = "Doll <script>"


@cache
def motion() -> BodyParams:
    """The dance, at a rate."""
    return replace(dance(), fps=FPS)


def write_avatar(path: Path) -> bytes:
    """Write the doll with everything that a student can have; return the file's bytes."""
    write_bundle(path, student("whole"), BundleExtras(name=NAME, licence="CC0", motion=motion()))
    return path.read_bytes()


def camera(angle: float = 40.0) -> Camera:
    """One that has the doll in its picture."""
    return place_camera("view", angle, size=(192, 256), height=0.7, target=0.45)


def drawn(path: Path, frame: int, view: Camera) -> tuple[np.ndarray, np.ndarray]:
    """What the runtime draws of a frame: (H, W, 3) in [0, 1] and its opacity."""
    player = AvatarPlayer(path, threads=1)
    player.pose(motion().frame(frame))
    image, alpha = player.draw(view, background=BACKGROUND)
    return np.clip(image, 0.0, 1.0), alpha


def asked(view: Camera, frame: float, **more: Any) -> dict[str, Any]:
    """The same view as the page's player takes it."""
    K = view.K
    return {
        "time": frame / FPS,
        "background": BACKGROUND,
        "camera": {
            "view": np.asarray(view.cam_from_world)[:3].ravel().tolist(),
            **{"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]},
            **{"width": view.width, "height": view.height},
        },
        **more,
    }


def decibels(image: np.ndarray, truth: np.ndarray, inside: np.ndarray) -> float:
    """PSNR within a mask."""
    return float(-10.0 * np.log10(np.square(image - truth)[inside].mean()))
