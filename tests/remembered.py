"""Costly pure functions, run once for the same input in a test process.

The small trainings of many tests start from the same dolls: every one would look at the same mesh from 32 sides.
"""

from __future__ import annotations

import functools
import hashlib
from typing import Any

import numpy as np

from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster import visibility


def install() -> None:
    """Remember what is seen of a mesh from outside; before a module that imports the function by name."""
    from smplxpp import raster

    raster.outer_visible_faces = visibility.outer_visible_faces = of_a_mesh(visibility.outer_visible_faces)


def of_a_mesh(function: Any) -> Any:
    """The function of a mesh and plain options, which is called once for the same bytes; arrays come back as copies."""
    known: dict[tuple[Any, ...], np.ndarray] = {}

    @functools.wraps(function)
    def call(mesh: TriangleMesh, **options: Any) -> np.ndarray:
        digest = hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).digest()
        key = (digest, *sorted(options.items()))
        if key not in known:
            known[key] = function(mesh, **options)
        return known[key].copy()

    return call
