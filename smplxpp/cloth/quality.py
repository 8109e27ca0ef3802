"""Measure simulated cloth while it runs: longest edge, drawn spikes, and what lies inside the body."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float, Float32, Int

from smplxpp.core.checks import Check, Gate
from smplxpp.core.mesh import row_lengths

if TYPE_CHECKING:
    from smplxpp.cloth.garment import Garment

LONGEST_EDGE = Gate("x", 1.25, 1.25, higher_is_better=False)
"""Longest edge of the simulated mesh over its length at rest, in any frame that is used.

Woven cloth tears or is cut on the bias above a quarter; the eye sees a taut string from there on.
"""
SPIKE = Gate("x", 2.0, 10.0, higher_is_better=False)
"""Longest edge of the drawn surface over its length at rest. It bends about the simulated one at a distance, so that
its outer side is longer in every fold. `DriverConfig.most_drawn` is kept but where sweeps do not suffice."""
INSIDE = Gate("% of particles", 5.0, 20.0, higher_is_better=False)
"""Mean share of particles more than 2 mm inside of what they touch: a limb shows through a larger patch."""


@dataclass(frozen=True, kw_only=True)
class ClothQuality:
    """What was measured of one part over frames.

    Attributes:
        part: its name.
        frames: how many were measured.
        longest: longest edge of the simulated mesh over its length at rest, in the worst frame.
        longest_at: seconds of that frame.
        drawn: the same of the drawn surface.
        inside: mean share of the free particles that are more than 2 mm inside of what they touch.
        inside_most: that share in the worst frame.
        deepest: depth of the deepest one in any frame, metres.
        resets: how often the simulation broke down and began again on the body.
        released: contacts that were let go because the cloth between two of them could not meet its length.
    """

    part: str
    frames: int = 0
    longest: float = 0.0
    longest_at: float = 0.0
    drawn: float = 0.0
    inside: float = 0.0
    inside_most: float = 0.0
    deepest: float = 0.0
    resets: int = 0
    released: int = 0

    @property
    def holds(self) -> bool:
        """Return whether no edge was too long and nothing broke down."""
        return self.longest <= LONGEST_EDGE.fail and not self.resets

    def with_(self, other: ClothQuality) -> ClothQuality:
        """Return the figures of both spans of frames together.

        Example:
            >>> one, two = ClothQuality(part="lower", frames=1, longest=1.1), ClothQuality(part="lower", frames=3)
            >>> one.with_(two).frames, one.with_(two).longest
            (4, 1.1)
        """
        worst = max((self, other), key=lambda one: one.longest)
        frames = self.frames + other.frames
        return ClothQuality(
            part=self.part,
            frames=frames,
            longest=worst.longest,
            longest_at=worst.longest_at,
            inside=(self.frames * self.inside + other.frames * other.inside) / max(frames, 1),
            **{name: max(getattr(self, name), getattr(other, name)) for name in ("drawn", "inside_most", "deepest")},
            **{name: getattr(self, name) + getattr(other, name) for name in ("resets", "released")},
        )

    @property
    def sentence(self) -> str:
        """Return the figures as a sentence."""
        broke = f"; it broke down {self.resets} times" if self.resets else ""
        return (
            f"{self.part}: longest edge {self.longest:.2f} x its length at rest, at {self.longest_at:.2f} s; drawn "
            f"{self.drawn:.2f} x; {100 * self.inside:.1f} % of its particles inside the body, at most "
            f"{1e3 * self.deepest:.0f} mm{broke}"
        )

    def checks(self, where: str) -> list[Check]:
        """Hold the figures against their gates; a breakdown is an edge without bound.

        Args:
            where: the frames that were simulated, for the checks' names.
        """
        longest = np.inf if self.resets else self.longest
        return [
            LONGEST_EDGE.check(
                f"{self.part} simulated in {where}: longest edge",
                float(min(longest, 99.0)),
                explanation=f"over its length at rest, the worst of {self.frames} frames, at {self.longest_at:.2f} s"
                + (f"; the simulation broke down {self.resets} times" if self.resets else ""),
            ),
            SPIKE.check(
                f"{self.part} simulated in {where}: longest drawn edge",
                self.drawn,
                explanation="over its length at rest: slivers that are drawn into spikes",
            ),
            INSIDE.check(
                f"{self.part} simulated in {where}: inside the body",
                100.0 * self.inside,
                explanation=f"mean over frames; at most {100 * self.inside_most:.0f} %, {1e3 * self.deepest:.1f} mm",
            ),
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return the figures as JSON values."""
        return asdict(self)


