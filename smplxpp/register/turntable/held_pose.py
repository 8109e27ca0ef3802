"""The unknowns that all frames of a turn share, and the prior that the body's pose changes little while it turns.

Shared are the shape, the mean rotation M_j of every free joint, the vertical u, the height h of the pelvis along it,
and the logarithm of the focal length f. With R_tj the rotation of joint j in frame t, relative to its parent,

    held limbs      Cauchy(|log(R_tj M_j^T)|; 3 s_j) / s_j^2             s_j of `HELD_DEGREES`
    upright trunk   |R_t M^T y - u|^2 / s^2                              R_t, M of the root, y = (0, 1, 0)
    pelvis          (u . p_t - h)^2 / (15 mm)^2, and its place on the floor within 30 cm of the mean
    vertical        |u - u_0|^2 / s_u^2
    mean pose       n (|log M_j|^2 / s^2 and joint limits)               as `priors.Anatomy` has them
    shape, focal    n |b|^2; (log f - log f_0)^2 / s_f^2; stature as it was told, n = max(1, frames / 8)

One view does not tell a step towards the camera from a bent knee. All views together do, because the same pose is seen
from all sides; so the mean pose takes what the frames agree on, and a frame departs from it by some degrees alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from smplxpp.body import BodyModel
from smplxpp.core import matrix_from_rotvec, rotvec_from_matrix
from smplxpp.register.kinematics import BodyState, Kinematics, PointsMotion
from smplxpp.register.normal_equations import Columns, NormalEquations
from smplxpp.register.priors import Anatomy, left_jacobian_inverse

# Standard deviation of a joint's rotation from frame to frame, degrees, by parts of joints' names; the first that fits.
# Arms float, the head looks around, and people step from foot to foot as they turn.
HELD_DEGREES = (
    ("pelvis", 3.0),
    ("spine", 2.0),
    ("neck", 4.0),
    ("head", 6.0),
    ("collar", 2.0),
    ("shoulder", 6.0),
    ("elbow", 6.0),
    ("wrist", 8.0),
    ("hip", 5.0),
    ("knee", 5.0),
    ("ankle", 5.0),
    ("foot", 3.0),
)
_PELVIS_HEIGHT_M, _PLACE_M = 0.015, 0.3


@dataclass(frozen=True, eq=False)
class SharedColumns(Columns):
    """Columns of a frame's unknowns, followed by those that frames share: betas, mean pose, vertical, height, focal.

    Attributes:
        shape: number of coefficients of the shape; `betas` counts all shared unknowns.
    """

    shape: int = 0

    @staticmethod
    def of(body: BodyModel, joints: np.ndarray) -> SharedColumns:
        """Return the columns for the joints that are free to rotate, without any expression."""
        shared = body.num_betas + 3 * len(joints) + 5
        return SharedColumns(joints, body.joint_count, 0, body.num_expressions, shared, body.num_betas)

    @property
    def mean_pose(self) -> slice:
        """Columns of the mean pose among the shared ones."""
        return slice(self.shape, self.betas - 5)

    @property
    def vertical(self) -> slice:
        """Columns of the rotation vector that moves the vertical, among the shared ones."""
        return slice(self.betas - 5, self.betas - 2)

    @property
    def height(self) -> int:
        """Column of the pelvis' height among the shared ones."""
        return self.betas - 2

    @property
    def focal(self) -> int:
        """Column of the logarithm of the focal length among the shared ones."""
        return self.betas - 1

    def jacobian(self, motion: PointsMotion) -> Float64[np.ndarray, "N 3 _"]:
        """Return the derivatives of points by a frame's unknowns and by the shared ones."""
        own = super().jacobian(motion)
        return np.concatenate([own, np.zeros((*own.shape[:2], self.betas - self.shape))], axis=2)


@dataclass(frozen=True, eq=False)
class Shared:
    """What all frames of a turn share, beside the shape.

    Attributes:
        mean: rotations of the joints; that of the root without any turn about the vertical.
        up: unit vector of the vertical, in world coordinates.
        height: of the pelvis along the vertical, metres.
        log_focal: logarithm of the focal length in pixels.
    """

    mean: Float64[np.ndarray, "J 3 3"]
    up: Float64[np.ndarray, " 3"]
    height: float
    log_focal: float

    def updated(self, columns: SharedColumns, step: Float64[np.ndarray, " S"]) -> Shared:
        """Return the shared unknowns after an update of the shared columns."""
        turn = np.zeros((len(self.mean), 3))
        turn[columns.joints] = step[columns.mean_pose].reshape(-1, 3)
        mean = matrix_from_rotvec(turn) @ self.mean
        up = matrix_from_rotvec(step[columns.vertical]) @ self.up
        return Shared(mean, up, self.height + step[columns.height], self.log_focal + step[columns.focal])


