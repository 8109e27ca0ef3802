"""One garment's weights judged: unposed with them and driven beside the same garment with its authored weights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from benchmarks.garments.wardrobe import Case
from smplxpp.body import BodyModel
from smplxpp.body.named_poses import stress_poses
from smplxpp.skinning import UnposeConfig, skin, unpose

_ANY_DETERMINANT = UnposeConfig(warn_below=-np.inf, fail_below=-np.inf)  # baselines may fold a vertex: measure it


@dataclass(frozen=True, eq=False)
class Trial:
    """A case, and what its authored weights make of it.

    Attributes:
        case: the garment as scanned.
        reference: transforms of the joints in the scan's pose. driven: those of the stress poses.
        expected: (P, N, 3) metres, the garment in the stress poses by its authored weights.
    """

    case: Case
    reference: Float[np.ndarray, "J 4 4"]
    driven: Float[np.ndarray, "P J 4 4"]
    expected: Float[np.ndarray, "P N 3"]

    @staticmethod
    def of(body: BodyModel, case: Case) -> Trial:
        """Drive the garment by its authored weights."""
        reference = body.forward(case.params).posed_from_rest[0]
        driven = body.forward(stress_poses(replace(case.params, transl=np.zeros((1, 3))))).posed_from_rest
        return Trial(case, reference, driven, _drive(case.mesh.vertices, case.weights, reference, driven))

    def judge(self, dense: Float[np.ndarray, "N J"]) -> dict[str, float]:
        """Mean total variation of the weights; mean, p95 and p99 in mm of all driven positions."""
        error = 1e3 * np.linalg.norm(
            _drive(self.case.mesh.vertices, dense, self.reference, self.driven) - self.expected, axis=2
        )
        p95, p99 = np.percentile(error, [95, 99])
        variation = 0.5 * np.abs(dense - self.case.weights).sum(axis=1).mean()
        return {"tv": float(variation), "mean": float(error.mean()), "p95": float(p95), "p99": float(p99)}


def _drive(vertices: np.ndarray, dense: np.ndarray, reference: np.ndarray, driven: np.ndarray) -> np.ndarray:
    rest = unpose(vertices, dense, reference, config=_ANY_DETERMINANT).vertices
    return np.stack([skin(rest, dense, transforms) for transforms in driven])
