"""Build garment meshes: layers grown from the skin, and sheets laid out in coordinates of their own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from smplxpp.core.topology import face_components
from smplxpp.people.cloth_mesh import ClothMesh, clip, lift_outside, smooth, submesh
from smplxpp.people.garments.mannequin import Mannequin
from smplxpp.people.textures import ramp

Level = Callable[[np.ndarray], np.ndarray]
"""Maps points (N, 3) to a level (N,) that is positive where the garment is, in metres from its hem."""


@dataclass(frozen=True, eq=False)
class Garment:
    """A garment on a person in the T-pose.

    Attributes:
        name: name of the garment.
        label: the label that a segmentation would give it.
        make: returns its mesh with authored weights.
        rule: description of the rule that gives the weights.
        loose: whether it hangs free of the skin, so that the nearest skin does not tell which joints it follows.
        beside_hands: whether arms may hang beside it, as it follows neither arm.
        pose: the one pose of the wardrobe in which it can be worn, such as over hanging arms; None: in all.
    """

    name: str
    label: str
    make: Callable[[], ClothMesh]
    rule: str = "the weights of the skin that each vertex was grown from"
    loose: bool = False
    beside_hands: bool = False
    pose: str | None = None

    @cached_property
    def cloth(self) -> ClothMesh:
        """The mesh with its authored weights, built at the first access."""
        return self.make()


def layer(
    mannequin: Mannequin, level: Level, *, ease: float | Callable[[np.ndarray], np.ndarray], fairing: int = 4
) -> ClothMesh:
    """Return the skin where `level` is positive, smoothed and lifted by `ease` metres along the normals.

    A vertex keeps the weights of the skin that it was grown from.
    """
    # Cut the skin along the garment's hems.
    whole = mannequin.skin
    cloth = clip(whole, level(whole.vertices))
    lift = ease(cloth.vertices) if callable(ease) else np.full(len(cloth.vertices), ease)
    # Smooth away the skin's relief, then lift the surface along normals that are as smooth.
    mesh = cloth.mesh
    vertices = smooth(mesh, cloth.vertices, steps=fairing)
    normals = smooth(mesh, mesh.with_vertices(vertices).vertex_normals, steps=fairing)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    vertices = vertices + lift[:, None] * normals
    lifted = cloth.with_vertices(lift_outside(mesh.with_vertices(vertices), whole.mesh, clearance=0.003, solid=True))
    # Drop crumbs that the cut leaves, below 5 % of the faces.
    component = face_components(lifted.faces)
    return submesh(lifted, np.bincount(component)[component] > 0.05 * len(component))


def grid_faces(rows: int, columns: int, *, closed: bool) -> Int[np.ndarray, "M 3"]:
    """Return the faces of a sheet of rows x columns points, the columns closed to a ring or not.

    Seen from the front side rows go down and columns to the left: outward for rows downwards and azimuths that grow.
    """
    # Two triangles for each cell of the grid.
    across = columns if closed else columns - 1
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(across), indexing="ij")
    a, b = (i * columns + j).ravel(), (i * columns + (j + 1) % columns).ravel()
    c, d = a + columns, b + columns
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)])


def hang(
    mannequin: Mannequin,
    heights: Float[np.ndarray, " R"],
    azimuths: Float[np.ndarray, " C"],
    *,
    closed: bool,
    flare: float = 0.0,
    stand_off: float = 0.008,
    pleats: tuple[int, float] = (0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (R * C, 3) and faces of cloth that hangs about the trunk from the first height down.

    It follows the outline at a distance of `stand_off` metres.

    Args:
        mannequin: the person.
        heights: of the rows, metres, descending.
        azimuths: of the columns, radians.
        closed: whether the last column joins the first.
        flare: metres of radius gained a metre of height, below the widest place of the hips.
        stand_off: metres between outline and cloth.
        pleats: their number around, and their depth in metres a metre below the hips.
    """
    hips = mannequin.joints["left_hip"][1]
    outline = mannequin.outline(heights[:, None], azimuths[None, :]) + stand_off
    radius = outline.copy()
    # Below the hips cloth hangs: its radius never shrinks downwards.
    for row in range(1, len(heights)):
        free = heights[row] < hips + 0.06
        grow = flare * (heights[row - 1] - heights[row]) if free else 0.0
        if free:
            radius[row] = np.maximum(radius[row], radius[row - 1] + grow)
    count, depth = pleats
    down = np.clip(hips + 0.06 - heights, 0.0, None)
    radius += (depth * down)[:, None] * (1.0 + np.sin(count * azimuths + 0.4 * np.sin(3 * azimuths)))[None, :]
    points = mannequin.at(heights[:, None], azimuths[None, :], radius).reshape(-1, 3)
    faces = grid_faces(len(heights), len(azimuths), closed=closed)
    return points, faces[:, ::-1]


