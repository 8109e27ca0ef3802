"""Choices of a reconstruction."""

from __future__ import annotations

from dataclasses import dataclass

from smplxpp.core.validation import require_at_least, require_positive


@dataclass(frozen=True)
class SweepLevel:
    """One search along the normals.

    Attributes:
        inward, outward: metres searched on each side of the surface. step: metres between looks.
        gain: of agreement from which a place is better than where the surface is.
        coarseness: distances of a patch's samples, in pixels, the photographs taken at that resolution; each but the
            first is asked where the one before convinces nobody: small patches follow a surface, large ones find
            texture.
        half: a patch has 2 half + 1 samples a side.
    """

    inward: float
    outward: float
    step: float
    gain: float
    coarseness: tuple[float, ...] = (1.0,)
    half: int = 3


LEVELS = (
    SweepLevel(0.05, 0.004, 0.002, 0.06, (1.0, 2.0)),
    SweepLevel(0.02, 0.006, 0.001, 0.04),
    SweepLevel(0.004, 0.004, 0.0005, 0.03),
)


@dataclass(frozen=True)
class ReconstructConfig:
    """Choices of a reconstruction; lengths in metres.

    Attributes:
        cell: of the grid that the surface is taken from; None: two pixels, within 3 to 6 mm.
        dissent: views that may say of a point that it is outside; the hull grows with it.
        refine: search along the normals; False: the hull alone.
        levels: of the search, from coarse to fine.
        smoothness: of displacements, against the views' agreement.
        most_views: that are asked for a point.
    """

    cell: float | None = None
    dissent: int = 0
    refine: bool = True
    levels: tuple[SweepLevel, ...] = LEVELS
    smoothness: float = 0.3
    most_views: int = 6

    def __post_init__(self) -> None:
        if self.cell is not None:
            require_positive("reconstruction config cell", self.cell)
        require_at_least("reconstruction config dissent", self.dissent, 0)
        require_at_least("reconstruction config most_views", self.most_views, 2)
        require_positive("reconstruction config smoothness", self.smoothness)
