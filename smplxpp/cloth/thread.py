"""One garment through time: its particles, and where skinning had it at the last moments."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32, Int, Int64

from smplxpp.cloth.embedding import CarriedVertices
from smplxpp.cloth.garment import Garment
from smplxpp.cloth.quality import ClothQuality, EdgeLengths, drawn_bounds, drawn_edges
from smplxpp.cloth.solver import ClothSolver, ClothState, move_before_collider
from smplxpp.core.mesh import row_lengths

if TYPE_CHECKING:
    from smplxpp.cloth.driver import DriverConfig


class GarmentThread:
    """State of one garment while it is simulated.

    Args:
        garment: what it is.
        rows: (R,) vertices of the template whose places it is given, increasing.
        faces: of the template, whose edges are measured as they are drawn.
        layered: whether it touches another garment that is simulated. Cloth that lies in itself has no sides that
            another layer could keep to: its particles stay their spacing apart then.

    Attributes:
        floor: height of the ground, metres from the driver's origin; None: there is none.
    """

    def __init__(
        self,
        garment: Garment,
        rows: Int64[np.ndarray, " R"],
        config: DriverConfig,
        faces: Int[np.ndarray, "F 3"],
        *,
        layered: bool = False,
    ) -> None:
        self.garment, self._config = garment, config
        self.floor: float | None = None
        self._model = garment.model()
        collider = garment.collider
        margin = max(config.solver.own_margin, garment.config.spacing * layered)
        solver = replace(config.solver, own_margin=margin)
        self._solver = ClothSolver(self._model, collider.native, garment.config.fabric, solver)
        self._carried = CarriedVertices(
            *(garment.embedding, garment.rest.faces, self._solver.collider, len(garment.particles)),
            drawn_bounds(garment, faces, most=config.most_drawn, least=config.sliver, beside=config.beside),
        )
        self._particles = np.searchsorted(rows, garment.particles)
        self._skin = np.searchsorted(rows, collider.vertices)
        self._pinned = np.flatnonzero(garment.pinned)
        self._share = garment.share()
        self._edges = EdgeLengths(self._model.edges, self._model.lengths, 0.0)
        self._drawn = drawn_edges(garment, faces, beside=config.beside)
        self._resets = self._released = 0
        self._state = ClothState.at_rest(garment.rest.vertices)
        self._places: list[Float32[np.ndarray, "n 3"]] = []
        self._surfaces: list[Float32[np.ndarray, "c 3"]] = []

    def reset(self, places: Float32[np.ndarray, "R 3"]) -> None:
        """Put the particles where skinning has them, at rest."""
        self._state = ClothState.at_rest(places[self._particles])
        self._places, self._surfaces = [places[self._particles]], [places[self._skin]]

    def begin_measuring(self) -> None:
        """Forget the contacts that were let go until now, in a ramp that no frame shows."""
        self._released = self._solver.released

    def way_to(self, places: Float32[np.ndarray, "R 3"]) -> float:
        """Return the largest displacement, metres, of the garment's attachments since the last step."""
        ways = row_lengths(places[self._particles[self._pinned]] - self._places[-1][self._pinned])
        return float(ways.max(initial=0.0))

    def advance(
        self, places: Float32[np.ndarray, "R 3"], seconds: float, threads: Sequence[GarmentThread]
    ) -> str | None:
        """Go on to new places; returns what went wrong, if anything did.

        Args:
            threads: all garments, the inner ones moved on already: where one is under this one it counts as it is.
        """
        # Where an inner garment lies under this one, collide with its simulated surface instead of the skinned one.
        surface = places[self._skin]
        for other in threads:
            if other is self:
                break
            surface = other.laid_over(self.garment.collider.vertices, surface)
        own = places[self._particles]
        # Four moments define the Catmull-Rom curves along which pins and collider move during the substeps.
        try:
            self._solver.advance(
                self._state, seconds, _four_moments(self._places, own), _four_moments(self._surfaces, surface)
            )
        # Remember the places even after an error, so that the next step interpolates from the right moment.
        finally:
            self._places, self._surfaces = [self._places[-1], own], [self._surfaces[-1], surface]
        if self._sound():
            if self.floor is not None:
                self._lay_on(self.floor + self._config.drawn_margin)
            return None
        self._state = ClothState.at_rest(own)
        self._resets += 1
        return "the simulation broke down; the cloth was laid on the body again and continues from there"

    def _lay_on(self, height: float) -> None:
        """Lift what sank below the ground onto it; Coulomb's friction against what it fell with.

        The foot of a perpendicular on a half-space is no farther from another foot than the points were: no edge
        becomes longer, so that the bound of the solver holds.
        """
        x, v = self._state.position, self._state.velocity
        low = np.flatnonzero(x[:, 1] < height)
        stopped = np.maximum(-v[low, 1], 0.0)
        along = v[low][:, [0, 2]]
        speed = row_lengths(along)
        left = np.maximum(speed - self.garment.config.fabric.friction * stopped, 0.0) / np.maximum(speed, 1e-9)
        x[low, 1] = height
        v[low, 0], v[low, 2] = (along * left[:, None]).T
        v[low, 1] += stopped

    def place(self, particles: Float32[np.ndarray, "n 3"]) -> None:
        """Put the particles elsewhere, metres from the driver's origin; their velocities stay."""
        self._state.position[:] = particles

    def draw_to(self, seen: Float[np.ndarray, "n 3"], seconds: float, *, gain: float) -> None:
        """Draw what hangs free towards where it was seen: the correction of an alpha-beta filter.

        With the residual `r = seen - x`, smoothed over the cloth: `x <- x + gain r`, `v <- v + gain r / seconds`.

        Args:
            seen: metres from the driver's origin; NaN rows take the residual of their neighbours.
            seconds: since particles were drawn last, or since the last step.
            gain: in [0, 1]: how far what was seen is believed, against the simulation.
        """
        x, v = self._state.position, self._state.velocity
        residual = np.asarray(seen, dtype=np.float64) - x
        known = np.isfinite(residual).all(axis=1)
        # Errors of what was seen differ from particle to particle, while what moves cloth does not.
        values = np.column_stack([np.where(known[:, None], residual, 0.0), known])
        a, b = self._model.edges.T
        ends, others = np.r_[a, b], np.r_[b, a]
        around = np.stack([np.bincount(ends, column[others], minlength=len(x)) for column in values.T], axis=1)
        values = 0.5 * values + 0.5 * around / np.maximum(np.bincount(ends, minlength=len(x)), 1)[:, None]
        pull = gain * values[:, :3] / np.maximum(values[:, 3:], 1e-9)
        pull[self._pinned] = 0.0
        x += pull.astype(np.float32)
        v += (pull / seconds).astype(np.float32)

    def shift(self, by: Float32[np.ndarray, " 3"]) -> None:
        """Shift all stored places, metres, because their origin has moved by the opposite vector."""
        self._state.position[:] += by
        self._places = [places + by for places in self._places]
        self._surfaces = [surface + by for surface in self._surfaces]

    def particles(self) -> Float32[np.ndarray, "n 3"]:
        """Return where the particles are, metres from the driver's origin."""
        return self._state.position.copy()

    def carried(self) -> Float32[np.ndarray, "N 3"]:
        """Return the vertices that the garment carries, metres, `drawn_margin` outside of what it touches.

        Between particles that keep their margin a limb's curve can come through.
        """
        out = self._carried.at(self._state.position, self._surfaces[-1], margin=self._config.drawn_margin)
        if self.floor is not None:
            np.maximum(out[:, 1], self.floor, out=out[:, 1])
        return out

    def buried(self) -> int:
        """Return how many particles lie inside what the garment touches, by so much that no contact pushes them out."""
        # Metres inside what it touches.
        return int((self._depths() > 0.005).sum())

    def _depths(self) -> Float32[np.ndarray, " L"]:
        """Return how deep the free particles lie inside what the garment touches, metres; 0 outside."""
        coarse = self.garment.rest.with_vertices(self._state.position)
        normals, loose = coarse.vertex_normals, ~self.garment.pinned
        out = move_before_collider(self._state.position, normals, self._surfaces[-1], self._solver.collider, margin=0.0)
        return row_lengths(out - self._state.position)[loose]

    def measured(self, seconds: float, drawn: Float32[np.ndarray, "N 3"]) -> ClothQuality:
        """Measure the garment as it is.

        Args:
            seconds: of the motion, printed with the figures.
            drawn: where the carried vertices are, metres.
        """
        depths = self._depths()
        buried = 2e-3  # metres, the distance that drawn cloth keeps from the skin
        inside = float((depths > buried).mean()) if len(depths) else 0.0
        resets, self._resets = self._resets, 0
        released, self._released = self._solver.released - self._released, self._solver.released
        return ClothQuality(
            part=self.garment.part,
            frames=1,
            longest=self._edges.longest(self._state.position),
            longest_at=seconds,
            drawn=self._drawn.longest(drawn),
            inside=inside,
            inside_most=inside,
            deepest=float(depths.max(initial=0.0)),
            resets=resets,
            released=released,
        )

    def laid_over(
        self, vertices: Int64[np.ndarray, " c"], surface: Float32[np.ndarray, "c 3"]
    ) -> Float32[np.ndarray, "c 3"]:
        """Return the places of an outer garment's collider, those of this garment where the simulation has them."""
        at = np.searchsorted(self.garment.vertices, vertices)
        mine = np.isin(vertices, self.garment.vertices)
        if not mine.any():
            return surface
        out = surface.copy()
        share = self._share[at[mine], None]
        # Blend as the drawn surface does: near the pins skinning counts, outside of the band the simulation.
        out[mine] += share * (self.carried()[at[mine]] - out[mine])
        return out

    def _sound(self) -> bool:
        x = self._state.position
        if not (np.isfinite(x).all() and np.isfinite(self._state.velocity).all()):
            return False
        return self._edges.longest(x) <= self._config.most_stretch


def _four_moments(
    past: Sequence[Float32[np.ndarray, "k 3"]], now: Float32[np.ndarray, "k 3"]
) -> list[Float32[np.ndarray, "k 3"]]:
    """The moment before the last, the last, this one, and the next one as it would come without acceleration."""
    last = past[-1]
    before = past[-2] if len(past) > 1 else 2.0 * last - now
    return [before, last, now, 2.0 * now - last]
