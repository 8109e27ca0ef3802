"""Pose points of a body by linear blend skinning and differentiate them by every parameter, in closed form.

A small rotation vector d of joint j (in its parent's posed frame, `R_j <- exp(d) R_j`) moves every point that is
skinned to j or to a descendant of j about the posed joint p_j:

    dx_i = sum_{k in descendants(j)} w_ik (P_j d) x (G_k x_i - p_j) = -[A_ij - W_ij p_j]_x P_j d

with P_j the posed rotation of the parent, G_k the transform of joint k, w_ik the skinning weights,
`A_ij = sum_k w_ik G_k x_i` and `W_ij = sum_k w_ik` over the descendants of j, which include j. The shape moves the rest
points and the joints. The derivative of the pose correctives by the pose is neglected because they are millimetres; the
points themselves contain them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64, Integer

from smplxpp.body import BodyModel
from smplxpp.body.layout import POSE_NAMES
from smplxpp.core import POSE_BLOCKS, BodyParams, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.errors import one_line
from smplxpp.skinning.linear_blend import forward_kinematics


@dataclass(frozen=True, eq=False)
class BodyState:
    """Pose, translation and expression of a body in T frames, and its one shape.

    Attributes:
        rotations: of each joint, relative to its parent's frame.
        transl: metres.
        betas: coefficients of the shape.
        expression: coefficients of the expression of each frame.
    """

    rotations: Float64[np.ndarray, "T J 3 3"]
    transl: Float64[np.ndarray, "T 3"]
    betas: Float64[np.ndarray, " B"]
    expression: Float64[np.ndarray, "T E"]

    __repr__ = one_line

    def __len__(self) -> int:
        return len(self.rotations)

    def select(self, rows: slice | Integer[np.ndarray, " n"]) -> BodyState:
        """Return the state of some of the frames."""
        return replace(self, rotations=self.rotations[rows], transl=self.transl[rows], expression=self.expression[rows])

    @staticmethod
    def of_params(body: BodyModel, params: BodyParams) -> BodyState:
        """Convert parameters; the shape is their mean, padded or cut to the body's number of coefficients."""
        return BodyState(
            rotations=body.joint_rotations(params),
            transl=params.transl.copy(),
            betas=_resized(params.betas.mean(axis=0), body.num_betas),
            expression=np.stack([_resized(row, body.num_expressions) for row in params.expression]),
        )

    def to_params(self, body: BodyModel, *, fps: float | None = None) -> BodyParams:
        """Convert to parameters, whose hand poses are relative to flat hands."""
        # The full pose has the blocks of `POSE_BLOCKS` in order; those that the body does not have stay zero.
        vectors = rotvec_from_matrix(self.rotations)
        pose = np.zeros((len(self), sum(joints for _, joints in POSE_BLOCKS), 3))
        names, start = [name for name, _ in POSE_BLOCKS], np.cumsum([0] + [joints for _, joints in POSE_BLOCKS])
        read = 0
        for name in POSE_NAMES[body.joint_count]:
            k = names.index(name)
            pose[:, start[k] : start[k + 1]] = vectors[:, read : read + start[k + 1] - start[k]]
            read += start[k + 1] - start[k]
        return BodyParams.from_full_pose(
            pose,
            betas=self.betas[None],
            expression=self.expression,
            transl=self.transl,
            fps=fps,
            flat_hand_mean=True,
        )


