"""One piece of clothing of the person: its particles among all vertices, what they touch, and their solver."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from smplxpp.cloth.fabric import Fabric, SolverConfig
from smplxpp.cloth.model import build_model, shuffled
from smplxpp.cloth.solver import ClothSolver, ClothState, Collider
from smplxpp.core.mesh import TriangleMesh

# Points at the start and at the end of a tick.
Ends = tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]


@dataclass(frozen=True, eq=False)
class Block:
    """A surface that cloth may touch.

    Attributes:
        faces: of the surface, oriented outwards.
        margin: metres that cloth keeps from it.
        deepest: metres behind it from which cloth is taken to be on the other side.
    """

    faces: Int[np.ndarray, "d 3"]
    margin: float
    deepest: float


@dataclass(frozen=True, kw_only=True)
class Stepping:
    """Material and steps of one garment.

    Attributes:
        fabric: cotton: it hardly stretches.
        attach_stiffness: N/m of the spring of a vertex that is nearly wholly attached to its place on the body.
        solver: contacts are searched once or twice a tick.
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


class Garment:
    """A garment that is stepped; it starts at rest.

    Args:
        rest: N vertices as they are on the body at the start: the garment's own lengths and curvatures.
        hold: (N,) 1 where a vertex follows the body, 0 where it is free.
        touches: surfaces that it may touch.
    """

    def __init__(
        self, rest: TriangleMesh, hold: Float[np.ndarray, " N"], touches: Sequence[Block], stepping: Stepping
    ) -> None:
        model = shuffled(build_model(rest, hold, stepping.fabric, attach_stiffness=stepping.attach_stiffness))
        self._used = [np.unique(block.faces) for block in touches]
        self._solver = ClothSolver(model, _collider(touches, self._used), stepping.fabric, stepping.solver)
        self._rest, self._state = rest, ClothState.at_rest(rest.vertices)
        self._moves = bool((model.inverse_mass > 0).any())
        self.position = rest.vertices

    def advance(self, seconds: float, places: Ends, surfaces: Sequence[Ends], *, damped: bool = False) -> None:
        """Go on by a tick; what is tight all over goes where the body takes it.

        Args:
            seconds: the tick's length.
            places: where the body has the vertices.
            surfaces: the vertices of what the garment touches.
            damped: most of its speed is taken away first.
        """
        if not self._moves:
            self.position = places[1]
            return
        if damped:
            self._state.velocity *= np.float32(0.7)
        skin = [
            np.concatenate([ends[k][used] for ends, used in zip(surfaces, self._used, strict=True)]) for k in (0, 1)
        ]
        self._solver.advance(self._state, seconds, _even_motion(*places), _even_motion(*skin))
        self.position = self._state.position.astype(np.float64)

    @property
    def mesh(self) -> TriangleMesh:
        """The garment as it is now."""
        return self._rest.with_vertices(self.position)


def _collider(touches: Sequence[Block], used: Sequence[Int[np.ndarray, " _"]]) -> Collider:
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
    """Four moments whose curve is the straight way from the second to the third."""
    return [np.ascontiguousarray(x, dtype=np.float32) for x in (2.0 * start - end, start, end, 2.0 * end - start)]
