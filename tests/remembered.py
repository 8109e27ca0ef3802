"""Costly pure functions, run once for the same input in a test process.

The small trainings of many tests start from the same dolls: every one would look at the same mesh from 32 sides.
"""

from __future__ import annotations

import functools
import hashlib
from typing import Any

import numpy as np

from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster import zbuffer


def install() -> None:
    """Remember what is seen of a mesh from outside; before a module that imports the functions by name."""
    from smplxpp import raster

    raster.outer_visible_faces = zbuffer.outer_visible_faces = of_a_mesh(zbuffer.outer_visible_faces)
    raster.outer_visible_points = zbuffer.outer_visible_points = of_a_mesh(zbuffer.outer_visible_points)


def of_a_mesh(function: Any) -> Any:
    """The function of a mesh, arrays and plain options, called once for the same bytes; its array comes as a copy."""
    known: dict[tuple[Any, ...], np.ndarray] = {}

    @functools.wraps(function)
    def call(mesh: TriangleMesh, *arrays: Any, **options: Any) -> np.ndarray:
        digest = hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes())
        for array in map(np.asarray, arrays):
            digest.update(repr((array.dtype, array.shape)).encode() + array.tobytes())
        key = (digest.digest(), *sorted(options.items()))
        if key not in known:
            known[key] = function(mesh, *arrays, **options)
        return known[key].copy()

    return call
