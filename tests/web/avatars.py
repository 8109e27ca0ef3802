"""Small avatars for the player, what Python draws of them, and what Python asks of a page."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avatar.export.bundle import BundleExtras, write_bundle
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from avatar.runtime import AvatarPlayer
from smplxpp.cloth import GarmentConfig, cut_garment
from smplxpp.core import BodyParams, Camera
from tests.cloth.persons import OVER, PART, person, standing
from tests.dolls.dancing import dance
from tests.dolls.doll import place_camera
from tests.runtime.bundles import student

FPS = 10.0
BACKGROUND = (0.2, 0.4, 0.6)
NAME = "Doll <script>"
SWAY_FPS = 20.0
_COARSE = GarmentConfig(spacing=0.06, collider_spacing=0.04)


@cache
def motion() -> BodyParams:
    """The dance, at a rate."""
    return replace(dance(), fps=FPS)


def write_avatar(path: Path) -> bytes:
    """Write the doll with everything that a student can have; return the file's bytes."""
    write_bundle(path, student("whole"), BundleExtras(name=NAME, licence="CC0", motion=motion()))
    return path.read_bytes()


def write_dressed(path: Path, motion: BodyParams, *, layers: int = 1) -> Path:
    """Write the person of balls in one skirt or two.

    No two of their threads are as long: of equal ways to what holds the cloth either could be taken.
    """
    template, rng = person(layers=layers), np.random.default_rng(0)
    garments = [cut_garment(template, part, standing(), _COARSE) for part in (PART, OVER)[:layers]]
    garments = [replace(g, lengths=g.lengths * (1.0 + 1e-3 * rng.random(len(g.lengths)))) for g in garments]
    torch.manual_seed(1)
    config = StudentConfig(FieldConfig(width=8, hidden_layers=2, code_size=4), None, control_points=40)
    it = Student(config, Rig(template), sample_on_mesh(template, SamplingConfig(count=500)), (0, 1))
    write_bundle(path, it, BundleExtras(name="dressed", garments=garments, motion=replace(motion, fps=SWAY_FPS)))
    return path


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
