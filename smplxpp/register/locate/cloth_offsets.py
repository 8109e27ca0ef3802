"""State what is expected between a body and the surface of a scan: gaps by region, and offsets that garments share.

How far clothes stand off is unknown, but shared by a whole garment, by the tube around a limb, and by one side of it.
If every point of a shirt were an independent observation, a loose shirt would outweigh hands, neck and face, and pull
the body to one of its sides. So the distance of a point of cloth is modelled as

    distance = gap of its region + offset of its cell + noise

(a linear mixed-effects model). A cell is one side of a limb, and the offsets are Gaussian with a covariance of three
levels (garment, limb, side). The offsets are eliminated from the normal equations. What remains determines the body
only as far as no offset explains it: opposite sides centre a limb in its tube, and skin determines the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Bool, Float64, Int64

from smplxpp.body import BodyModel
from smplxpp.register.locate.proxy import Region, regions
from smplxpp.register.normal_equations import geman_mcclure

NO_CELL = -1
"""Cell of vertices over which no cloth is expected."""


@dataclass(frozen=True)
class Cover:
    """Prior of the distance between the body and the surface over a region.

    Attributes:
        gap: mean distance, metres.
        spread: standard deviation of the distance, metres; points inside the body are treated apart.
        weight: information of a point relative to a point of skin.
    """

    gap: float
    spread: float
    weight: float


# Chosen by what people wear, not fitted to data. Neighbouring points of cloth have correlated errors (folds), so each
# counts less than a point of skin; the offset of whole garments is `ClothOffsets`'.
SKIN_COVER = Cover(0.0, 0.003, 1.0)
COVERS: Mapping[int, Cover] = {
    Region.HAND: SKIN_COVER,
    Region.FACE: SKIN_COVER,
    Region.SCALP: Cover(0.015, 0.012, 0.3),
    Region.FOOT: Cover(0.012, 0.010, 0.5),
    Region.NECK: Cover(0.004, 0.010, 0.5),
    Region.ARM: Cover(0.006, 0.010, 0.2),
    Region.LEG: Cover(0.008, 0.012, 0.2),
    Region.TRUNK: Cover(0.008, 0.010, 0.2),
}


@dataclass(frozen=True, eq=False)
class CoverPrior:
    """The prior of the distance between body and surface at N points.

    Attributes:
        gap: mean distances, metres.
        spread: standard deviations, metres.
        weight: information relative to a point of skin.
        skin: whether a point is treated as skin.
    """

    gap: Float64[np.ndarray, " N"]
    spread: Float64[np.ndarray, " N"]
    weight: Float64[np.ndarray, " N"]
    skin: Bool[np.ndarray, " N"]

    @staticmethod
    def over(region: Int64[np.ndarray, " N"], skin: Bool[np.ndarray, " N"]) -> CoverPrior:
        """Look the prior up in `COVERS`.

        Args:
            region: of the body under each point.
            skin: whether a point is known to be skin.
        """
        covers = [COVERS[Region(k)] for k in range(len(Region))]
        table = np.array([[cover.gap, cover.spread, cover.weight] for cover in covers])
        rows = np.where(skin[:, None], [SKIN_COVER.gap, SKIN_COVER.spread, SKIN_COVER.weight], table[region])
        return CoverPrior(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 1] <= SKIN_COVER.spread)


@dataclass(frozen=True, eq=False)
class ClothOffsets:
    """The Gaussian prior of the offsets of K cells of a body's clothes.

    Attributes:
        cell: of each vertex of the body, `NO_CELL` where no cloth is expected.
        precision: inverse of the covariance of the offsets, 1/m^2.
    """

    cell: Int64[np.ndarray, " V"]
    precision: Float64[np.ndarray, "K K"]

    @staticmethod
    def of(body: BodyModel) -> ClothOffsets:
        """Make a cell of each of the four sides of every clothed limb, with covariances of three levels."""
        # Standard deviations in metres of the offset that all cells of a garment share, those of a limb, and each
        # alone.
        of_garment, of_each_limb, of_side = 0.02, 0.01, 0.008
        upper, lower, sides = (Region.TRUNK, Region.ARM), (Region.LEG,), 4
        region, limb = regions(body), np.argmax(body.weights, axis=1)
        clothed = np.isin(region, (*upper, *lower))
        named, cell = np.unique(sides * limb[clothed] + _side(body, region)[clothed], return_inverse=True)
        garment = np.zeros(len(named), dtype=np.int64)
        garment[cell] = np.isin(region[clothed], lower)
        of_limb = named // sides
        covariance = of_garment**2 * (garment[:, None] == garment) + of_each_limb**2 * (of_limb[:, None] == of_limb)
        covariance += of_side**2 * np.eye(len(named))
        cells = np.full(body.vertex_count, NO_CELL, dtype=np.int64)
        cells[clothed] = cell
        return ClothOffsets(cells, np.linalg.inv(covariance))

    def offsets(
        self,
        cell: Int64[np.ndarray, " N"],
        residual: Float64[np.ndarray, " N"],
        weight: Float64[np.ndarray, " N"],
        cutoff: Float64[np.ndarray, " N"],
    ) -> Float64[np.ndarray, " N"]:
        """Return the most likely offset of each point's cell, by iteratively reweighted least squares.

        Four rounds minimise `sum w GM(r - b_cell) + b^T C^-1 b`. The cutoff of the Geman-McClure kernel falls from 8 cm
        to the given one, so that a wide garment is not rejected as an outlier at the start.

        Args:
            cell: of each point; none is `NO_CELL`.
            residual: distances minus the mean gap, metres.
            weight: inverse variances.
            cutoff: final cutoffs, metres.
        """
        offset = np.zeros(len(self.precision))
        for wide in np.linspace(0.08, 0.0, 4):
            kept = weight * geman_mcclure(residual - offset[cell], np.maximum(cutoff, wide))
            information = np.bincount(cell, kept, minlength=len(offset))
            pull = np.bincount(cell, kept * residual, minlength=len(offset))
            offset = np.linalg.solve(self.precision + np.diag(information), pull)
        return offset[cell]

    def eliminated(
        self,
        cell: Int64[np.ndarray, " N"],
        weight: Float64[np.ndarray, " N"],
        rows: Float64[np.ndarray, "N P"],
        residual: Float64[np.ndarray, " N"],
    ) -> tuple[Float64[np.ndarray, "_ P"], Float64[np.ndarray, " _"]]:
        """Eliminate the offsets b: return rows and residuals whose sum of squares is the least one over all b.

        With the Jacobian R, residuals r, and A the assignment of points to cells, the minimum over b of
        `|W^1/2 (r + R x - A b)|^2 + b^T C^-1 b` is `|Y - B (B^T B)^-1 B^T Y|^2` with `Y = (W^1/2 (r + R x), 0)` and
        `B = (W^1/2 A, L^T)`, `C^-1 = L L^T` (variable projection): N rows, and one for each cell.
        """
        cells = len(self.precision)
        # The optimal b is linear in (R, r): solve for both at once, and subtract it from each point.
        both = np.column_stack([rows, residual])
        sums = sp.csr_matrix((weight, (cell, np.arange(len(cell)))), shape=(cells, len(cell)))
        information = np.bincount(cell, weight, minlength=cells)
        offset = np.linalg.solve(self.precision + np.diag(information), sums @ both)
        left = (both - offset[cell]) * np.sqrt(weight)[:, None]
        out = np.concatenate([left, -np.linalg.cholesky(self.precision).T @ offset])
        return out[:, :-1], out[:, -1]


def _side(body: BodyModel, region: Int64[np.ndarray, " V"]) -> Int64[np.ndarray, " V"]:
    """Return front, back, or one of the two sides between, about a limb's axis in the T-pose (arms along x)."""
    normal = body.mesh().vertex_normals
    across = np.where(region == Region.ARM, normal[:, 1], normal[:, 0])
    forwards = np.abs(normal[:, 2]) > np.abs(across)
    return np.where(forwards, normal[:, 2] < 0, 2 + (across < 0)).astype(np.int64)
