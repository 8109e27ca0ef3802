"""What is expected between a body and the surface of a scan, place by place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from smplxpp.register.locate.proxy import Region


@dataclass(frozen=True)
class Cover:
    """What is expected over a region: how far off, how sure; metres.

    Attributes:
        gap: the usual distance. spread: of it; inside the body is never usual. weight: of a point beside one of skin.
    """

    gap: float
    spread: float
    weight: float


SKIN_COVER = Cover(0.0, 0.003, 1.0)
# Neighbouring points of clothes err together, in folds: each counts little. What whole garments stand off is `Drape`'s.
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
class Expected:
    """What is expected at N points of a surface.

    Attributes:
        gap, spread: metres. weight: of each point. skin: where it is skin.
    """

    gap: Float64[np.ndarray, " N"]
    spread: Float64[np.ndarray, " N"]
    weight: Float64[np.ndarray, " N"]
    skin: Bool[np.ndarray, " N"]

    @staticmethod
    def over(region: Int64[np.ndarray, " N"], skin: Bool[np.ndarray, " N"]) -> Expected:
        """As `COVERS` says.

        Args:
            region: of the body under each point. skin: which points are known to be skin.
        """
        covers = [COVERS[Region(k)] for k in range(len(Region))]
        table = np.array([[cover.gap, cover.spread, cover.weight] for cover in covers])
        rows = np.where(skin[:, None], [SKIN_COVER.gap, SKIN_COVER.spread, SKIN_COVER.weight], table[region])
        return Expected(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 1] <= SKIN_COVER.spread)
