"""How far clothes stand off is unknown, and shared: by a whole garment, by the tube about a limb, by one side of it.

Were every point of a shirt a witness of its own, a loose shirt would outvote hands, neck and face, and draw the body
to one of its sides. So each point's distance has an offset of its cell, a side of a limb; offsets are Gaussian with a
covariance of three levels, and are eliminated from the equations. What is left tells of the body what no offset
explains: sides against each other put a limb into the middle of its tube, and skin tells the rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float64, Int64

from smplxpp.body import BodyModel
from smplxpp.register.locate.proxy import Region, regions
from smplxpp.register.robust import geman_mcclure

# Standard deviations, metres: what upper or lower garment, tube and side stand off more or less than usual.
_GARMENT, _LIMB, _SIDE = 0.02, 0.01, 0.008
# Offsets are looked for with cutoffs that fall from this, metres: a wide garment is not taken for something else.
_WIDE, _ROUNDS = 0.08, 4
_UPPER, _LOWER = (Region.TRUNK, Region.ARM), (Region.LEG,)
NO_CELL = -1
_SIDES = 4


@dataclass(frozen=True, eq=False)
class Drape:
    """Offsets of K cells of a body's clothes, as they are expected.

    Attributes:
        cell: of each of the body's vertices, `NO_CELL` where nothing is shared.
        precision: inverse of the offsets' covariance.
    """

    cell: Int64[np.ndarray, " V"]
    precision: Float64[np.ndarray, "K K"]

    @staticmethod
    def of(body: BodyModel) -> Drape:
        """Cells are the four sides of every limb that clothes cover."""
        region, limb = regions(body), np.argmax(body.weights, axis=1)
        clothed = np.isin(region, (*_UPPER, *_LOWER))
        named, cell = np.unique(_SIDES * limb[clothed] + _side(body, region)[clothed], return_inverse=True)
        garment = np.zeros(len(named), dtype=np.int64)
        garment[cell] = np.isin(region[clothed], _LOWER)
        of_limb = named // _SIDES
        covariance = _GARMENT**2 * (garment[:, None] == garment) + _LIMB**2 * (of_limb[:, None] == of_limb)
        covariance += _SIDE**2 * np.eye(len(named))
        cells = np.full(body.vertex_count, NO_CELL, dtype=np.int64)
        cells[clothed] = cell
        return Drape(cells, np.linalg.inv(covariance))

    def offsets(
        self,
        cell: Int64[np.ndarray, " N"],
        residual: Float64[np.ndarray, " N"],
        weight: Float64[np.ndarray, " N"],
        cutoff: Float64[np.ndarray, " N"],
    ) -> Float64[np.ndarray, " N"]:
        """The most likely offset of each point, robustly.

        Args:
            cell: none is `NO_CELL`. residual: metres beyond the usual gap. weight: inverse variances.
            cutoff: metres from a cell's offset beyond which a point is taken for something else.
        """
        offset = np.zeros(len(self.precision))
        for wide in np.linspace(_WIDE, 0.0, _ROUNDS):
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
        """Weighted rows and residuals whose squares are those of the given ones, least over all offsets.

        `min_b |W^1/2 (r + R x - A b)|^2 + b^T C^-1 b` is `|Y - B (B^T B)^-1 B^T Y|^2` of `Y = (W^1/2 (r + R x), 0)` and
        `B = (W^1/2 A, L^T)` with `C^-1 = L L^T`: N rows, and one for each cell.
        """
        cells = len(self.precision)
        both = np.column_stack([rows, residual])
        sums = sp.csr_matrix((weight, (cell, np.arange(len(cell)))), shape=(cells, len(cell)))
        information = np.bincount(cell, weight, minlength=cells)
        offset = np.linalg.solve(self.precision + np.diag(information), sums @ both)
        left = (both - offset[cell]) * np.sqrt(weight)[:, None]
        out = np.concatenate([left, -np.linalg.cholesky(self.precision).T @ offset])
        return out[:, :-1], out[:, -1]


def _side(body: BodyModel, region: Int64[np.ndarray, " V"]) -> Int64[np.ndarray, " V"]:
    """Front, back and the two sides between about the axis that a limb has in the T-pose: arms lie along x."""
    normal = body.mesh().vertex_normals
    across = np.where(region == Region.ARM, normal[:, 1], normal[:, 0])
    forwards = np.abs(normal[:, 2]) > np.abs(across)
    return np.where(forwards, normal[:, 2] < 0, 2 + (across < 0)).astype(np.int64)