def quality_from(stored: Mapping[str, Any]) -> ClothQuality:
    """Return the figures that `ClothQuality.as_dict` gave; what a newer version added is left out."""
    names = {one.name for one in fields(ClothQuality)}
    return ClothQuality(**{name: value for name, value in stored.items() if name in names})


def merged(found: Iterable[ClothQuality]) -> list[ClothQuality]:
    """Return figures part by part, those of one part together, in the order in which parts come."""
    out: dict[str, ClothQuality] = {}
    for one in found:
        out[one.part] = out[one.part].with_(one) if one.part in out else one
    return list(out.values())


def all_checks(found: Sequence[ClothQuality], where: str) -> list[Check]:
    """Return the checks of all parts that were simulated."""
    return [check for one in found if one.frames for check in one.checks(where)]


class EdgeLengths:
    """Lengths of edges against those at rest.

    Args:
        edges: pairs of rows of the places.
        rest: their lengths at rest, metres.
        least: metres; shorter edges count as that long, because a sliver's ratio says nothing below it.
    """

    def __init__(
        self, edges: Int[np.ndarray, "e 2"], rest: Float[np.ndarray, " e"] | Float32[np.ndarray, " e"], least: float
    ) -> None:
        self._a, self._b = (np.ascontiguousarray(edges[:, k]) for k in (0, 1))
        self._over = 1.0 / np.maximum(rest, least) ** 2

    def longest(self, places: Float32[np.ndarray, "N 3"]) -> float:
        """Return the longest edge over its length at rest; infinite where a place is not finite."""
        if not len(self._over):
            return 0.0
        apart = places[self._a] - places[self._b]
        most = float((np.einsum("ei,ei->e", apart, apart) * self._over).max())
        return float(np.sqrt(most)) if np.isfinite(most) else float("inf")


def drawn_edges(garment: Garment, faces: Int[np.ndarray, "F 3"], *, beside: float) -> EdgeLengths:
    """Return the lengths of a drawn garment's edges where the simulation alone moves both ends.

    Args:
        faces: of the template, over its vertices.
        beside: see `carried_edges`.
    """
    edges, rest = carried_edges(garment, faces, beside=beside)
    alone = (garment.share() >= 1.0)[edges].all(axis=1)
    # Metres: shorter edges are slivers, of which a scan's decimation leaves some of a millimetre.
    return EdgeLengths(edges[alone], rest[alone], 0.01)


def drawn_bounds(
    garment: Garment, faces: Int[np.ndarray, "F 3"], *, most: float, least: float, beside: float
) -> tuple[Int[np.ndarray, "e 2"], Float[np.ndarray, " e"]]:
    """Return the edges of a drawn garment, as pairs of its vertices, and how long each may be drawn, metres.

    Args:
        faces: of the template, over its vertices.
        most: times the length at rest.
        least: metres; shorter edges are slivers, which count as that long.
        beside: see `carried_edges`.
    """
    edges, rest = carried_edges(garment, faces, beside=beside)
    return edges, most * np.maximum(rest, least)


def carried_edges(
    garment: Garment, faces: Int[np.ndarray, "F 3"], *, beside: float
) -> tuple[Int[np.ndarray, "e 2"], Float[np.ndarray, " e"]]:
    """Return the edges of what a garment carries, as pairs of its vertices, and their lengths at rest, metres.

    Vertices of bridges over an opening lie beside the triangle that carries them: they are no cloth.

    Args:
        faces: of the template, over its vertices.
        beside: metres in the triangle's plane from which a vertex is one of a bridge.
    """
    at = np.full(int(max(faces.max(initial=-1), garment.vertices.max(initial=-1))) + 1, -1)
    at[garment.vertices] = np.arange(len(garment.vertices))
    at[garment.vertices[np.abs(garment.embedding.offset[:, :2]).max(axis=1, initial=0.0) >= beside]] = -1
    corners = at[faces]
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    edges = np.unique(np.sort(pairs[(pairs >= 0).all(axis=1)], axis=1), axis=0)
    return edges, lengths_of(garment.embedding.carried(garment.rest), edges)


def lengths_of(places: Float[np.ndarray, "N 3"], edges: Int[np.ndarray, "e 2"]) -> Float[np.ndarray, " e"]:
    """Return the lengths of edges, metres."""
    return row_lengths(places[edges[:, 0]] - places[edges[:, 1]])
