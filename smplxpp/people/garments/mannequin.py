"""The open body in the T-pose as a tailor's form: joints by name, outlines by height, skinning weights by place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from smplxpp.body import BodyModel
from smplxpp.core.params import BodyParams
from smplxpp.people.cloth_mesh import ClothMesh, outer_faces

# Parts of joint names, without the side.
HAND_JOINTS = ("elbow", "wrist", "index", "middle", "pinky", "ring", "thumb")
ARM_JOINTS = ("shoulder", *HAND_JOINTS)
ARMS_DOWN = 78.0
"""Degrees of arms that hang under what is worn over the shoulders."""
_HEAD_JOINTS = ("head", "jaw", "eye")

# Outlines are sampled at heights this far apart (metres) and in this many directions around the trunk: finer than the
# garments' own meshes, so that cloth laid on an outline shows no steps.
_STEP, _DIRECTIONS = 0.02, 72


@dataclass(frozen=True, eq=False)
class Mannequin:
    """A person in the T-pose. Azimuths are radians from +x (the person's left) towards +z (the front).

    Attributes:
        body: the body model.
        params: the T-pose of the person.
        skin: the outer skin with its skinning weights.
        joints: joint positions (3,) by name, metres.
        outlines: radius of the convex outline of trunk and legs, heights x azimuths, about the trunk's axis.
        low: height of the first outline, metres.
    """

    body: BodyModel
    params: BodyParams
    skin: ClothMesh
    joints: dict[str, np.ndarray]
    outlines: Float[np.ndarray, "H D"]
    low: float

    @staticmethod
    def of(body: BodyModel, betas: Float[np.ndarray, " B"]) -> Mannequin:
        """Return the mannequin of shape coefficients."""
        params = BodyParams.rest(betas=betas, expressions=body.num_expressions)
        posed = body.forward(params)
        skin, used = body.mesh(posed.vertices[0]).submesh(outer_faces(body))
        cloth = ClothMesh(skin.vertices, skin.faces, body.weights[used])
        return Mannequin.cut_on(body, params, cloth, dict(zip(body.joint_names, posed.joints[0], strict=True)))

    @staticmethod
    def cut_on(body: BodyModel, params: BodyParams, skin: ClothMesh, joints: dict[str, np.ndarray]) -> Mannequin:
        """Return the mannequin of a skin and its joints, of any size."""
        # Arms and head would widen the outlines.
        torso = shares(body, skin.weights, (*ARM_JOINTS, *_HEAD_JOINTS)) < 0.5
        low, outlines = outlines_of(skin.vertices[torso], joints["pelvis"][2])
        return Mannequin(body, params, skin, joints, outlines, low)

    @property
    def axis(self) -> np.ndarray:
        """Position (2,) of the trunk's vertical axis: x and z, metres."""
        return np.array([0.0, self.joints["pelvis"][2]])

    def outline(self, height: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        """Return the distance from the axis to the outline of trunk and legs, bilinear; the arrays broadcast."""
        row = np.clip((height - self.low) / _STEP, 0, len(self.outlines) - 1.001)
        column = np.mod(azimuth, 2 * np.pi) / (2 * np.pi) * _DIRECTIONS
        r, c = np.broadcast_arrays(row, column)
        i, j = r.astype(int), c.astype(int) % _DIRECTIONS
        u, v = r - i, c - np.floor(c)
        # Columns wrap around; rows do not.
        o, k = self.outlines, (j + 1) % _DIRECTIONS
        return (1 - u) * ((1 - v) * o[i, j] + v * o[i, k]) + u * ((1 - v) * o[i + 1, j] + v * o[i + 1, k])

    def at(self, height: np.ndarray, azimuth: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Return points (..., 3) of cylinder coordinates about the trunk's axis; the arrays broadcast."""
        h, a, r = np.broadcast_arrays(height, azimuth, radius)
        return np.stack([self.axis[0] + r * np.cos(a), h, self.axis[1] + r * np.sin(a)], axis=-1)

    def inner_points(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
        """Return the point of the trunk's axis at the height of each point."""
        return np.column_stack([0 * points[:, 0], points[:, 1], 0 * points[:, 0] + self.axis[1]])

    def unweighted(self, points: Float[np.ndarray, "N 3"], faces: np.ndarray) -> ClothMesh:
        """Return a mesh with zero weights, to be painted once its vertices are in place."""
        return ClothMesh(points, faces, np.zeros((len(points), self.body.joint_count)))

    def rigid(self, name: str, count: int) -> np.ndarray:
        """Return (count, J) weights that follow one joint."""
        rows = np.zeros((count, self.body.joint_count))
        rows[:, self.body.joint_names.index(name)] = 1.0
        return rows

    def trunk_weights(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N J"]:
        """Return the weights of the trunk's skin at the same height and azimuth, averaged over a few centimetres.

        The trunk is the skin that follows pelvis, spine, collars, hips and neck. How far a point stands off the skin
        does not matter.
        """
        # Restrict the skin to vertices of the trunk, and their weights to its joints.
        names = ("pelvis", "spine", "collar", "hip", "neck")
        kept = shares(self.body, self.skin.weights, names) > 0.9
        own = self.skin.weights[kept] * named(self.body, names)
        own /= own.sum(axis=1, keepdims=True)
        return _mean_of_nearest(self._unrolled(self.skin.vertices[kept]), own, self._unrolled(points))

    def arm_weights(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N J"]:
        """Return the mean weights around the arm at the same place along it; hands count as the wrist."""
        weights = self.skin.weights.copy()
        for side in ("left", "right"):
            # Weights of the fingers are added to the wrist.
            fingers = [i for i, n in enumerate(self.body.joint_names) if n.startswith(side) and n[-1].isdigit()]
            fingers = [i for i in fingers if "spine" not in self.body.joint_names[i]]
            weights[:, self.body.joint_names.index(f"{side}_wrist")] += weights[:, fingers].sum(axis=1)
            weights[:, fingers] = 0.0
        kept = shares(self.body, self.skin.weights, ARM_JOINTS) > 0.5
        place = self.skin.vertices[kept][:, :1]
        return _mean_of_nearest(place, weights[kept], points[:, :1])

    def below(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N J"]:
        """Return the weights of the skin straight below points that rest on the shoulders."""
        # Skin that faces up, above the chest, but not of the head.
        up = (self.skin.mesh.vertex_normals[:, 1] > 0.2) & (shares(self.body, self.skin.weights, _HEAD_JOINTS) < 0.5)
        up &= self.skin.vertices[:, 1] > self.joints["spine3"][1]
        return _mean_of_nearest(self.skin.vertices[up][:, [0, 2]], self.skin.weights[up], points[:, [0, 2]])

    def _unrolled(self, points: np.ndarray) -> np.ndarray:
        """Return height, and the azimuth as a point of a circle with about the trunk's radius (13 cm)."""
        flat = points[:, [0, 2]] - self.axis
        flat = 0.13 * flat / np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-9)
        return np.column_stack([points[:, 1], flat])


def lowered(mannequin: Mannequin, degrees: float) -> BodyParams:
    """Return a pose with arms lowered by `degrees`, elbows a little bent and feet a step apart."""
    pose = np.zeros((1, 55, 3))
    names = mannequin.body.joint_names
    for side, sign in (("left", -1.0), ("right", 1.0)):
        pose[0, names.index(f"{side}_collar"), 2] = 0.12 * sign * degrees
        pose[0, names.index(f"{side}_shoulder"), 2] = 0.88 * sign * degrees
        pose[0, names.index(f"{side}_elbow"), 1] = 8.0 * sign
        pose[0, names.index(f"{side}_hip"), 2] = -4.0 * sign
    p = mannequin.params
    return BodyParams.from_full_pose(np.radians(pose), betas=p.betas, expression=p.expression, transl=p.transl)


def named(body: BodyModel, words: tuple[str, ...]) -> np.ndarray:
    """Return which joints (J,) have one of the words in their names."""
    return np.array([any(word in name for word in words) for name in body.joint_names])


def shares(body: BodyModel, weights: np.ndarray, words: tuple[str, ...]) -> np.ndarray:
    """Return the weight (N,) that belongs to the joints whose names hold one of the words."""
    return weights[:, named(body, words)].sum(axis=1)


def _mean_of_nearest(places: np.ndarray, weights: np.ndarray, queries: np.ndarray, count: int = 24) -> np.ndarray:
    """Return the mean weights of the nearest places under a Gaussian kernel as wide as their mean distance."""
    distance, index = cKDTree(places).query(queries, k=count)
    kernel = np.exp(-0.5 * (distance / np.maximum(distance.mean(axis=1, keepdims=True), 0.01)) ** 2)
    out = np.einsum("nk,nkj->nj", kernel, weights[index])
    return out / out.sum(axis=1, keepdims=True)


def outlines_of(points: np.ndarray, depth: float) -> tuple[float, np.ndarray]:
    """Return the lowest height, and the convex outlines of slices from there up as radii by azimuth."""
    heights = np.arange(points[:, 1].min(), points[:, 1].max(), _STEP)
    azimuth = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    axes = np.stack([np.cos(azimuth), np.sin(azimuth)])
    cosine = np.cos(azimuth[:, None] - azimuth)
    rows: list[np.ndarray] = []
    for height in heights:
        near = points[np.abs(points[:, 1] - height) < 0.75 * _STEP]
        if len(near) < 3:
            rows.append(rows[-1])
            continue
        # The support function of the slice; a ray leaves the hull at the nearest of its tangents.
        support = ((near[:, [0, 2]] - [0.0, depth]) @ axes).max(axis=0)
        rays = np.where(cosine > 0.05, support / np.maximum(cosine, 0.05), np.inf)
        rows.append(np.maximum(rays.min(axis=1), 0.02))
    return float(heights[0]), np.array(rows)
