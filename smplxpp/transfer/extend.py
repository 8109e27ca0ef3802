"""A body's weights continued into the free space around it, where loose cloth hangs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

from smplxpp.core.mesh import TriangleMesh
from smplxpp.transfer.anchors import LEAST_REACH, speaking
from smplxpp.transfer.correspond import Correspondence

_SAMPLES = 1000
_NEIGHBOURS = 32  # at a few radii of a sample the rest of the kernel is a few percent
_LEAST_SAY = 0.02  # of a sample, for the vertex that listens most
_LEAST_AGREEMENT = 0.02  # a lining faces away from all skin near it, and still belongs there


@dataclass(frozen=True)
class SurfaceSamples:
    """Points spread over a surface by area.

    Attributes:
        points, normals: (S, 3). weights: (S, J). area: square metres that each stands for.
    """

    points: Float64[np.ndarray, "S 3"]
    normals: Float64[np.ndarray, "S 3"]
    weights: Float64[np.ndarray, "S J"]
    area: float


def sample_surface(mesh: TriangleMesh, weights: Float[np.ndarray, "V J"], *, count: int = _SAMPLES) -> SurfaceSamples:
    """Take a face's centre from each of `count` equal shares of the area, in the order of the faces (deterministic)."""
    cumulative = np.cumsum(mesh.face_areas)
    at = (np.arange(count) + 0.5) / count * cumulative[-1]
    face = np.minimum(np.searchsorted(cumulative, at), mesh.face_count - 1)
    corners = mesh.faces[face]
    mean = weights[corners[:, 0]] + weights[corners[:, 1]] + weights[corners[:, 2]]
    return SurfaceSamples(
        mesh.vertices[corners].mean(axis=1), mesh.face_normals[face], mean / 3.0, float(cumulative[-1]) / count
    )


def extend_weights(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    found: Correspondence,
    copied: Float[np.ndarray, "N J"],
    samples: SurfaceSamples,
    *,
    falloff: float = 6.0,
    reach: Float[np.ndarray, "N J"] | None = None,
) -> tuple[Float64[np.ndarray, "N J"], Float64[np.ndarray, " N"]]:
    """Weights at points off the body: a mean over the body that widens with the distance to it.

        W(x) = integral of W(y) g(x, y) |x - y|^-p dA(y) / integral of g(x, y) |x - y|^-p dA(y)

    with p = `falloff` and g = (1 + cos of the normals' angle) / 2. Over a plane at distance d the kernel is about d
    wide: on the body the value is the body's own, half-way between two legs it is the mean of both, smooth between
    (p = 3 is Poisson's kernel of the half-space, the harmonic extension; a larger p keeps far limbs out). The integral
    is split at the samples' radius rho: the closest point stands for the disc around it, in closed form, the samples,
    with |x - y|^2 + rho^2 for |x - y|^2, for the rest; the two parts add up to the whole over a plane.

    Args:
        points, normals: (N, 3).
        found: closest points of `points`; copied: (N, J) the weights there.
        samples: of the same surface.
        falloff: p > 2.
        reach: (N, J) how far each joint may speak for a point (`evidence.joint_reach`): g is multiplied by what it
            says of y's weights. None: all may.

    Returns:
        (N, J), rows summing to 1, equal to `copied` where the distance is zero; and (N,) the share of the kernel that
        `reach` lets through, 1 without it.
    """
    told = None
    if reach is not None:
        told = speaking(reach, samples.weights)
        asked = told.max(axis=0) > _LEAST_SAY  # a limb without anchor weight takes no neighbour place
        if asked.any():
            told = told[:, asked]
            samples = SurfaceSamples(
                samples.points[asked], samples.normals[asked], samples.weights[asked], samples.area
            )
    half = falloff / 2.0
    rho2 = samples.area / np.pi
    # Everything is multiplied by d^(p-2), so that a distance of zero is no special case.
    d2 = found.distance**2
    fraction = (d2 / (d2 + rho2)) ** (half - 1.0)
    near = np.pi / (half - 1.0) * (1.0 - fraction) * _agreement(np.cos(found.angle))
    count = min(_NEIGHBOURS, len(samples.points))
    distance, index = cKDTree(samples.points).query(points, k=np.arange(1, count + 1), workers=-1)
    cosine = sum(normals[:, None, k] * samples.normals[index, k] for k in range(3))
    # d^(p-2) (r^2 + rho^2)^(-p/2) as a ratio of like magnitudes, whatever the unit.
    scale = d2 + rho2
    far = (scale[:, None] / (distance**2 + rho2)) ** half * (fraction / scale * samples.area)[:, None]
    far *= _agreement(cosine)
    heard = np.ones(len(points))
    if reach is not None and told is not None:
        whole = near + far.sum(axis=1)
        near = near * np.maximum((reach * copied).sum(axis=1), LEAST_REACH)
        far *= np.take_along_axis(told, index, axis=1)
        heard = (near + far.sum(axis=1)) / whole
    rows = np.repeat(np.arange(len(points)), count)
    matrix = sp.csr_matrix((far.ravel(), (rows, index.ravel())), (len(points), len(samples.points)))
    return (near[:, None] * copied + matrix @ samples.weights) / (near + far.sum(axis=1))[:, None], heard


def _agreement(cosine: np.ndarray) -> np.ndarray:
    """How far normals agree, 1 to nearly 0; without a normal (NaN) a half."""
    return np.maximum((1.0 + np.nan_to_num(cosine)) / 2.0, _LEAST_AGREEMENT)
