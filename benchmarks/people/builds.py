"""Bodies by name, and the mannequin on which their clothes are cut."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from benchmarks.garments.mannequin import Mannequin
from pipelines.synth.cloth_mesh import ClothMesh
from smplxpp.body import BodyModel

# The wardrobe's lengths fit a person of this height, metres.
_CUT_FOR = 1.76

# Leading coefficients of the open body: 0 is small (+) or tall (-), 1 and 2 a man (-) or a woman (+), 4 and 5 weight.
BUILDS: dict[str, tuple[float, ...]] = {
    "mean": (0.0,),
    "woman": (0.35, 1.4, 0.9, 0.6),
    "man": (-0.2, -1.4, -1.0, 0.3),
    "tall man": (-0.75, -1.2, -1.3, -0.6),
    "tall woman": (-0.3, 1.3, 1.0, -0.5, -0.6),
    "small woman": (0.95, 1.2, 1.1, 0.2),
    "tiny woman": (1.3, 0.9, 0.6, 0.0, -0.5),
    "child-sized": (2.1, -0.4, 0.3, -0.5, -0.8, -0.6),
    "thin woman": (0.1, 1.0, 1.0, -0.8, -1.7, -1.5),
    "thin man": (-0.3, -1.2, -0.9, -0.8, -1.7, -1.4),
    "heavy woman": (0.3, 1.0, 1.2, 1.0, 2.0, 2.2),
    "heavy man": (-0.3, -1.3, -1.0, 1.2, 2.2, 1.9),
    "broad man": (-0.45, -1.9, -1.8, 1.1, 0.9, 0.2),
    "short heavy man": (0.7, -1.2, -0.8, 0.6, 1.9, 1.6),
}


def betas_of(body: BodyModel, build: str, rng: np.random.Generator) -> Float[np.ndarray, " B"]:
    """Coefficients of one of `BUILDS`: those that make it what it is, and others that make it one person's."""
    betas = rng.normal(size=body.num_betas) * np.where(np.arange(body.num_betas) < 6, 0.12, 0.6)
    leading = BUILDS[build]
    betas[: len(leading)] += leading
    return betas


def fitting_mannequin(body: BodyModel, betas: Float[np.ndarray, " B"]) -> tuple[Mannequin, float]:
    """The person scaled to the height that garments are cut for, and what their lengths are then multiplied by."""
    own = Mannequin.of(body, betas)
    scale = float(np.ptp(own.skin.vertices[:, 1])) / _CUT_FOR
    skin = ClothMesh(own.skin.vertices / scale, own.skin.faces, own.skin.weights)
    joints = {name: joint / scale for name, joint in own.joints.items()}
    return Mannequin.cut_on(body, own.params, skin, joints), scale