@dataclass(frozen=True)
class SharedPriors:
    """What is known of the shared unknowns before anything is seen.

    Attributes:
        focal: expected focal length, pixels.
        focal_spread: standard deviation of its logarithm; 0 to hold it.
        stature: height of the standing person in metres, as told; None where it is not known.
        up: expected vertical, a unit vector in world coordinates.
        up_spread: standard deviation of its direction, radians.
        held: factor on how much the pose may change from frame to frame.
    """

    focal: float
    focal_spread: float
    stature: float | None = None
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    up_spread: float = 0.25
    held: float = 1.0


class HeldPose:
    """The prior terms of a turn; see the module's docstring.

    Args:
        kinematics: of the body.
        columns: order of the unknowns.
        priors: of the shared unknowns.
        tells: whether a frame may change what all frames share; held-out frames may not.
    """

    def __init__(
        self, kinematics: Kinematics, columns: SharedColumns, priors: SharedPriors, tells: Bool[np.ndarray, " T"]
    ) -> None:
        self.kinematics, self.columns, self.priors, self.tells = kinematics, columns, priors, tells
        names = [kinematics.body.joint_names[j] for j in columns.joints]
        self.root = names.index("pelvis")
        self.spread = priors.held * np.radians([_held_degrees(name) for name in names])
        anatomy = Anatomy.of(kinematics.body.joint_count)
        self.anatomy = tuple(getattr(anatomy, name)[columns.joints] for name in ("spread", "lowest", "highest"))
        self.rest_height, self.height_dirs = stature_of(kinematics.body)
        # Observations grow with the frames, but a detector errs alike in all of them. Eight views of one pose are what
        # the priors of mean pose and shape were weighed against; more count as repetitions of these.
        self.repeats = max(1.0, float(tells.sum()) / 8.0)

    def add(self, equations: NormalEquations, state: BodyState, shared: Shared) -> None:
        """Add all terms to the normal equations."""
        pelvis = state.transl + self._root_joint(state)
        middle = pelvis[self.tells].mean(axis=0)
        for row in range(len(state)):
            self._add_limbs(equations, row, state, shared)
            self._add_place(equations, row, pelvis[row], middle, shared)
        self._add_mean(equations, shared)
        self._add_shared(equations, state, shared)

    def _add_limbs(self, equations: NormalEquations, row: int, state: BodyState, shared: Shared) -> None:
        """Add the departures of a frame's joints from the mean pose."""
        c, P = self.columns, self.columns.count
        rotations, mean = state.rotations[row, c.joints], shared.mean[c.joints]
        vectors = rotvec_from_matrix(rotations @ mean.transpose(0, 2, 1))
        by_frame = left_jacobian_inverse(vectors)
        by_mean = -by_frame.transpose(0, 2, 1)  # the inverse right Jacobian is the transposed left one
        # The root turns; what it holds is its own vertical: g = R M^T y against u.
        turned, y = rotations[self.root] @ mean[self.root].T, np.array([0.0, 1.0, 0.0])
        vectors[self.root] = turned @ y - shared.up
        by_frame[self.root] = -cross_matrix(turned @ y)
        by_mean[self.root] = turned @ cross_matrix(y)
        # Cauchy kernels of three standard deviations let one arm go; the trunk stays upright.
        far = (vectors**2).sum(axis=1) / (3 * self.spread) ** 2
        far[self.root] = 0.0
        weight = 1.0 / (self.spread * np.sqrt(1.0 + far))
        rows = np.zeros((len(vectors), 3, P + c.betas))
        for k in range(len(vectors)):
            rows[k, :, 3 * k : 3 * k + 3] = weight[k] * by_frame[k]
            first = P + c.mean_pose.start + 3 * k
            rows[k, :, first : first + 3] = weight[k] * by_mean[k]
        rows[self.root, :, P + c.vertical.start : P + c.vertical.stop] = weight[self.root] * cross_matrix(shared.up)
        equations.add(
            row, rows.reshape(-1, rows.shape[2]), (weight[:, None] * vectors).reshape(-1), shape=bool(self.tells[row])
        )

    def _add_place(
        self, equations: NormalEquations, row: int, pelvis: np.ndarray, middle: np.ndarray, shared: Shared
    ) -> None:
        """Add the height of the pelvis, and its place on the floor."""
        c, P = self.columns, self.columns.count
        rows = np.zeros((4, P + c.betas))
        rows[0, c.transl] = shared.up / _PELVIS_HEIGHT_M
        rows[0, P + c.height] = -1.0 / _PELVIS_HEIGHT_M
        rows[0, P + c.vertical.start : P + c.vertical.stop] = np.cross(shared.up, pelvis) / _PELVIS_HEIGHT_M
        across = (np.eye(3) - np.outer(shared.up, shared.up)) / _PLACE_M
        rows[1:, c.transl] = across
        residual = np.array([(shared.up @ pelvis - shared.height) / _PELVIS_HEIGHT_M, *(across @ (pelvis - middle))])
        equations.add(row, rows, residual, shape=bool(self.tells[row]))

    def _add_mean(self, equations: NormalEquations, shared: Shared) -> None:
        """Add the pose prior and the joint limits of the mean pose."""
        c, soft = self.columns, np.radians(3.0)
        spread, lowest, highest = self.anatomy
        vectors = rotvec_from_matrix(shared.mean[c.joints])
        inverse = left_jacobian_inverse(vectors)
        prior = self.repeats
        over = np.maximum(vectors - highest, 0.0) + np.minimum(vectors - lowest, 0.0)
        weight = prior / spread**2 + prior * (over != 0) / soft**2
        gradient = prior * vectors / spread**2 + prior * over / soft**2
        for k in range(len(c.joints)):
            if k == self.root:
                continue
            part = slice(c.mean_pose.start + 3 * k, c.mean_pose.start + 3 * k + 3)
            equations.shape[part, part] += inverse[k].T @ (weight[k][:, None] * inverse[k])
            equations.shape_gradient[part] += inverse[k].T @ gradient[k]
        # A person who stands leans by some degrees; the turn of the mean is not an unknown.
        root = vectors[self.root]
        part = slice(c.mean_pose.start + 3 * self.root, c.mean_pose.start + 3 * self.root + 3)
        lean = 1.0 / np.radians([5.0, 0.1, 5.0]) ** 2
        equations.shape[part, part] += np.diag(lean)
        equations.shape_gradient[part] += lean * root

    def _add_shared(self, equations: NormalEquations, state: BodyState, shared: Shared) -> None:
        """Add the priors of shape, stature, vertical and focal length."""
        c = self.columns
        turned = -cross_matrix(shared.up) / self.priors.up_spread
        off = (shared.up - np.asarray(self.priors.up)) / self.priors.up_spread
        equations.shape[c.vertical, c.vertical] += turned.T @ turned
        equations.shape_gradient[c.vertical] += turned.T @ off
        index = np.arange(c.shape)
        equations.shape[index, index] += self.repeats
        equations.shape_gradient[index] += self.repeats * state.betas
        if self.priors.stature is not None:
            deviation = 0.01  # metres: shoes and posture
            off = self.rest_height + self.height_dirs @ state.betas - self.priors.stature
            equations.shape[np.ix_(index, index)] += np.outer(self.height_dirs, self.height_dirs) / deviation**2
            equations.shape_gradient[index] += self.height_dirs * off / deviation**2
        spread = max(self.priors.focal_spread, 1e-6)
        equations.shape[c.focal, c.focal] += 1.0 / spread**2
        equations.shape_gradient[c.focal] += (shared.log_focal - np.log(self.priors.focal)) / spread**2

    def _root_joint(self, state: BodyState) -> Float64[np.ndarray, " 3"]:
        root = int(np.flatnonzero(self.kinematics.parents < 0)[0])
        return self.kinematics.rest_joints[root] + self.kinematics.joint_dirs[root] @ state.betas


def cross_matrix(vector: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "3 3"]:
    """Return the matrix [v]_x with `[v]_x w = v x w`."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _held_degrees(name: str) -> float:
    finger_degrees = 5.0
    return next((degrees for part, degrees in HELD_DEGREES if part in name), finger_degrees)


def stature_of(body: BodyModel) -> tuple[float, Float64[np.ndarray, " B"]]:
    """Return the height of the mean shape in the T-pose, lowest to highest vertex, and its derivative by betas."""
    low, high = int(body.v_template[:, 1].argmin()), int(body.v_template[:, 1].argmax())
    height = float(body.v_template[high, 1] - body.v_template[low, 1])
    return height, body.shapedirs[high, 1] - body.shapedirs[low, 1]
