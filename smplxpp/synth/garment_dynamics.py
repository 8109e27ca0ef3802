"""Dynamics of one garment: its cloth model, the surfaces that it may touch, and their solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from smplxpp.cloth.model import Fabric, SolverConfig, build_model, shuffled
from smplxpp.cloth.solver import ClothSolver, ClothState, Collider
from smplxpp.core.mesh import TriangleMesh

Ends = tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]
"""Points at the start and at the end of a tick, metres."""


@dataclass(frozen=True, eq=False)
class ContactSurface:
    """A surface that cloth may touch.

    Attributes:
        faces: faces of the surface, oriented outwards.
        margin: distance in metres that cloth keeps from it.
        deepest: depth in metres from which cloth counts as on its other side.
    """

    faces: Int[np.ndarray, "d 3"]
    margin: float
    deepest: float


@dataclass(frozen=True, kw_only=True)
class GarmentConfig:
    """Material and time steps of a garment.

    Attributes:
        fabric: cotton, which hardly stretches.
        attach_stiffness: N/m of the spring that holds a nearly attached vertex to its place on the body.
        solver: steps of the solver, which searches contacts once or twice a tick.
    """

    fabric: Fabric = field(
        default_factory=lambda: Fabric(
            stretch_stiffness=11_500.0,
            compression=1.0,
            bend_stiffness=3e-6,
            slack=0.005,
            drag=0.8,
            normal_drag=0.0,
            inner_friction=2.7,
            friction=0.3,
        )
    )
    attach_stiffness: float = 40.0
    solver: SolverConfig = field(default_factory=lambda: SolverConfig(contacts_every=12, most_speed=6.0))


class GarmentDynamics:
    """A simulated garment, at rest at first.

    Args:
        rest: N vertices on the body at the start, which give rest lengths and curvatures.
        hold: 1 where a vertex follows the body, 0 where it is free.
        touches: surfaces that it may touch.
        config: material and steps.
    """

    def __init__(
        self,
        rest: TriangleMesh,
        hold: Float[np.ndarray, " N"],
        touches: Sequence[ContactSurface],
        config: GarmentConfig,
    ) -> None:
        model = shuffled(build_model(rest, hold, config.fabric, attach_stiffness=config.attach_stiffness))
        self._used = [np.unique(block.faces) for block in touches]
        self._solver = ClothSolver(model, _collider(touches, self._used), config.fabric, config.solver)
        self._rest, self._state = rest, ClothState.at_rest(rest.vertices)
        # A garment without free vertices needs no solver.
        self._moves = bool((model.inverse_mass > 0).any())
        self.position = rest.vertices

    def advance(self, seconds: float, places: Ends, surfaces: Sequence[Ends], *, damped: bool = False) -> None:
        """Advance by one tick; a garment without free vertices follows the body.

        Args:
            seconds: length of the tick.
            places: vertices as skinning moves them.
            surfaces: vertices of each surface that the garment touches.
            damped: whether to reduce all velocities by 30 % first.
        """
        if not self._moves:
            self.position = places[1]
            return
        if damped:
            self._state.velocity *= np.float32(0.7)
        # Only the vertices that faces of the surfaces use take part.
        skin = [
            np.concatenate([ends[k][used] for ends, used in zip(surfaces, self._used, strict=True)]) for k in (0, 1)
        ]
        self._solver.advance(self._state, seconds, _even_motion(*places), _even_motion(*skin))
        self.position = self._state.position.astype(np.float64)

    @property
    def mesh(self) -> TriangleMesh:
        """The garment in its current state."""
        return self._rest.with_vertices(self.position)


def _collider(touches: Sequence[ContactSurface], used: Sequence[Int[np.ndarray, " _"]]) -> Collider:
    # Join the surfaces into one, renumbering their vertices.
    each = [len(index) for index in used]
    faces = [
        np.searchsorted(index, block.faces) + start
        for block, index, start in zip(touches, used, np.cumsum(each) - each, strict=True)
    ]
    return Collider(
        np.concatenate(faces).astype(np.int32),
        np.repeat([block.margin for block in touches], each).astype(np.float32),
        np.repeat([block.deepest for block in touches], each).astype(np.float32),
    )


def _even_motion(start: Float[np.ndarray, "N 3"], end: Float[np.ndarray, "N 3"]) -> list[np.ndarray]:
    """Return four instants of a uniform motion that passes `start` second and `end` third."""
    return [np.ascontiguousarray(x, dtype=np.float32) for x in (2.0 * start - end, start, end, 2.0 * end - start)]
