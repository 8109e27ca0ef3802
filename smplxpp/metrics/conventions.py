"""What papers mean by "P2S" and "Chamfer": each convention defined exactly, by name.

With `d(x, Y)` the distance from a point to a target, `A` the samples of the prediction and `B` those of the ground
truth, every convention here is

    p2s     = scale * mean_{a in A} d(a, GT)^p      or      scale * mean_{b in B} d(b, PRED)^p
    chamfer = combine(scale * mean_A d^p, scale * mean_B d^p),   combine = mean, sum, or not defined

and differs in how points are taken (area-weighted or vertices), what the target is (the surface, or the nearest of as
many samples of it), the power p, the unit and the direction that is called P2S. Papers that normalise or align their
meshes first are computed here on the meshes as given: in metres, no alignment.

The TaoAvatar paper prints P2S .2953 and Chamfer .3052 without a unit or a definition, so it has no preset. That its
Chamfer is a mean of both directions is an inference: a sum would leave .0099 for the other direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from smplxpp.core.errors import require_choice


@dataclass(frozen=True)
class Convention:
    """A definition of P2S and Chamfer; see the module's equations.

    Attributes:
        name: of the preset.
        unit: of `p2s` and `chamfer`.
        scale: from metres to the power `power` to that unit.
        power: 1 for distances, 2 for squared ones.
        points: measure from area-weighted samples or from vertices.
        target: measure to the surface or to the nearest sample of it.
        p2s_direction: which direction is called P2S.
        combine: Chamfer from the two directions; None where the source defines no Chamfer.
        definition: in words.
        source: where it is written.
    """

    name: str
    unit: str
    scale: float
    power: Literal[1, 2]
    points: Literal["area", "vertices"]
    target: Literal["surface", "samples"]
    p2s_direction: Literal["pred_to_gt", "gt_to_pred"]
    combine: Literal["mean", "sum"] | None
    definition: str
    source: str

    def directed(self, distance: Float[np.ndarray, " P"]) -> float:
        """Mean of one direction's distances (P,) in metres, in this convention's unit."""
        return float(self.scale * np.mean(distance**self.power))

    def chamfer(self, one: float, other: float) -> float | None:
        """Chamfer from the two directed values."""
        if self.combine is None:
            return None
        return (one + other) * (0.5 if self.combine == "mean" else 1.0)


DEFAULT = "smplxpp"
_CONVENTIONS = (
    Convention(
        DEFAULT,
        "mm",
        1e3,
        1,
        "area",
        "surface",
        "pred_to_gt",
        "mean",
        "point to surface, unsquared; P2S = prediction to ground truth, Chamfer = mean of both directions",
        "this project",
    ),
    Convention(
        "pifuhd-cm",
        "cm",
        1e2,
        1,
        "area",
        "surface",
        "pred_to_gt",
        "mean",
        "point to surface, unsquared; P2S = prediction to ground truth, Chamfer = mean of both directions "
        "(the source takes 10,000 samples, in its data's unit)",
        "PIFuHD (Saito et al. 2020), lib/evaluator.py",
    ),
    Convention(
        "icon-cm",
        "cm",
        1e2,
        1,
        "area",
        "surface",
        "gt_to_pred",
        "mean",
        "point to surface, unsquared; P2S = GROUND TRUTH to PREDICTION, Chamfer = mean of both directions "
        "(the source takes 1,000 samples, in its normalised frame x 100)",
        "ICON (2022) and ECON (2023), Xiu et al., lib/dataset/Evaluator.py",
    ),
    Convention(
        "now-mm",
        "mm",
        1e3,
        1,
        "vertices",
        "surface",
        "gt_to_pred",
        None,
        "scan vertices to the predicted surface, unsquared; no Chamfer (the source aligns and crops the face first)",
        "NoW benchmark (Sanyal et al. 2019), scan2mesh_computations.py",
    ),
    Convention(
        "occnet-l1",
        "m",
        1.0,
        1,
        "area",
        "samples",
        "pred_to_gt",
        "mean",
        "sample to nearest sample, unsquared; P2S = accuracy, Chamfer-L1 = mean of accuracy and completeness "
        "(the source's shapes are scaled to a unit cube)",
        "Occupancy Networks (Mescheder et al. 2019), im2mesh/eval.py",
    ),
    Convention(
        "occnet-l2",
        "m^2",
        1.0,
        2,
        "area",
        "samples",
        "pred_to_gt",
        "mean",
        "sample to nearest sample, squared; P2S = accuracy^2, Chamfer-L2 = mean of both squared directions",
        "Occupancy Networks (Mescheder et al. 2019), im2mesh/eval.py",
    ),
    Convention(
        "pytorch3d",
        "m^2",
        1.0,
        2,
        "area",
        "samples",
        "pred_to_gt",
        "sum",
        "sample to nearest sample, squared; Chamfer = SUM of both directions' means (not halved)",
        "PyTorch3D, pytorch3d.loss.chamfer_distance with its default arguments",
    ),
)


def presets() -> dict[str, Convention]:
    """All conventions by name; the first is this project's own."""
    return {convention.name: convention for convention in _CONVENTIONS}


def convention_named(name: str) -> Convention:
    """Return the convention with the given name.

    Raises:
        InputError: no such preset.
    """
    known = presets()
    require_choice("preset", name, tuple(known))
    return known[name]
