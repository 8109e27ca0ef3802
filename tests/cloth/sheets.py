"""Sheets, balls and slopes for the tests of the room `cloth`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from smplxpp.cloth.model import ClothModel, Fabric, SolverConfig, build_model
from smplxpp.cloth.solver import ClothSolver, ClothState, Collider
from smplxpp.core.mesh import TriangleMesh

NOTHING = Collider(np.zeros((0, 3), np.int32), np.zeros(0, np.float32), np.zeros(0, np.float32))
# Cloth in a vacuum that does not rub on itself: what closed forms are of.
PLAIN = Fabric(drag=0.0, normal_drag=0.0, inner_friction=0.0)


def grid(columns: int, rows: int) -> np.ndarray:
    """Triangles of a lattice of rows of points, which face +z where x goes right and rows go down."""
    a = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    return np.concatenate(
        [np.stack([a, a + columns, a + 1], 1), np.stack([a + 1, a + columns, a + columns + 1], 1)]
    ).astype(np.int64)


def hanging(columns: int = 5, rows: int = 7, cell: float = 0.03) -> TriangleMesh:
    """A sheet in the xy plane below y = 0, facing +z."""
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, -np.arange(rows))
    return TriangleMesh(cell * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1), grid(columns, rows))


def lying(columns: int = 9, rows: int = 9, cell: float = 0.02, height: float = 0.0) -> TriangleMesh:
    """A sheet about the vertical axis that faces up."""
    x, z = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    vertices = cell * np.stack([x.ravel(), 0 * x.ravel(), z.ravel()], axis=1) + [0, height, 0]
    return TriangleMesh(vertices, grid(columns, rows))


def bent(mesh: TriangleMesh, depth: float = 0.02) -> TriangleMesh:
    """A mesh with waves, so that nothing in it is flat."""
    return mesh.with_vertices(mesh.vertices + [0, 0, depth] * np.sin(20 * mesh.vertices[:, :1] + 3))


def held(mesh: TriangleMesh) -> np.ndarray:
    """(n,) 1 at a hanging sheet's upper edge."""
    return (mesh.vertices[:, 1] > -1e-9) * 1.0


def ball(radius: float) -> TriangleMesh:
    """A closed sphere of latitudes and longitudes, facing out."""
    n, m = 24, 48
    theta, phi = np.meshgrid(np.linspace(0, np.pi, n + 1)[1:-1], 2 * np.pi * np.arange(m) / m, indexing="ij")
    rings = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=-1).reshape(-1, 3)
    vertices = radius * np.concatenate([rings, [[0, 1, 0], [0, -1, 0]]])
    a = (np.arange(n - 2)[:, None] * m + np.arange(m)).ravel()
    b = (np.arange(n - 2)[:, None] * m + (np.arange(m) + 1) % m).ravel()
    top = np.stack([np.full(m, len(rings)), (np.arange(m) + 1) % m, np.arange(m)], axis=1)
    last = (n - 2) * m
    bottom = np.stack([np.full(m, len(rings) + 1), last + np.arange(m), last + (np.arange(m) + 1) % m], axis=1)
    return TriangleMesh(
        vertices, np.concatenate([np.stack([a, b, a + m], 1), np.stack([b, b + m, a + m], 1), top, bottom])
    )


def collider(mesh: TriangleMesh, *, margin: float = 0.004, deepest: float = 0.05) -> Collider:
    """A mesh as what cloth touches."""
    full = np.ones(mesh.vertex_count, np.float32)
    return Collider(
        mesh.faces.astype(np.int32), (margin * full).astype(np.float32), (deepest * full).astype(np.float32)
    )


class Scene:
    """A model with its places and a collider that both may move, stepped at an even rate.

    Args:
        model: constraints. start: (n, 3) particles at rest there.
        places, skin: of a time in seconds; None: they stay.
    """

    def __init__(
        self,
        model: ClothModel,
        start: np.ndarray,
        *,
        fabric: Fabric = PLAIN,
        config: SolverConfig | None = None,
        touches: Collider = NOTHING,
        places: Callable[[float], np.ndarray] | None = None,
        skin: Callable[[float], np.ndarray] | None = None,
    ) -> None:
        self.solver = ClothSolver(model, touches, fabric, config or SolverConfig())
        self.state, self.time = ClothState.at_rest(start), 0.0
        self._places = places or (lambda t: start)
        self._skin = skin or (lambda t: np.zeros((0, 3)))

    def run(self, seconds: float, *, fps: float = 30.0) -> ClothState:
        """Step on; the span is a whole number of frames."""
        dt = 1.0 / fps
        for _ in range(round(seconds * fps)):
            at = [self.time + k * dt for k in (-1, 0, 1, 2)]
            self.solver.advance(
                self.state,
                dt,
                [np.ascontiguousarray(self._places(t), dtype=np.float32) for t in at],
                [np.ascontiguousarray(self._skin(t), dtype=np.float32) for t in at],
            )
            self.time += dt
        return self.state


def free(mesh: TriangleMesh, fabric: Fabric = PLAIN, **options) -> Scene:
    """A sheet that nothing holds."""
    return Scene(build_model(mesh, np.zeros(mesh.vertex_count), fabric), mesh.vertices, fabric=fabric, **options)


def hung(mesh: TriangleMesh, fabric: Fabric = PLAIN, **options) -> Scene:
    """A sheet that hangs from its upper edge."""
    return Scene(build_model(mesh, held(mesh), fabric), mesh.vertices, fabric=fabric, **options)


def permuted(model: ClothModel, order: np.ndarray) -> ClothModel:
    """The same constraints in the same order, the particles renamed: particle k is the old order[k]."""
    new = np.empty(len(order), np.int32)
    new[order] = np.arange(len(order))
    return replace(
        model,
        faces=new[model.faces],
        edges=new[model.edges],
        hinges=new[model.hinges],
        inverse_mass=model.inverse_mass[order],
        anchor=np.where(model.anchor >= 0, new[model.anchor], -1)[order].astype(np.int32),
        tether=model.tether[order],
        apart=model.apart[order],
        spring=None if model.spring is None else model.spring[order],
    )