@dataclass(frozen=True, eq=False)
class BodyPoints:
    """N points that move with a body by linear blend skinning.

    Attributes:
        rest: positions on the mean shape at rest, metres.
        shape_dirs: derivatives by betas, metres.
        expression_dirs: derivatives by the coefficients of the expression, metres.
        weights: skinning weights.
        pose_dirs: pose correctives, metres; None if there are none.
    """

    rest: Float64[np.ndarray, "N 3"]
    shape_dirs: Float64[np.ndarray, "N 3 B"]
    expression_dirs: Float64[np.ndarray, "N 3 E"]
    weights: Float64[np.ndarray, "N J"]
    pose_dirs: Float64[np.ndarray, "N 3 P"] | None = None

    def __len__(self) -> int:
        return len(self.rest)

    @staticmethod
    def of_vertices(body: BodyModel, index: Integer[np.ndarray, " N"]) -> BodyPoints:
        """Take some of a body's vertices as points."""
        return BodyPoints(
            body.v_template[index],
            body.shapedirs[index],
            body.exprdirs[index],
            body.weights[index],
            None if body.posedirs is None else body.posedirs[index],
        )

    @staticmethod
    def of_joints(body: BodyModel, index: Integer[np.ndarray, " N"]) -> BodyPoints:
        """Take some of a body's joints as points; each is skinned to its parent, the root to itself."""
        # A joint is a mean of vertices (row of the regressor), so that its shape directions are the same mean of
        # theirs. Its own rotation does not move it: it is rigid with its parent. Expression and pose correctives do not
        # move joints.
        carrier = np.where(body.parents[index] < 0, index, body.parents[index])
        regressor = body.joint_regressor[index]
        return BodyPoints(
            regressor @ body.v_template,
            np.einsum("nv,vxb->nxb", regressor, body.shapedirs),
            np.zeros((len(index), 3, body.num_expressions)),
            np.eye(body.joint_count)[carrier],
        )

    @staticmethod
    def joined(parts: list[BodyPoints]) -> BodyPoints:
        """Concatenate sets of points; the pose correctives of sets without any are zero."""
        have = [part.pose_dirs for part in parts if part.pose_dirs is not None]
        width = have[0].shape[2] if have else 0
        dirs = [np.zeros((len(p), 3, width)) if p.pose_dirs is None else p.pose_dirs for p in parts]
        return BodyPoints(
            np.concatenate([part.rest for part in parts]),
            np.concatenate([part.shape_dirs for part in parts]),
            np.concatenate([part.expression_dirs for part in parts]),
            np.concatenate([part.weights for part in parts]),
            np.concatenate(dirs) if have else None,
        )

    def select(self, rows: Integer[np.ndarray, " n"] | Bool[np.ndarray, " N"]) -> BodyPoints:
        """Return some of the points, in the given order."""
        return BodyPoints(
            self.rest[rows],
            self.shape_dirs[rows],
            self.expression_dirs[rows],
            self.weights[rows],
            None if self.pose_dirs is None else self.pose_dirs[rows],
        )

    def mixed(self, index: Integer[np.ndarray, "M C"], weight: Float[np.ndarray, "M C"]) -> BodyPoints:
        """Interpolate M points between C points each, such as the corners of a face, with all their attributes."""

        def blend(values: np.ndarray) -> np.ndarray:
            return np.einsum("mc,mc...->m...", weight, values[index])

        return BodyPoints(
            blend(self.rest),
            blend(self.shape_dirs),
            blend(self.expression_dirs),
            blend(self.weights),
            None if self.pose_dirs is None else blend(self.pose_dirs),
        )


@dataclass(frozen=True, eq=False)
class Posture:
    """The posed skeleton of one frame.

    Attributes:
        rotations: of the joints, in world coordinates.
        joints: positions of the joints, metres.
        transforms: of the joints, from rest to posed.
        parent_rotations: of each joint's parent in world coordinates, the identity for the root.
        betas: coefficients of the shape.
        expression: coefficients of the expression.
        pose_feature: input of the pose correctives, `R_j - I` of all joints but the root.
    """

    rotations: Float64[np.ndarray, "J 3 3"]
    joints: Float64[np.ndarray, "J 3"]
    transforms: Float64[np.ndarray, "J 4 4"]
    parent_rotations: Float64[np.ndarray, "J 3 3"]
    betas: Float64[np.ndarray, " B"]
    expression: Float64[np.ndarray, " E"]
    pose_feature: Float64[np.ndarray, " P"]


@dataclass(frozen=True, eq=False)
class PointsMotion:
    """Points of one frame with their derivatives; the derivative by the translation is the identity.

    Attributes:
        points: in world coordinates, metres.
        joints: the joints of the derivatives `pose`.
        pose: derivatives by the rotation vector of each of these joints in its parent's frame, metres a radian.
        shape: derivatives by betas, metres.
        expression: derivatives by the coefficients of the expression, metres.
    """

    points: Float64[np.ndarray, "N 3"]
    joints: Integer[np.ndarray, " J"]
    pose: Float64[np.ndarray, "N 3 J 3"]
    shape: Float64[np.ndarray, "N 3 B"]
    expression: Float64[np.ndarray, "N 3 E"]


