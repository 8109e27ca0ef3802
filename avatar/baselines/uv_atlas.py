"""Make a UV atlas from the template alone: a cylindrical chart for each limb, packed by size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int, Int64
from scipy.spatial import cKDTree

from smplxpp.template.template import Template

BODY_JOINTS = 22
"""Number of SMPL-X's body joints. Joints of face and hands belong to their nearest body ancestor."""
GUTTER = 2
"""Free texels around each chart."""
REACH = 2.5
"""Largest distance from a texel to its anchor point, texels."""


@dataclass(frozen=True, eq=False)
class Atlas:
    """N points of a template in a square of `size` texels.

    Attributes:
        size: texels a side.
        pixels: column and row of each point, texel centres at +0.5.
        anchor: nearest point of each texel within `REACH`; -1 where there is none.
        chart: the chart of each point.
    """

    size: int
    pixels: Float64[np.ndarray, "N 2"]
    anchor: Int64[np.ndarray, "S S"]
    chart: Int64[np.ndarray, " N"]


def cylinder_atlas(
    template: Template, points: Float[np.ndarray, "N 3"], faces: Int[np.ndarray, " N"], *, size: int
) -> Atlas:
    """Unwrap points on the template's faces in the T-pose.

    A chart holds the points of one part that follow one body joint most. Its axis is the direction of its largest
    variance, u the angle around it times the mean radius, and v the height along it. All charts have the same texel
    density and are packed in rows. Nested surfaces (a tongue in a mouth) have separate charts if the body labels them.

    Args:
        template: with the faces.
        points: in the T-pose, metres.
        faces: face of each point.
        size: texels a side.
    """
    # A chart for each body joint and part, renumbered without gaps; each is unrolled to metres along u and v.
    chart = _charts(template)[template.faces[faces, 0]]
    chart = np.unique(chart, return_inverse=True)[1]
    flat = np.zeros((len(points), 2))
    for k in range(chart.max() + 1):
        flat[chart == k] = _unrolled(points[chart == k])
    low = np.stack([_by_chart(np.minimum, flat[:, axis], chart) for axis in (0, 1)], axis=1)
    extent = np.stack([_by_chart(np.maximum, flat[:, axis], chart) for axis in (0, 1)], axis=1) - low
    # One density for all charts keeps texels of the same size everywhere on the body.
    corners, density = _packed(extent, size)
    pixels = corners[chart] + GUTTER + (flat - low[chart]) * density
    # Each texel takes the nearest point, so that its position can be interpolated from that point's face.
    centres = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2) + 0.5
    distance, nearest = cKDTree(pixels).query(centres)
    anchor = np.where(distance <= REACH, nearest, -1).reshape(size, size)
    return Atlas(size, pixels, anchor, chart)


def _charts(template: Template) -> np.ndarray:
    """Return the (V,) chart of each vertex, by its part, the body's label and its heaviest body joint."""
    # Fingers and face have many joints and small areas: move up the tree until a joint of the body is reached.
    joint = np.argmax(template.weights.dense(), axis=1)
    while (outside := joint >= BODY_JOINTS).any():
        joint = np.where(outside, template.body.parents[joint], joint)
    label = template.body.part_labels[template.body_index]
    return (template.vertex_part * len(template.body.part_label_names) + label) * BODY_JOINTS + joint


def _unrolled(points: np.ndarray) -> np.ndarray:
    """Return (n, 2) metres along the circumference and along the axis of (n, 3) points; the seam lies at the back."""
    # The axis is the direction of the largest variance, the last eigenvector of the scatter matrix.
    centred = points - points.mean(axis=0)
    axis = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    # Front is +z of the T-pose without its component along the axis; for limbs along z (feet) it is +y.
    towards = np.eye(3)[1] if abs(axis[2]) > 0.7 else np.eye(3)[2]
    front = towards - (towards @ axis) * axis
    front /= np.linalg.norm(front)
    side = np.cross(axis, front)
    # Angle 0 points to the front, so that the jump of arctan2 from pi to -pi, the seam, lies at the back.
    x, z = centred @ side, centred @ front
    return np.stack([np.arctan2(x, z) * np.hypot(x, z).mean(), centred @ axis], axis=1)


def _by_chart(reduce: np.ufunc, values: np.ndarray, chart: np.ndarray) -> np.ndarray:
    start = np.inf if reduce is np.minimum else -np.inf
    out = np.full(chart.max() + 1, start)
    reduce.at(out, chart, values)
    return out


def _packed(extent: np.ndarray, size: int) -> tuple[np.ndarray, float]:
    """Return (K, 2) corners of K charts in texels, and the largest density, texels a metre, at which they all fit."""
    # Bisection on the density: the boxes fit at `low` and do not at `high`; 20 halvings are finer than a texel.
    low, high = 0.0, size / max(extent.max(), 1e-6)
    corners = _rows(np.ceil(low * extent) + 2 * GUTTER, size)
    for _ in range(20):
        middle = 0.5 * (low + high)
        placed = _rows(np.ceil(middle * extent) + 2 * GUTTER, size)
        if placed is None:
            high = middle
        else:
            low, corners = middle, placed
    assert corners is not None  # boxes of gutters alone fit
    return corners, low


def _rows(boxes: np.ndarray, size: int) -> np.ndarray | None:
    """Return (K, 2) corners of (K, 2) boxes put in rows, the highest first; None if they do not fit."""
    # Shelf packing: boxes in rows, sorted by height, so that little of a row's height is lost.
    corners = np.zeros_like(boxes)
    left = top = height = 0.0
    # Each box goes beside the one before it: a loop over charts, not over vertices.
    for k in np.argsort(-boxes[:, 1], kind="stable"):
        if left + boxes[k, 0] > size:
            left, top, height = 0.0, top + height, 0.0
        corners[k] = left, top
        left, height = left + boxes[k, 0], max(height, boxes[k, 1])
        if left > size or top + height > size:
            return None
    return corners
