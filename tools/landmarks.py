"""Place 51 face landmarks in dlib's order 17..67 on the open body, where the mesh's own face units act.

Approximate: a schematic, symmetric face (arcs for brows, eyes and lips) drawn between features that are measured on
the mesh, then dropped onto its front. Expect some millimetres.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from tools.anny_base import JOINT_NAMES, BaseMesh
from tools.tpose_body import TPoseBody

_LASH_LENGTH = 0.004  # length in metres of lashes past the outer corner of the eye


def face_landmarks(
    base: BaseMesh, body: TPoseBody, expression_dirs: Float[np.ndarray, "V 3 E"]
) -> tuple[Int[np.ndarray, " 51"], Float[np.ndarray, "51 3"]]:
    """Return triangle and barycentric coordinates of each landmark.

    Order: right brow 5, left brow 5 (outer to inner, inner to outer), nose bridge 4, nostrils 5, right eye 6, left
    eye 6, outer lips 12, inner lips 8; "right" is the subject's.
    """
    points = _frontal_points(base, body, expression_dirs)
    neck = body.joints[JOINT_NAMES.index("neck")]
    triangles = body.vertices[body.faces].astype(np.float64)
    head = np.flatnonzero(triangles[..., 1].min(axis=1) > neck[1])
    return _drop_on_front(points, triangles, head)


def _frontal_points(
    base: BaseMesh, body: TPoseBody, expression_dirs: Float[np.ndarray, "V 3 E"]
) -> Float[np.ndarray, "51 2"]:
    """Draw x (to the subject's left) and y, from features of the left half mirrored."""

    def most_moved(unit: str) -> Float[np.ndarray, " 3"]:
        amount = np.linalg.norm(expression_dirs[:, :, base.expression_names.index(unit)], axis=1)
        return body.vertices[np.argmax(amount)].astype(np.float64)

    lashes = base.tpose_vertices(base.vertices, base.joints)[
        np.char.startswith(base.vertex_group, "helper-l-eyelashes")
    ]
    inner, outer = lashes[:, 0].min(), lashes[:, 0].max() - _LASH_LENGTH
    eye_y, half_eye = 0.5 * (lashes[:, 1].min() + lashes[:, 1].max()), 0.5 * (outer - inner)
    angles = np.radians([180, 120, 60, 0, -60, -120])  # inner corner, over the top, to the outer corner and back
    left_eye = np.stack(
        [0.5 * (inner + outer) + half_eye * np.cos(angles), eye_y + 0.35 * half_eye * np.sin(angles)], 1
    )

    arch = np.stack([most_moved(unit)[:2] for unit in ("browInnerUp", "browDownLeft", "browOuterUpLeft")])
    brow_x = np.linspace(inner - 0.3 * half_eye, outer + half_eye, 5)
    left_brow = np.stack([brow_x, np.polyval(np.polyfit(arch[:, 0], arch[:, 1], 2), brow_x)], 1)

    skin = body.vertices[body.labels == 0]
    midline = skin[(np.abs(skin[:, 0]) < 0.002) & (skin[:, 1] > body.joints[JOINT_NAMES.index("neck")][1])]
    tip = midline[np.argmax(midline[:, 2])]
    bridge = np.stack([np.zeros(4), np.linspace(eye_y, tip[1], 4)], 1)
    nostril_x = inner * np.array([-0.8, -0.4, 0.0, 0.4, 0.8])
    nostrils = np.stack([nostril_x, tip[1] - 0.011 - 0.004 * np.cos(np.pi * nostril_x / (1.6 * inner))], 1)

    corner = most_moved("mouthDimpleLeft")
    width, mouth_y = corner[0], corner[1]
    outer_lip = np.radians([180, 145, 112, 90, 68, 35, 0, -40, -68, -90, -112, -140])
    inner_lip = np.radians([180, 115, 90, 65, 0, -65, -90, -115])

    def lips(angles: Float[np.ndarray, " L"], radii: tuple[float, float, float]) -> Float[np.ndarray, "L 2"]:
        across, up, down = (r * width for r in radii)
        height = np.where(np.sin(angles) > 0, up, down)
        return np.stack([across * np.cos(angles), mouth_y + height * np.sin(angles)], 1)

    def mirrored(points: Float[np.ndarray, "L 2"]) -> Float[np.ndarray, "L 2"]:
        return points * [-1.0, 1.0]

    # dlib runs from the subject's right to the left: each eye clockwise as seen from the front, the first corner right.
    right_eye = mirrored(left_eye)[[3, 2, 1, 0, 5, 4]]
    parts = [mirrored(left_brow)[::-1], left_brow, bridge, nostrils, right_eye, left_eye]
    return np.concatenate([*parts, lips(outer_lip, (1.0, 0.25, 0.5)), lips(inner_lip, (0.85, 0.03, 0.15))])


def _drop_on_front(
    points: Float[np.ndarray, "L 2"], triangles: Float[np.ndarray, "F 3 3"], candidates: Int[np.ndarray, " C"]
) -> tuple[Int[np.ndarray, " L"], Float[np.ndarray, "L 3"]]:
    """Find the front-most candidate triangle over each (x, y), and the barycentric coordinates there."""
    a, b, c = triangles[candidates].transpose(1, 0, 2)
    ab, ac = (b - a)[:, :2], (c - a)[:, :2]
    area = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    upright = np.abs(area) > 1e-12
    area = np.where(upright, area, 1.0)
    ap = points[:, None] - a[None, :, :2]
    v = (ap[..., 0] * ac[:, 1] - ap[..., 1] * ac[:, 0]) / area
    w = (ab[:, 0] * ap[..., 1] - ab[:, 1] * ap[..., 0]) / area
    barycentric = np.stack([1 - v - w, v, w], axis=-1)
    inside = upright & (barycentric >= -1e-9).all(axis=-1)
    depth = np.where(inside, np.einsum("pmk,kmz->pm", barycentric, np.stack([a, b, c])[..., 2:]), -np.inf)
    best = np.argmax(depth, axis=1)
    rows = np.arange(len(points))
    assert np.isfinite(depth[rows, best]).all(), "a landmark misses the head"
    return candidates[best], barycentric[rows, best]