class Kinematics:
    """Forward kinematics of a body of the SMPL family, with derivatives.

    Attributes:
        rest_joints: joints of the mean shape at rest, metres.
        joint_dirs: derivatives of the joints at rest by betas, metres.
        descends_from: whether joint (row) is joint (column) or a descendant of it.
    """

    def __init__(self, body: BodyModel) -> None:
        self.body, self.parents = body, body.parents
        self.rest_joints = body.joint_regressor @ body.v_template
        self.joint_dirs = np.einsum("jv,vxb->jxb", body.joint_regressor, body.shapedirs)
        count = body.joint_count
        descends_from = np.eye(count, dtype=bool)
        # Walk from each joint to the root and mark every joint on the path as its ancestor.
        for joint in range(count):
            above = joint
            while self.parents[above] >= 0:
                above = int(self.parents[above])
                descends_from[joint, above] = True
        self.descends_from: Bool[np.ndarray, "J J"] = descends_from
        # Joints ordered so that parents come before children.
        self._outwards = [int(joint) for joint in np.argsort(descends_from.sum(axis=1), kind="stable")]

    def posture(self, state: BodyState, row: int) -> Posture:
        """Pose the skeleton in one frame of a state."""
        rest = self.rest_joints + self.joint_dirs @ state.betas
        transforms, joints = forward_kinematics(rest, self.parents, state.rotations[row], transl=state.transl[row])
        rotations = transforms[:, :3, :3]
        parent = np.where((self.parents < 0)[:, None, None], np.eye(3), rotations[np.maximum(self.parents, 0)])
        feature = (state.rotations[row, 1:] - np.eye(3)).ravel()
        return Posture(rotations, joints, transforms, parent, state.betas, state.expression[row], feature)

    def points(self, points: BodyPoints, posture: Posture) -> Float64[np.ndarray, "N 3"]:
        """Return the posed positions of points, metres."""
        rest = self._rest(points, posture)
        # Linear blend skinning, x = sum_k w_k (R_k x_rest + t_k): blend the upper 3 x 4 parts, then apply them to the
        # points.
        flat = points.weights @ posture.transforms[:, :3].reshape(-1, 12)
        blended = flat.reshape(-1, 3, 4)
        return np.einsum("nxy,ny->nx", blended[..., :3], rest) + blended[..., 3]

    def motion(
        self, points: BodyPoints, posture: Posture, joints: Integer[np.ndarray, " J"] | None = None
    ) -> PointsMotion:
        """Return the posed positions of points and their derivatives by all parameters.

        Args:
            points: of the body.
            posture: of the frame.
            joints: joints whose derivatives are needed; None for all. Fingers are most of a body's joints, and a search
                that leaves them out takes a third of the time.
        """
        count = len(self.parents)
        joints = np.arange(count) if joints is None else joints
        rest = self._rest(points, posture)
        # w_ik G_k x_i for each point i and joint k; the sum over k is the skinned point.
        moved = rest @ posture.rotations.transpose(0, 2, 1).transpose(1, 0, 2).reshape(3, -1)
        moved = (moved.reshape(-1, count, 3) + posture.transforms[:, :3, 3]) * points.weights[..., None]
        # A_ij - W_ij p_j: sums over the descendants of j, the lever arm of a rotation about p_j.
        descends = self.descends_from[:, joints].astype(np.float64)
        arm = np.einsum("nkx,kj->njx", moved, descends, optimize=True)
        arm -= (points.weights @ descends)[..., None] * posture.joints[joints]
        # -[a]_x P: its column c is the cross product of column c of P with the arm a. Joints vary fastest in memory.
        ax, ay, az = np.ascontiguousarray(arm.transpose(2, 0, 1))
        pose = np.empty((len(arm), 3, len(joints), 3))
        for axis in range(3):
            px, py, pz = posture.parent_rotations[joints, :, axis].T
            np.subtract(py * az, pz * ay, out=pose[:, 0, :, axis])
            np.subtract(pz * ax, px * az, out=pose[:, 1, :, axis])
            np.subtract(px * ay, py * ax, out=pose[:, 2, :, axis])
        # The shape moves the rest point, which the blended rotation carries along, and the transforms of the joints.
        blended = (points.weights @ posture.rotations.reshape(count, 9)).reshape(-1, 3, 3)
        shape = blended @ points.shape_dirs
        shape += np.einsum("nk,kxb->nxb", points.weights, self._joint_shape(posture), optimize=True)
        return PointsMotion(
            points=moved.sum(axis=1),
            joints=joints,
            pose=pose,
            shape=shape,
            expression=blended @ points.expression_dirs,
        )

    def updated(
        self,
        state: BodyState,
        rotvecs: Float64[np.ndarray, "T J 3"],
        transl: Float64[np.ndarray, "T 3"],
        betas: Float64[np.ndarray, " B"],
        expression: Float64[np.ndarray, "T E"],
    ) -> BodyState:
        """Return the state after an update, in which the rotation of joint j becomes `exp(d_j) R_j`."""
        return BodyState(
            # Multiplied on the left instead of added, so that rotations stay in SO(3) and the Jacobians above hold.
            matrix_from_rotvec(rotvecs) @ state.rotations,
            state.transl + transl,
            state.betas + betas,
            state.expression + expression,
        )

    def _rest(self, points: BodyPoints, posture: Posture) -> Float64[np.ndarray, "N 3"]:
        rest = points.rest + points.shape_dirs @ posture.betas + points.expression_dirs @ posture.expression
        return rest if points.pose_dirs is None else rest + points.pose_dirs @ posture.pose_feature

    def _joint_shape(self, posture: Posture) -> Float64[np.ndarray, "J 3 B"]:
        """Return the derivative of each transform's translation by betas, `dp_j - R_j dJ_j`."""
        # dp_j, from the root outwards: a posed joint moves with its parent and with their rotated offset.
        moved = np.zeros_like(self.joint_dirs)
        for level in self._outwards:
            parent = self.parents[level]
            if parent < 0:
                moved[level] = self.joint_dirs[level]
            else:
                offset = self.joint_dirs[level] - self.joint_dirs[parent]
                moved[level] = moved[parent] + posture.rotations[parent] @ offset
        return moved - posture.rotations @ self.joint_dirs


def _resized(values: np.ndarray, size: int) -> np.ndarray:
    out = np.zeros(size)
    count = min(size, len(values))
    out[:count] = values[:count]
    return out
