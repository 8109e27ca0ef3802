"""Costly pure functions, run once for the same input in a test process.

The small trainings of many tests start from the same dolls: every one would look at the same mesh from 32 sides. The
small builds have the same body, in the scan's pose and in those that try the clothes.
"""

from __future__ import annotations

import functools
import hashlib
from typing import Any

import numpy as np

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.raster import zbuffer


def install() -> None:
    """Remember what is seen of a mesh from outside; before a module that imports the functions by name."""
    from smplxpp import raster

    SignedDistanceField._unburied = of_a_solid(SignedDistanceField._unburied)

    zbuffer._outside_depths = of_two_meshes(zbuffer._outside_depths)
    raster.outer_visible_faces = zbuffer.outer_visible_faces = of_a_mesh(zbuffer.outer_visible_faces)
    raster.outer_visible_points = zbuffer.outer_visible_points = of_a_mesh(zbuffer.outer_visible_points)
    raster.hiding_parts = zbuffer.hiding_parts = of_a_mesh(zbuffer.hiding_parts)


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


def of_two_meshes(function: Any) -> Any:
    """What a function of a mesh and plain options yields, kept for the last two meshes: depths are 50 MB each."""
    known: dict[tuple[Any, ...], list[Any]] = {}

    @functools.wraps(function)
    def call(mesh: TriangleMesh, **options: Any) -> list[Any]:
        key = (hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).digest(), *sorted(options.items()))
        known[key] = known.pop(key, None) or list(function(mesh, **options))
        for oldest in list(known)[:-2]:
            del known[oldest]
        return known[key]

    return call


def of_a_solid(method: Any) -> Any:
    """The method of a mesh alone, called once for the same bytes; nobody changes its array."""
    known: dict[bytes, np.ndarray] = {}

    @functools.wraps(method)
    def call(field: SignedDistanceField, mesh: TriangleMesh) -> np.ndarray:
        key = hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).digest()
        if key not in known:
            known[key] = method(field, mesh)
        return known[key]

    return call
