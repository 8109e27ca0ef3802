"""Extend a body's weights into the free space around it, where loose cloth hangs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

from smplxpp.core.mesh import TriangleMesh
from smplxpp.transfer.anchors import LEAST_ADMISSIBILITY, point_admissibility, smooth_step
from smplxpp.transfer.correspond import Correspondence, closest_points


@dataclass(frozen=True)
class WeightSamples:
    """Points spread over a surface by area, with its weights there.

    Attributes:
        points: metres.
        normals: unit length.
        weights: rows sum to 1.
        area: square metres that each stands for.
    """

    points: Float64[np.ndarray, "S 3"]
    normals: Float64[np.ndarray, "S 3"]
    weights: Float64[np.ndarray, "S J"]
    area: float


def sample_weights(mesh: TriangleMesh, weights: Float[np.ndarray, "V J"], *, count: int = 1000) -> WeightSamples:
    """Sample weights at the centroid of a face in each of `count` equal shares of the area (deterministic)."""
    cumulative = np.cumsum(mesh.face_areas)
    middle = (np.arange(count) + 0.5) / count * cumulative[-1]
    face = np.minimum(np.searchsorted(cumulative, middle), mesh.face_count - 1)
    corners = mesh.faces[face]
    total = weights[corners[:, 0]] + weights[corners[:, 1]] + weights[corners[:, 2]]
    area = float(cumulative[-1]) / count
    return WeightSamples(mesh.vertices[corners].mean(axis=1), mesh.face_normals[face], total / 3.0, area)


def extend_weights(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    found: Correspondence,
    copied: Float[np.ndarray, "N J"],
    samples: WeightSamples,
    *,
    falloff: float = 6.0,
    admissible: Float[np.ndarray, "N J"] | None = None,
) -> tuple[Float64[np.ndarray, "N J"], Float64[np.ndarray, " N"]]:
    """Return weights at points off the body: a mean over the body that widens with the distance to it.

        W(x) = integral of W(y) g(x, y) |x - y|^-p dA(y) / integral of g(x, y) |x - y|^-p dA(y)

    with p = `falloff` and g = (1 + cos of the normals' angle) / 2. Over a plane at distance d the kernel is about d
    wide. On the body the value is the body's own, in the middle between two legs it is the mean of both, smooth
    between. (p = 3 is Poisson's kernel of the half-space, the harmonic extension; a larger p keeps far limbs out.) The
    integral
    is split at the samples' radius rho: the closest point stands for the disc around it, in closed form, and the
    samples, with |x - y|^2 + rho^2 for |x - y|^2, for the rest. The two parts add up to the whole over a plane.

    Args:
        points: metres.
        normals: unit length, outward.
        found: closest points of `points`.
        copied: weights at the closest points.
        samples: of the same surface.
        falloff: p > 2.
        admissible: how much each joint may count for a point (`joint_admissibility`); g is multiplied by the
            admissibility of y's weights. None: all count.

    Returns:
        values: (N, J), rows summing to 1, equal to `copied` where the distance is zero.
        admissible_share: (N,) share of the kernel that is admissible, 1 without `admissible`.
    """
    # Leave out samples that hardly count for any point, so that they take no neighbour's place.
    per_sample, column = None, np.arange(len(samples.points))
    if admissible is not None:
        per_sample = point_admissibility(admissible, samples.weights)
        used = per_sample.max(axis=0) > 0.02
        if used.any():
            column = np.flatnonzero(used)
            samples = WeightSamples(samples.points[used], samples.normals[used], samples.weights[used], samples.area)
    # Integrate the kernel over the disc about the closest point. Everything is multiplied by d^(p-2), so that a
    # distance of zero is no special case.
    half = falloff / 2.0
    rho2 = samples.area / np.pi
    d2 = found.distance**2
    fraction = (d2 / (d2 + rho2)) ** (half - 1.0)
    near = np.pi / (half - 1.0) * (1.0 - fraction) * _agreement(np.cos(found.angle))
    # Sum it over the 32 nearest samples; the kernel's rest is a few percent.
    count = min(32, len(samples.points))
    distance, index = cKDTree(samples.points).query(points, k=np.arange(1, count + 1))
    cosine = sum(normals[:, None, k] * samples.normals[index, k] for k in range(3))
    # d^(p-2) (r^2 + rho^2)^(-p/2) as a ratio of like magnitudes, whatever the unit.
    scale = d2 + rho2
    far = (scale[:, None] / (distance**2 + rho2)) ** half * (fraction / scale * samples.area)[:, None]
    far *= _agreement(cosine)
    # Weight both parts by admissibility.
    admissible_share = np.ones(len(points))
    if admissible is not None and per_sample is not None:
        whole = near + far.sum(axis=1)
        near = near * np.maximum((admissible * copied).sum(axis=1), LEAST_ADMISSIBILITY)
        far *= np.take_along_axis(per_sample, column[index], axis=1)
        admissible_share = (near + far.sum(axis=1)) / whole
    # Take the mean of the closest points' and the samples' weights.
    rows = np.repeat(np.arange(len(points)), count)
    matrix = sp.csr_matrix((far.ravel(), (rows, index.ravel())), (len(points), len(samples.points)))
    values = (near[:, None] * copied + matrix @ samples.weights) / (near + far.sum(axis=1))[:, None]
    return values, admissible_share


def _agreement(cosine: np.ndarray) -> np.ndarray:
    """Return how far normals agree, 1 to nearly 0; a half without a normal (NaN).

    The floor of 0.02 is for linings, which face away from all skin near them and still belong there.
    """
    return np.maximum((1.0 + np.nan_to_num(cosine)) / 2.0, 0.02)


def with_linings(
    weights: Float64[np.ndarray, "N J"],
    target: TriangleMesh,
    normals: Float[np.ndarray, "N 3"],
    angle: Float[np.ndarray, " N"],
    *,
    thickness: tuple[float, float],
) -> Float64[np.ndarray, "N J"]:
    """Return weights in which the inner side of cloth with two sides moves as the outer side does.

    A lining faces the skin, so that it matches none of it: its weights come from elsewhere, and in another pose it
    stands out of the cloth that it lines. It takes those of the outer side right behind it.

    Args:
        weights: rows sum to 1.
        target: the cloth.
        normals: of its vertices, outward.
        angle: radians between them and the normals of the skin; NaN counts as outer side.
        thickness: metres from which on a side follows the other less, and from which on not at all.
    """
    inner = angle > 0.5 * np.pi
    outer = ~inner[target.faces].any(axis=1)
    if not inner.any() or not outer.any():
        return weights
    sheet, used = target.submesh(outer)
    found = closest_points(sheet, target)
    # Cloth before it, as a sleeve beside the trunk, is another garment's side; opposite is within 60 degrees.
    behind = ((found.interpolate(sheet, sheet.vertices) - target.vertices) * normals).sum(axis=1) < 0.0
    lines = inner & behind & (found.angle > np.radians(120.0))
    # A hem that is folded in is a few hundredths of a garment; the step of weights at its edge stretched a skirt by a
    # quarter more. A lining is at least a jacket's facings, a tenth.
    if lines.mean() < 0.1:
        return weights
    share = lines * (1.0 - smooth_step(found.distance, *thickness))
    return weights + share[:, None] * (found.interpolate(sheet, weights[used]) - weights)
