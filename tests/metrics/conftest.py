"""Shapes whose distances are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from smplxpp.core.mesh import TriangleMesh


@pytest.fixture(scope="session")
def sphere() -> Callable[..., TriangleMesh]:
    """sphere(radius, subdivisions=5): vertices on the sphere, faces inside by less than 0.05 % of the radius."""

    def make(radius: float, subdivisions: int = 5) -> TriangleMesh:
        ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
        return TriangleMesh(np.asarray(ball.vertices), np.asarray(ball.faces))

    return make


@pytest.fixture(scope="session")
def plane() -> Callable[..., TriangleMesh]:
    """plane(height, half=1, cells=8): a square of half width `half` at y = height, normals up."""

    def make(height: float = 0.0, half: float = 1.0, cells: int = 8) -> TriangleMesh:
        axis = np.linspace(-half, half, cells + 1)
        x, z = np.meshgrid(axis, axis, indexing="ij")
        vertices = np.stack([x.ravel(), np.full(x.size, height), z.ravel()], axis=1)
        i = np.arange(x.size).reshape(x.shape)
        a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
        return TriangleMesh(vertices, np.concatenate([np.stack([a, d, c], 1), np.stack([a, c, b], 1)]))

    return make
