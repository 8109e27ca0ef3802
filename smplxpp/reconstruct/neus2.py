"""Transform meshes of NeuS2 and Instant-NGP to world coordinates; the masks decide in which space they were written.

NeuS2 writes meshes in the input's units or in its unit cube, depending on version and options. The cube holds
`p * scale + offset` (`scale` and `offset` of transform.json, 0.5 and 0.5 by default). Instant-NGP, for
files without `from_na`, also permutes the axes: its x, y, z are the world's y, z, x (`nerf_matrix_to_ngp` of its
`include/neural-graphics-primitives/nerf_loader.h`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from smplxpp.core import InputError, TriangleMesh
from smplxpp.reconstruct.views import PhotoView, silhouette_agreement

SPACES = ("world", "cube", "turned cube")
"""Spaces of a mesh: the cameras' world, NeuS2's unit cube, and Instant-NGP's cube with permuted axes."""


@dataclass(frozen=True)
class UnitCube:
    """The transform of a trainer's unit cube, which holds `p * scale + offset` of world coordinates p."""

    scale: float = 0.5
    offset: tuple[float, float, float] = (0.5, 0.5, 0.5)

    def __post_init__(self) -> None:
        if not (np.isfinite(self.scale) and self.scale > 0 and np.isfinite(self.offset).all()):
            raise InputError("unit cube", expected="a positive scale and a finite offset", received=repr(self))


def world_from_space(
    vertices: Float64[np.ndarray, "N 3"], space: str, cube: UnitCube | None = None
) -> Float64[np.ndarray, "N 3"]:
    """Return vertices of one of the `SPACES` in world coordinates, metres.

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
    """Return the mesh in world coordinates, the space that it came in, and each space's agreement with the masks.

    Args:
        mesh: in one of the `SPACES`.
        views: photographs with masks.
        cube: of transform.json; None to try the defaults of NeuS2 (scale 0.5) and Instant-NGP (scale 0.33).

    Raises:
        InputError: the silhouettes fill the masks in no space (mean IoU below 0.7).
    """
    least_agreement = 0.7  # a mesh in the wrong space has a mean IoU near 0
    cubes = [cube] if cube is not None else [UnitCube(), UnitCube(0.33)]
    found: dict[str, tuple[float, TriangleMesh]] = {}
    # Try every space and keep the one whose silhouettes agree best with the masks.
    for space in SPACES:
        for one in cubes if space != "world" else cubes[:1]:
            moved = mesh.with_vertices(world_from_space(mesh.vertices, space, one))
            share = float(np.mean(list(silhouette_agreement(moved, views).values())))
            name = space if cube is not None or space == "world" else f"{space} of scale {one.scale:g}"
            found[name] = (share, moved)
    best = max(found, key=lambda name: found[name][0])
    shares = {name: share for name, (share, _) in found.items()}
    if shares[best] < least_agreement:
        raise InputError(
            "mesh of a reconstruction",
            expected=f"silhouettes that fill the masks in one of its spaces (mean IoU {least_agreement:g})",
            received=", ".join(f"{name} {share:.2f}" for name, share in shares.items()),
            remedy="check that mesh, frame and cameras belong together, and crop what is not the person",
        )
    return found[best][1], best, shares
