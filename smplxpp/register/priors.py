"""Add the prior terms of a registration: joint limits, pose, shape, expression, an initial fit, and smoothness.

With v_j the axis-angle vector of joint j, b the betas, e the expression, and s the standard deviations named below, the
terms of a frame are

    pose prior        pose_prior |v_j / s_j|^2                       `Anatomy`; dropped where the initial fit is good
    joint limits      |excess over the bounds|^2 / (3 degrees)^2     one-sided, each component
    expression        |e|^2 / 0.35^2
    initial fit       Cauchy(|log(R_j R0_j^T)|; pose) + |t - t0|^2 / transl^2
    shape             |b|^2, or |b - b0|^2 / shape^2 around the initial fit
    smoothness        Cauchy(angular acceleration of j) + Cauchy(acceleration of t) + |second difference of e|^2

The Cauchy kernel weighs a residual r of scale c by `1 / (1 + (r / c)^2)`, so that a joint that the initial fit has
wrong, or a motion that really is fast, pays little. Rotations are differentiated through the left Jacobian of SO(3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.body.layout import JOINT_NAMES
from smplxpp.core import DEFAULT_FPS, rotvec_from_matrix
from smplxpp.register.kinematics import BodyState
from smplxpp.register.normal_equations import Columns, NormalEquations
from smplxpp.register.observations import RegisterConfig
from smplxpp.register.start import Start

# Of each joint of the left side, degrees: standard deviation, lowest and highest angle of each component. The right
# side is mirrored (x stays, y and z change their sign); joints that are not listed are fingers. The pelvis is free,
# which 400 degrees express.
_JOINTS: dict[str, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    "pelvis": ((400,) * 3, (-400,) * 3, (400,) * 3),
    "spine1": ((12, 8, 8), (-25, -20, -20), (40, 20, 20)),
    "spine2": ((10, 8, 8), (-20, -20, -20), (35, 20, 20)),
    "spine3": ((10, 8, 8), (-20, -20, -20), (35, 20, 20)),
    "neck": ((15, 15, 12), (-45, -50, -35), (45, 50, 35)),
    "head": ((15, 20, 12), (-45, -60, -35), (45, 60, 35)),
    "left_collar": ((8, 12, 12), (-25, -30, -25), (25, 30, 45)),
    "left_shoulder": ((40, 45, 55), (-110, -140, -110), (110, 60, 110)),
    "left_elbow": ((35, 55, 12), (-95, -155, -45), (95, 10, 45)),
    "left_wrist": ((30, 20, 25), (-80, -45, -85), (80, 45, 85)),
    "left_hip": ((35, 20, 20), (-130, -60, -40), (40, 60, 65)),
    "left_knee": ((50, 10, 6), (-8, -35, -20), (155, 35, 20)),
    "left_ankle": ((18, 12, 12), (-35, -35, -35), (60, 35, 35)),
    "left_foot": ((10, 4, 4), (-60, -10, -10), (40, 10, 10)),
    "jaw": ((10, 3, 3), (-3, -12, -10), (35, 12, 10)),
    "left_eye_smplhf": ((12, 12, 2), (-35, -40, -5), (35, 40, 5)),
    # Fingers of the left hand point along +x in the T-pose and bend downwards, about -z.
    "finger": ((6.0, 8.0, 28.0), (-20.0, -30.0, -115.0), (20.0, 30.0, 30.0)),
    "thumb": ((18.0, 20.0, 20.0), (-60.0, -70.0, -70.0), (60.0, 70.0, 70.0)),
}


@dataclass(frozen=True, eq=False)
class Anatomy:
    """Prior of every joint's axis-angle vector, radians: a zero-mean Gaussian and bounds of each component.

    Ranges follow the clinical tables of joint motion (American Academy of Orthopaedic Surgeons, "Joint Motion: Method
    of Measuring and Recording", 1965), widened where a joint of the model stands for several real ones. Axes are those
    of the T-pose (x to the person's left, y up, z to the front). The deviations are chosen, not learned from a data
    set: the T-pose is their mean, and hanging arms lie well inside them.

    Attributes:
        spread: standard deviations.
        lowest: lower bounds.
        highest: upper bounds.
    """

    spread: Float64[np.ndarray, "J 3"]
    lowest: Float64[np.ndarray, "J 3"]
    highest: Float64[np.ndarray, "J 3"]

    @staticmethod
    def of(joint_count: int) -> Anatomy:
        """Return the prior for a body of the SMPL family with this number of joints."""
        rows = [_of_joint(name) for name in JOINT_NAMES[joint_count]]
        return Anatomy(*(np.radians(np.array([row[k] for row in rows])) for k in range(3)))


def _of_joint(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    side, _, rest = name.partition("_")
    left = f"left_{rest}" if side == "right" else name
    finger = _JOINTS["thumb" if "thumb" in name else "finger"]
    spread, lowest, highest = (np.asarray(v, dtype=np.float64) for v in _JOINTS.get(left, finger))
    if side == "right":
        # Reflection at the sagittal plane (x -> -x) negates the y and z components of a rotation vector. Negated bounds
        # change places, hence minimum and maximum.
        mirror = np.array([1.0, -1.0, -1.0])
        ends = np.stack([lowest * mirror, highest * mirror])
        lowest, highest = ends.min(axis=0), ends.max(axis=0)
    return spread, lowest, highest


class Priors:
    """The prior terms of one window of frames.

    Args:
        columns: order of the unknowns.
        frames: numbers of the frames of the window.
        anatomy: prior of the joints.
        config: weights.
        start: an initial fit of the same frames that counts as a measurement; None if there is none.
        fps: frames a second; None for `DEFAULT_FPS`.
    """

    def __init__(
        self,
        columns: Columns,
        frames: Int64[np.ndarray, " T"],
        anatomy: Anatomy,
        config: RegisterConfig,
        *,
        start: Start | None = None,
        fps: float | None = None,
    ) -> None:
        self.columns, self.frames, self.config, self.start = columns, np.asarray(frames), config, start
        joints = columns.joints
        self.spread, self.lowest, self.highest = (
            getattr(anatomy, name)[joints].reshape(-1) for name in ("spread", "lowest", "highest")
        )
        self.seconds = 1.0 / (fps or DEFAULT_FPS)

    def add(self, equations: NormalEquations, state: BodyState, *, shape: bool) -> None:
        """Add all terms to the normal equations at a state.

        Args:
            shape: whether the shape is solved for.
        """
        # An update d acts as `exp(d) R`; the inverse left Jacobian gives the change of the axis-angle vector by d.
        vectors = rotvec_from_matrix(state.rotations[:, self.columns.joints])
        inverse = left_jacobian_inverse(vectors)
        for row in range(len(state)):
            self._add_pose(equations, row, vectors[row].reshape(-1), inverse[row])
            self._add_expression(equations, row, state.expression[row])
            if self.start is not None:
                self._add_start(equations, row, state)
        if shape:
            self._add_shape(equations, state.betas)
        self._add_smoothness(equations, state)

    def _add_pose(
        self, equations: NormalEquations, row: int, vector: Float64[np.ndarray, " n"], inverse: np.ndarray
    ) -> None:
        """Add the Gaussian pose prior and the soft joint limits of a frame."""
        soft = np.radians(3.0)  # standard deviation by which an angle may exceed its bound
        over = np.maximum(vector - self.highest, 0.0) + np.minimum(vector - self.lowest, 0.0)
        # An initial fit better than 5 degrees says more about the pose than the prior does, and replaces it.
        believed = self.start is not None and self.start.pose < np.radians(5.0)
        prior = 0.0 if believed else self.config.pose_prior
        weight = prior / self.spread**2 + (over != 0) / soft**2
        gradient = prior * vector / self.spread**2 + over / soft**2
        # Chain rule: an update d changes the axis-angle vector by J_l^-1 d, so that each joint gets a 3 x 3 block J^T W
        # J.
        for k, jacobian in enumerate(inverse):
            part = slice(3 * k, 3 * k + 3)
            equations.blocks[row, part, part] += jacobian.T @ (weight[part, None] * jacobian)
            equations.gradient[row, part] += jacobian.T @ gradient[part]

    def _add_expression(self, equations: NormalEquations, row: int, expression: Float64[np.ndarray, " E"]) -> None:
        """Add the Gaussian prior of a frame's expression."""
        spread = 0.35  # standard deviation of a coefficient; faces are near neutral most of the time
        part = self.columns.expression
        index = np.arange(part.start, part.stop)
        if len(index):
            equations.blocks[row, index, index] += 1.0 / spread**2
            equations.gradient[row, part] += expression / spread**2

    def _add_start(self, equations: NormalEquations, row: int, state: BodyState) -> None:
        """Add a frame of the initial fit as a measurement of rotations and translation."""
        start = self.start
        assert start is not None
        joints, transl, P = self.columns.joints, self.columns.transl, equations.columns.count
        if np.isfinite(start.pose):
            off = rotvec_from_matrix(
                state.rotations[row, joints] @ start.state.rotations[row, joints].transpose(0, 2, 1)
            )
            jacobian = left_jacobian_inverse(off)
            # Cauchy kernel of three standard deviations, so that a joint that the fit has wrong can leave it.
            weight = 1.0 / (start.pose**2 * (1.0 + (off**2).sum(axis=1) / (3 * start.pose) ** 2))
            for k, (each, vector) in enumerate(zip(jacobian, off, strict=True)):
                part = slice(3 * k, 3 * k + 3)
                equations.blocks[row, part, part] += weight[k] * each.T @ each
                equations.gradient[row, part] += weight[k] * each.T @ vector
        if np.isfinite(start.transl):
            # The translation has no robust kernel; its residual is linear in the unknowns.
            rows = np.zeros((3, P + self.columns.betas))
            rows[:, transl] = np.eye(3) / start.transl
            difference = (state.transl[row] - start.state.transl[row]) / start.transl
            equations.add(row, rows, difference, shape=False)

    def _add_shape(self, equations: NormalEquations, betas: Float64[np.ndarray, " B"]) -> None:
        """Add the prior of the shape: standard normal, or around the initial fit."""
        mean, spread = np.zeros_like(betas), 1.0
        if self.start is not None and np.isfinite(self.start.shape):
            mean, spread = self.start.state.betas, self.start.shape
        index, weight = np.arange(len(betas)), self.config.shape_prior / spread**2
        equations.shape[index, index] += weight
        equations.shape_gradient += weight * (betas - mean)

    def _add_smoothness(self, equations: NormalEquations, state: BodyState) -> None:
        """Add the accelerations of rotations, translation and expression, over triples of equidistant frames."""
        joints, P = self.columns.joints, self.columns.count
        for first in range(len(state) - 2):
            gaps = np.diff(self.frames[first : first + 3])
            # Frames more than five numbers apart are taken for unrelated.
            if gaps[0] != gaps[1] or gaps[0] > 5:
                continue
            # Second differences: of angular velocities log(R_t+1 R_t^T), of positions, of expression coefficients.
            seconds = self.seconds * gaps[0]
            turned = state.rotations[first : first + 3, joints]
            speed = rotvec_from_matrix(turned[1:] @ turned[:-1].transpose(0, 1, 3, 2))
            turn, moved = speed[1] - speed[0], np.diff(state.transl[first : first + 3], n=2, axis=0)[0]
            face = np.diff(state.expression[first : first + 3, : self.columns.expressions], n=2, axis=0)[0]
            # Standard deviations of a second difference; the Cauchy kernel has twice their scale.
            scale = self.config.acceleration * seconds**2
            length = self.config.transl_acceleration * seconds**2
            weight, difference = np.zeros(P), np.zeros(P)
            of_joint = 1.0 / (scale**2 * (1.0 + (turn**2).sum(axis=1) / (2 * scale) ** 2))
            weight[: 3 * len(joints)] = np.repeat(of_joint, 3)
            difference[: 3 * len(joints)] = turn.reshape(-1)
            weight[self.columns.transl] = 1.0 / (length**2 * (1.0 + (moved**2).sum() / (2 * length) ** 2))
            difference[self.columns.transl] = moved
            # A loose scale of 100 coefficients a second squared, because faces move fast; no robust kernel.
            weight[self.columns.expression] = 1.0 / (100.0 * seconds**2) ** 2
            difference[self.columns.expression] = face
            equations.add_smoothness(first, weight, difference)


def left_jacobian_inverse(vectors: Float64[np.ndarray, "*N 3"]) -> Float64[np.ndarray, "*N 3 3"]:
    """Return the derivative of `log(exp(d) exp(v))` by d at 0 (Sola et al. 2018, "A micro Lie theory", eq. 146)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    cross = np.zeros((*vectors.shape[:-1], 3, 3))
    x, y, z = np.moveaxis(vectors, -1, 0)
    cross[..., 0, 1], cross[..., 0, 2], cross[..., 1, 2] = -z, y, -x
    cross -= np.swapaxes(cross, -1, -2).copy()
    # J_l^-1 = I - [v]_x / 2 + (1 / a^2 - (1 + cos a) / (2 a sin a)) [v]_x^2 with the angle a; the factor tends to 1/12.
    small = angle < 1e-3
    safe = np.where(small, 1.0, angle)
    factor = np.where(small, 1.0 / 12.0, 1.0 / safe**2 - (1.0 + np.cos(safe)) / (2.0 * safe * np.sin(safe)))
    return np.eye(3) - 0.5 * cross + factor * (cross @ cross)
