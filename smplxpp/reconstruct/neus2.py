"""Meshes of NeuS2 and Instant-NGP in the world of the cameras: which of the spaces they write is told by the masks.

NeuS2 writes meshes in the input's units or in its unit cube, by version and option. The cube holds
`p * scale + offset` (`scale` and `offset` of transform.json; NeuS2's .5 and .5 where nothing is said); Instant-NGP, for
files without `from_na`, also turns the axes: its x, y, z are the world's y, z, x (`nerf_matrix_to_ngp` of its
`include/neural-graphics-primitives/nerf_loader.h`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.reconstruct.agreement import silhouette_agreement
from smplxpp.reconstruct.views import PhotoView

SPACES = ("world", "cube", "turned cube")
"""Where a mesh may lie: the cameras' world, NeuS2's unit cube, Instant-NGP's with its axes."""
_LEAST_AGREEMENT = 0.7
_NGP_SCALE = 0.33


@dataclass(frozen=True)
class UnitCube:
    """How a trainer's unit cube lies in the world: `p * scale + offset`."""

    scale: float = 0.5
    offset: tuple[float, float, float] = (0.5, 0.5, 0.5)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0 and np.isfinite(self.offset).all()):
            raise InputError("unit cube", expected="a positive scale and a finite offset", received=repr(self))


def world_from_space(
    vertices: Float64[np.ndarray, "N 3"], space: str, cube: UnitCube | None = None
) -> Float64[np.ndarray, "N 3"]:
    """The vertices in the world of the cameras.

    Raises:
        InputError: an unknown space.
    """
    cube = cube or UnitCube()
    if space == "world":
        return vertices
    if space not in SPACES:
        raise InputError("space of a mesh", expected=f"one of {', '.join(SPACES)}", received=space)
    inner = (vertices - np.array(cube.offset)) / cube.scale
    return inner if space == "cube" else inner[:, [2, 0, 1]]


def mesh_in_world(
    mesh: TriangleMesh, views: Sequence[PhotoView], cube: UnitCube | None = None
) -> tuple[TriangleMesh, str, dict[str, float]]:
    """The mesh in the world of the cameras, the space that it came in, and each space's agreement with the masks.

    Args:
        cube: of transform.json; None: NeuS2's and Instant-NGP's defaults are tried.

    Raises:
        InputError: in no space its silhouettes fill the masks (mean IoU of .7 at least).
    """
    cubes = [cube] if cube is not None else [UnitCube(), UnitCube(_NGP_SCALE)]
    found: dict[str, tuple[float, TriangleMesh]] = {}
    for space in SPACES:
        for one in cubes if space != "world" else cubes[:1]:
            moved = mesh.with_vertices(world_from_space(mesh.vertices, space, one))
            share = float(np.mean(list(silhouette_agreement(moved, views).values())))
            name = space if cube is not None or space == "world" else f"{space} of scale {one.scale:g}"
            found[name] = (share, moved)
    best = max(found, key=lambda name: found[name][0])
    shares = {name: share for name, (share, _) in found.items()}
    if shares[best] < _LEAST_AGREEMENT:
        raise InputError(
            "mesh of a reconstruction",
            expected=f"silhouettes that fill the masks in one of its spaces (mean IoU {_LEAST_AGREEMENT:g})",
            received=", ".join(f"{name} {share:.2f}" for name, share in shares.items()),
            remedy="check that mesh, frame and cameras belong together, and crop what is not the person",
        )
    return found[best][1], best, shares
