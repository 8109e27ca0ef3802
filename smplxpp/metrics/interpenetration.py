"""Volume that two closed surfaces share, by exact intersection of the solids (manifold3d)."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from smplxpp.core.mesh import MeshLike, as_mesh
from smplxpp.core.solids import solid_of_mesh

CM3 = 1e6
"""Cubic centimetres in a cubic metre."""


@dataclass(frozen=True)
class Interpenetration:
    """Volume and surface that two solids share.

    Attributes:
        volume_cm3: of what lies in both.
        share: of the smaller one's volume; 0 where it has none.
        volume_a_cm3, volume_b_cm3: of the two.
    """

    volume_cm3: float
    share: float
    volume_a_cm3: float
    volume_b_cm3: float

    def as_dict(self) -> dict:
        """Return the numbers as a dictionary for JSON."""
        return asdict(self)


def interpenetration(a: MeshLike, b: MeshLike) -> Interpenetration:
    """The volume of the intersection of two closed meshes in metres.

    An open surface has no volume: give it a thickness first (`smplxpp.clean.thickened`), or close it. Where a surface
    cuts itself, what it encloses twice counts once or twice.

    Raises:
        InputError: a mesh that is open, not manifold, or encloses nothing.
    """
    a = as_mesh(a, subject="first surface")
    b = as_mesh(b, subject="second surface")
    first, second = solid_of_mesh(a, subject="first surface"), solid_of_mesh(b, subject="second surface")
    shared = max((first ^ second).volume(), 0.0)
    smaller = min(first.volume(), second.volume())
    return Interpenetration(
        volume_cm3=shared * CM3,
        share=shared / smaller if smaller > 0 else 0.0,
        volume_a_cm3=first.volume() * CM3,
        volume_b_cm3=second.volume() * CM3,
    )