def around(count: int = 100) -> np.ndarray:
    """Return `count` azimuths of a closed ring, radians."""
    return 2 * np.pi * np.arange(count) / count


def skirt_weights(
    mannequin: Mannequin, points: Float[np.ndarray, "N 3"], *, legs: float, shins: float
) -> Float[np.ndarray, "N J"]:
    """Return the skinning weights of a skirt from its own coordinates.

    Down to the hips' joints it follows the trunk at the same height and azimuth. From there to 22 cm below them the
    thighs take over a share that grows smoothly to `legs`; the pelvis keeps the rest. Left and right share it by how
    far a point lies to the side of its own ring (smoothly, half each at the middle). From 5 cm above the knee to 25 cm
    below it the shins take over up to `shins` of the legs' share.
    """
    joints, body = mannequin.joints, mannequin.body
    hip, knee = joints["left_hip"][1], joints["left_knee"][1]
    x, y, _ = points.T
    # The share of the left leg, by the place across the ring.
    half = 0.8 * np.maximum(np.hypot(x, points[:, 2] - mannequin.axis[1]), 0.05)
    left = ramp(x / half, -1.0, 1.0)
    leg = legs * ramp(y, hip, hip - 0.22)
    shin = shins * ramp(y, knee + 0.05, knee - 0.25)
    # Pelvis, thighs and shins below the hips; the trunk's weights above them.
    rows = mannequin.rigid("pelvis", len(points)) * (1 - leg)[:, None]
    for side, share in (("left", left), ("right", 1 - left)):
        rows[:, body.joint_names.index(f"{side}_hip")] += leg * share * (1 - shin)
        rows[:, body.joint_names.index(f"{side}_knee")] += leg * share * shin
    below = ramp(y, hip + 0.04, hip - 0.04)[:, None]
    return below * rows + (1 - below) * mannequin.trunk_weights(points)


def joined(*pieces: ClothMesh) -> ClothMesh:
    """Return pieces as one garment of several components."""
    offsets = np.cumsum([0, *(len(piece.vertices) for piece in pieces[:-1])])
    return ClothMesh(
        np.concatenate([piece.vertices for piece in pieces]),
        np.concatenate([piece.faces + offset for piece, offset in zip(pieces, offsets, strict=True)]),
        np.concatenate([piece.weights for piece in pieces]),
    )


def sewn(first: ClothMesh, edge: Int[np.ndarray, " A"], second: ClothMesh, to: Int[np.ndarray, " B"]) -> ClothMesh:
    """Return two sheets as one: a strip of triangles joins an edge of either, both from the same end to the other.

    The strip continues along the edge whose next vertex lies less far along it.
    """
    both = joined(first, second)
    paths = [edge, to + len(first.vertices)]
    along = []
    for path in paths:
        steps = np.linalg.norm(np.diff(both.vertices[path], axis=0), axis=1)
        along.append(np.concatenate([[0.0], np.cumsum(steps) / steps.sum()]))
    i, j, strip = 0, 0, []
    while i + 1 < len(edge) or j + 1 < len(to):
        if j + 1 == len(to) or (i + 1 < len(edge) and along[0][i + 1] <= along[1][j + 1]):
            strip.append((paths[0][i], paths[0][i + 1], paths[1][j]))
            i += 1
        else:
            strip.append((paths[0][i], paths[1][j + 1], paths[1][j]))
            j += 1
    return ClothMesh(both.vertices, np.concatenate([both.faces, np.array(strip)]), both.weights)


def tube_along(curve: Float[np.ndarray, "R 3"], radii: Float[np.ndarray, " R"], *, sides: int = 24) -> tuple:
    """Return points and faces of a tube about a curve, normals outward, ends open."""
    # A frame across the curve, from a fixed vector that no curve here is parallel to.
    tangent = np.gradient(curve, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    first = np.cross(tangent, [0.31, 0.12, 0.94])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    second = np.cross(tangent, first)
    angle = around(sides)
    ring = np.cos(angle)[None, :, None] * first[:, None] + np.sin(angle)[None, :, None] * second[:, None]
    points = curve[:, None] + radii[:, None, None] * ring
    return points.reshape(-1, 3), grid_faces(len(curve), sides, closed=True)[:, ::-1]


def facing_out(cloth: ClothMesh, inner: Float[np.ndarray, "N 3"]) -> ClothMesh:
    """Return the sheet wound so that its normals point away from the inner point of each vertex."""
    # The mean over all vertices decides, so that folds do not matter.
    outward = np.einsum("ij,ij->i", cloth.mesh.vertex_normals, cloth.vertices - inner).mean()
    return cloth if outward > 0 else ClothMesh(cloth.vertices, cloth.faces[:, ::-1], cloth.weights)
