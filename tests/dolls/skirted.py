"""The doll in a skirt that was simulated: 12 frames, three cameras and one held out, truth of held-out frames."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch

from avatar.models.tracked_surface import ControlCage, Track
from smplxpp.cloth import ClothDriver, Garment, GarmentConfig, cut_garment
from smplxpp.cloth.calibrate import with_values
from smplxpp.core.params import BodyParams
from tests.cloth.persons import PART, person, standing
from tests.dolls.doll import Doll, place_camera

FRAMES, NOVEL_POSES, FPS = 12, (10, 11), 15.0
COARSE = GarmentConfig(spacing=0.06, collider_spacing=0.04)
CAMERAS = {"Ring0": 0, "Ring1": 90, "Ring2": 180, "Held0": 40}


def pose(frame: float) -> BodyParams:
    """The doll steps to a side and back."""
    return standing(at=(0.25 * np.sin(0.5 * frame) ** 2, 0.0, 0.0))


@cache
def garment() -> Garment:
    """The skirt with the drag that its truth has."""
    return with_values(cut_garment(person(), PART, standing(), COARSE), drag=4.0, pin_depth=0.014)


@cache
def moved() -> np.ndarray:
    """(T, V, 3) true displacements in the T-pose."""
    driver = ClothDriver(person(), [garment()])
    out = np.zeros((FRAMES, person().vertex_count, 3))
    for frame in range(FRAMES):
        for k in range(4):  # as fine as a capture's motion is followed
            shape = driver.step(pose(frame - 1 + (k + 1) / 4 if frame else 0), 1 / (4 * FPS))
        out[frame, shape.vertices] = shape.share[:, None] * shape.displacements
    return out


def followed(displacements: np.ndarray) -> Track:
    """A surface as a teacher has followed it through the training frames: every vertex a control point."""
    row = {frame: frame for frame in range(NOVEL_POSES[0])}
    return Track(row, torch.tensor(displacements[: len(row)]).float(), cast(ControlCage, torch.nn.Identity()))


def write_skirted(root: Path, **changes: Any) -> Path:
    """Write the capture, which says how many frames a second it has; `changes` of the doll."""
    template, surfaces = person(), []
    for frame in range(FRAMES):
        joints = template.posed_body(pose(frame)).posed_from_rest[0]
        blended = np.einsum("vj,jab->vab", template.weights.dense(), joints)
        rest = template.vertices + moved()[frame]
        surfaces.append(np.einsum("vij,vj->vi", blended[:, :3, :3], rest) + blended[:, :3, 3])
    cameras = {
        name: place_camera(name, angle, size=(48, 64), height=0.7, target=0.6, distance=3.0)
        for name, angle in CAMERAS.items()
    }
    doll = Doll(
        "skirted",
        template,
        cameras,
        ("Held0",),
        params=tuple(pose(frame) for frame in range(FRAMES)),
        surfaces=tuple(surfaces),
        scanned={frame: surfaces[frame] for frame in NOVEL_POSES},
        novel_frames=NOVEL_POSES,
        supersampling=1,
        **changes,
    )
    doll.write_capture(root)
    about = json.loads((root / "capture.json").read_text())
    (root / "capture.json").write_text(json.dumps({**about, "fps": FPS}))
    return root
