"""Small meshes and random Gaussians bound to them."""

from __future__ import annotations

import numpy as np
import torch

from avatar.gaussians.binding import BoundGaussians, topology_digest
from smplxpp.core.rotations import matrix_from_rotvec


def sphere(*, splits: int = 2, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    """An octahedron split so often, a little squashed and off the origin: twice gives 66 vertices, 128 faces."""
    vertices = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    faces = [(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)]
    for _ in range(splits):
        middles: dict[tuple[int, int], int] = {}

        def middle(a: int, b: int, middles: dict = middles) -> int:
            key = (min(a, b), max(a, b))
            if key not in middles:
                middles[key] = len(vertices)
                point = np.add(vertices[a], vertices[b])
                vertices.append(tuple(point / np.linalg.norm(point)))
            return middles[key]

        split = []
        for a, b, c in faces:
            ab, bc, ca = middle(a, b), middle(b, c), middle(c, a)
            split += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        faces = split
    points = torch.tensor(np.array(vertices), dtype=dtype) * torch.tensor([0.3, 0.5, 0.4], dtype=dtype)
    return points + torch.tensor([0.1, 1.0, -0.2], dtype=dtype), torch.tensor(faces)


def random_bound(
    faces: torch.Tensor, *, count: int = 40, degree: int = 1, dtype: torch.dtype = torch.float64, seed: int = 0
) -> BoundGaussians:
    """Every attribute random; quaternions not of length 1."""
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int, scale: float = 1.0) -> torch.Tensor:
        return scale * torch.randn(shape, generator=g, dtype=dtype)

    return BoundGaussians(
        face_index=torch.randint(0, len(faces), (count,), generator=g),
        barycentric=torch.rand((count, 2), generator=g, dtype=dtype) * 0.5,
        normal_offset=normal(count, scale=0.01),
        offset=normal(count, 3, scale=0.01),
        log_scales=normal(count, 2) - 1.0,
        quats=normal(count, 4),
        opacity_logits=normal(count),
        dc=torch.rand((count, 3), generator=g, dtype=dtype),
        sh=normal(count, (degree + 1) ** 2 - 1, 3, scale=0.1),
        face_count=len(faces),
        topology=topology_digest(faces),
    )


def rotation(x: float, y: float, z: float, *, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    """(3, 3) of an axis-angle vector."""
    return matrix_from_rotvec(torch.tensor([x, y, z], dtype=dtype))
