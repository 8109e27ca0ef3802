"""Points of a posed body and how they move with every parameter, in closed form.

A joint j turned by a small rotation vector d (in its parent's posed frame, `R_j <- exp(d) R_j`) moves every point that
hangs on it about the posed joint p_j:

    dx_i = sum_{k in descendants(j)} w_ik (P_j d) x (G_k x_i - p_j) = -[A_ij - W_ij p_j]_x P_j d

with P_j the parent's posed rotation, `A_ij = sum_k w_ik G_k x_i` and `W_ij = sum_k w_ik` over the descendants of j,
itself among them. Shape moves the rest points and the joints; the change of pose correctives with the pose is left out
of the derivative (they are millimetres), not of the points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64, Integer

from smplxpp.body import BodyModel
from smplxpp.body.layout import POSE_NAMES
from smplxpp.core.params import POSE_BLOCKS, BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix
from smplxpp.skinning.linear_blend import forward_kinematics


@dataclass(frozen=True, eq=False)
class BodyState:
    """A body in T frames; one shape.

    Attributes:
        rotations: of each joint relative to its parent's frame. transl: metres.
        betas: shape. expression: of each frame.
    """

    rotations: Float64[np.ndarray, "T J 3 3"]
    transl: Float64[np.ndarray, "T 3"]
    betas: Float64[np.ndarray, " B"]
    expression: Float64[np.ndarray, "T E"]

    def __len__(self) -> int:
        return len(self.rotations)

    def select(self, rows: slice | Integer[np.ndarray, " n"]) -> BodyState:
        """Some of the frames."""
        return replace(self, rotations=self.rotations[rows], transl=self.transl[rows], expression=self.expression[rows])

    @staticmethod
    def of_params(body: BodyModel, params: BodyParams) -> BodyState:
        """The state of parameters; their mean shape, padded or cut to the body's number of coefficients."""
        return BodyState(
            rotations=body.joint_rotations(params),
            transl=params.transl.copy(),
            betas=_resized(params.betas.mean(axis=0), body.num_betas),
            expression=np.stack([_resized(row, body.num_expressions) for row in params.expression]),
        )

    def to_params(self, body: BodyModel, *, fps: float | None = None) -> BodyParams:
        """The same as parameters, hands complete."""
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
    """N points that a body carries.

    Attributes:
        rest: on the mean shape, metres. weights: skinning weights.
        shape_dirs, expression_dirs: metres a unit. pose_dirs: pose correctives, None without.
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
        """Vertices of a body."""
        return BodyPoints(
            body.v_template[index],
            body.shapedirs[index],
            body.exprdirs[index],
            body.weights[index],
            None if body.posedirs is None else body.posedirs[index],
        )

    @staticmethod
    def of_joints(body: BodyModel, index: Integer[np.ndarray, " N"]) -> BodyPoints:
        """Joints of a body: each hangs on its parent, the root on itself."""
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
        """Several one after the other; pose correctives of parts without are zero."""
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
        """Some of the points, in any order."""
        return BodyPoints(
            self.rest[rows],
            self.shape_dirs[rows],
            self.expression_dirs[rows],
            self.weights[rows],
            None if self.pose_dirs is None else self.pose_dirs[rows],
        )

    def mixed(self, index: Integer[np.ndarray, "M C"], weight: Float[np.ndarray, "M C"]) -> BodyPoints:
        """M points between C near ones each (corners of a face): all that they have is blended."""

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
    """One frame of a state, its skeleton posed.

    Attributes:
        turned: rotations of the joints in the world. joints: posed. transforms: posed from rest.
        parent_turned: rotation of each joint's parent, the identity at the root.
    """

    turned: Float64[np.ndarray, "J 3 3"]
    joints: Float64[np.ndarray, "J 3"]
    transforms: Float64[np.ndarray, "J 4 4"]
    parent_turned: Float64[np.ndarray, "J 3 3"]
    betas: Float64[np.ndarray, " B"]
    expression: Float64[np.ndarray, " E"]
    pose_feature: Float64[np.ndarray, " P"]


@dataclass(frozen=True, eq=False)
class PointsMotion:
    """Points of one frame and their derivatives.

    Attributes:
        points: world, metres. pose: by turns of each joint in its parent's frame, radians.
        shape, expression: by a unit. The translation's derivative is the identity.
    """

    points: Float64[np.ndarray, "N 3"]
    pose: Float64[np.ndarray, "N 3 J 3"]
    shape: Float64[np.ndarray, "N 3 B"]
    expression: Float64[np.ndarray, "N 3 E"]


class Kinematics:
    """The skeleton of a body with what its derivatives need.

    Args:
        body: any of the SMPL family.
    """

    def __init__(self, body: BodyModel) -> None:
        self.body, self.parents = body, body.parents
        self.rest_joints = body.joint_regressor @ body.v_template
        self.joint_dirs = np.einsum("jv,vxb->jxb", body.joint_regressor, body.shapedirs)
        count = body.joint_count
        hangs_on = np.eye(count, dtype=bool)
        for joint in range(count):  # whether a joint hangs on another
            above = joint
            while self.parents[above] >= 0:
                above = int(self.parents[above])
                hangs_on[joint, above] = True
        self.hangs_on: Bool[np.ndarray, "J J"] = hangs_on

    def posture(self, state: BodyState, row: int) -> Posture:
        """Pose the skeleton of one frame."""
        rest = self.rest_joints + self.joint_dirs @ state.betas
        transforms, joints = forward_kinematics(rest, self.parents, state.rotations[row], transl=state.transl[row])
        turned = transforms[:, :3, :3]
        parent = np.where((self.parents < 0)[:, None, None], np.eye(3), turned[np.maximum(self.parents, 0)])
        feature = (state.rotations[row, 1:] - np.eye(3)).ravel()
        return Posture(turned, joints, transforms, parent, state.betas, state.expression[row], feature)

    def points(self, points: BodyPoints, posture: Posture) -> Float64[np.ndarray, "N 3"]:
        """Pose points."""
        rest = self._rest(points, posture)
        flat = points.weights @ posture.transforms[:, :3].reshape(-1, 12)
        blended = flat.reshape(-1, 3, 4)
        return np.einsum("nxy,ny->nx", blended[..., :3], rest) + blended[..., 3]

    def motion(self, points: BodyPoints, posture: Posture) -> PointsMotion:
        """Pose points, with derivatives."""
        count = len(self.parents)
        rest = self._rest(points, posture)
        # Where each joint alone would take each point, weighted; then summed over all that hangs on a joint.
        moved = rest @ posture.turned.transpose(0, 2, 1).transpose(1, 0, 2).reshape(3, -1)
        moved = (moved.reshape(-1, count, 3) + posture.transforms[:, :3, 3]) * points.weights[..., None]
        hanging = self.hangs_on.astype(np.float64)
        arm = np.einsum("nkx,kj->njx", moved, hanging, optimize=True)
        arm -= (points.weights @ hanging)[..., None] * posture.joints
        # -[a]_x P, column by column: P_c x a.
        px, py, pz = posture.parent_turned.transpose(1, 0, 2)[:, None]  # each (1, J, axis)
        ax, ay, az = (arm[..., k, None] for k in range(3))
        pose = np.empty((len(arm), 3, count, 3))
        np.subtract(py * az, pz * ay, out=pose[:, 0])
        np.subtract(pz * ax, px * az, out=pose[:, 1])
        np.subtract(px * ay, py * ax, out=pose[:, 2])
        blended = (points.weights @ posture.turned.reshape(count, 9)).reshape(-1, 3, 3)
        shape = blended @ points.shape_dirs
        shape += np.einsum("nk,kxb->nxb", points.weights, self._joint_shape(posture), optimize=True)
        return PointsMotion(
            points=moved.sum(axis=1),
            pose=pose,
            shape=shape,
            expression=blended @ points.expression_dirs,
        )

    def updated(
        self,
        state: BodyState,
        turns: Float64[np.ndarray, "T J 3"],
        transl: Float64[np.ndarray, "T 3"],
        betas: Float64[np.ndarray, " B"],
        expression: Float64[np.ndarray, "T E"],
    ) -> BodyState:
        """The state after small steps, `R_j <- exp(d_j) R_j`."""
        return BodyState(
            matrix_from_rotvec(turns) @ state.rotations,
            state.transl + transl,
            state.betas + betas,
            state.expression + expression,
        )

    def _rest(self, points: BodyPoints, posture: Posture) -> Float64[np.ndarray, "N 3"]:
        rest = points.rest + points.shape_dirs @ posture.betas + points.expression_dirs @ posture.expression
        return rest if points.pose_dirs is None else rest + points.pose_dirs @ posture.pose_feature

    def _joint_shape(self, posture: Posture) -> Float64[np.ndarray, "J 3 B"]:
        """How a joint's transform moves with the shape, `dp_j - R_j dJ_j`."""
        moved = np.zeros_like(self.joint_dirs)
        for level in _order(self.parents):
            parent = self.parents[level]
            if parent < 0:
                moved[level] = self.joint_dirs[level]
            else:
                offset = self.joint_dirs[level] - self.joint_dirs[parent]
                moved[level] = moved[parent] + posture.turned[parent] @ offset
        return moved - posture.turned @ self.joint_dirs


def _order(parents: np.ndarray) -> list[int]:
    """Joints, parents before children."""
    depth = np.zeros(len(parents), dtype=int)
    for joint in range(len(parents)):
        above = joint
        while parents[above] >= 0:
            above, depth[joint] = int(parents[above]), depth[joint] + 1
    return [int(j) for j in np.argsort(depth, kind="stable")]


def _resized(values: np.ndarray, size: int) -> np.ndarray:
    out = np.zeros(size)
    count = min(size, len(values))
    out[:count] = values[:count]
    return out
