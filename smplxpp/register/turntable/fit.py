"""Fit a person who turns before one camera: a pose a frame, and one shape, mean pose, vertical and focal length.

The minimised sum is that of `smplxpp.register` (keypoints, masks, joint limits, unit betas) with the terms of
`held_pose` in the place of smoothness: one camera sees no depth, and the pose that all frames share gives it.

1. Turns: candidates of each frame, best path (`start`).
2. Keypoints: kernels that narrow from 40 standard deviations to one, limbs held closely at first; the focal length is
   free in the second half, because a wrong pose explains itself by a wrong lens.
3. Masks: the silhouette as in any registration, with the focal length held.

One camera does not determine scale: a person twice as large and twice as far looks the same. It comes from the shape
prior, or from a stature that the user states.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64

from smplxpp.body import BodyModel
from smplxpp.core import Camera, InputError, Keypoints2D, ProgressCallback, ignore_progress
from smplxpp.core.errors import one_line, require_at_least, require_between, require_positive
from smplxpp.register.clothing import hand_vertices
from smplxpp.register.keypoint_term import KeypointTerm, prepare_keypoints, projected
from smplxpp.register.kinematics import BodyPoints, BodyState, Kinematics, Posture
from smplxpp.register.landmarks import is_finger, visible_vertices
from smplxpp.register.normal_equations import Equations, NormalEquations
from smplxpp.register.observations import BodyFit, Observations, RegisterConfig
from smplxpp.register.silhouette_term import Outline, SilhouetteTerm, Surface
from smplxpp.register.solver import joint_confidence
from smplxpp.register.turntable.held_pose import HeldPose, Shared, SharedColumns, SharedPriors, stature_of
from smplxpp.register.turntable.start import start_of_turn

# A wrong focal length and wrong distances explain keypoints almost equally well; damping as strong as elsewhere stops
# in that valley, near the focal length that was expected.
_LENS_DAMPING = 1e-5
# Standard deviations from the normal equations are too small by this factor, because the errors of keypoints are alike
# in all frames: a detector's, and the body's. Of 12 simulated turns (8 frames, keypoints off by 4 px in each frame and
# 10 mm in all, lens taken for e^N(0, 0.25) of the true one) 9 lie within the stated deviation and 11 within two.
_LENS_OVERCONFIDENCE = 2.75
LEAST_FRAMES = 4
"""Frames that a turn needs; fewer do not show a person from all sides."""


@dataclass(frozen=True)
class TurntableConfig:
    """Options of a registration of one camera.

    Attributes:
        stature: height of the person in metres, with shoes; None: found by the prior of the shape.
        focal_spread: standard deviation of the logarithm of the camera's focal length; 0: it is known.
        up_spread: standard deviation of the camera's vertical (+Y of the world), degrees.
        keypoint_steps: Gauss-Newton steps on keypoints.
        surface_steps: Gauss-Newton steps on keypoints and masks.
        solver: options of the terms that all registrations share.
    """

    stature: float | None = None
    focal_spread: float = 0.0
    up_spread: float = 15.0
    keypoint_steps: int = 30
    surface_steps: int = 10
    solver: RegisterConfig = field(default_factory=RegisterConfig)

    def __post_init__(self) -> None:
        if self.stature is not None:
            require_between("option height", self.stature, 0.5, 2.6)
        require_between("turntable: focal_spread", self.focal_spread, 0.0, 1.0)
        require_positive("turntable: up_spread", self.up_spread)
        require_at_least("turntable: keypoint_steps", self.keypoint_steps, 1)
        require_at_least("turntable: surface_steps", self.surface_steps, 0)


@dataclass(frozen=True, eq=False)
class TurntableFit:
    """The fit of a turning body, and the camera that saw it.

    Attributes:
        fit: poses and shape, with residuals in pixels.
        camera: with the focal length that was found, in the world of `fit`.
        up: vertical in that world, a unit vector.
        focal_spread: standard deviation of the logarithm of the focal length.
        stature: height of the body in the T-pose, metres.
        turned: total rotation of the body about the vertical, degrees, positive to its left.
        start_cost: mean truncated error of the starting poses, from 0 to about 1.
    """

    fit: BodyFit
    camera: Camera
    up: Float64[np.ndarray, " 3"]
    focal_spread: float
    stature: float
    turned: float
    start_cost: float

    __repr__ = one_line


def register_turntable(
    body: BodyModel,
    observed: Observations,
    config: TurntableConfig | None = None,
    *,
    progress: ProgressCallback = ignore_progress,
) -> TurntableFit:
    """Fit the poses of a person who turns before one camera, one shape, and what is not known of the camera.

    Args:
        body: the body model.
        observed: one camera, its keypoints and masks; an initial fit, where there is one, gives the starting poses.
        config: options.
        progress: called with the running step and its share done.

    Raises:
        InputError: not one camera with keypoints, fewer than four frames, or a person whom nothing shows.

    Example:
        >>> found = register_turntable(body, Observations(frames, {"cam": camera}, {"cam": keypoints}, mask))
        >>> found.fit.params.save("params.npz")  # doctest: +SKIP
    """
    check_turn(observed)
    run = _Turn(body, observed, config or TurntableConfig(), progress)
    return run.fit()


def check_turn(observed: Observations) -> None:
    """Refuse observations that no turn can be found in.

    Raises:
        InputError: see `register_turntable`.
    """
    if len(observed.cameras) != 1:
        raise InputError(
            "turn before a camera", expected="one camera", received=f"{len(observed.cameras)}", remedy="hold others out"
        )
    if len(observed.frames) < LEAST_FRAMES:
        raise InputError(
            "turn before a camera",
            expected=f"at least {LEAST_FRAMES} frames, better 8 and more, from all sides of the person",
            received=f"{len(observed.frames)}",
        )
    if not set(observed.cameras) & set(observed.keypoints):
        raise InputError(
            "turn before a camera",
            expected="keypoints of its camera",
            received="none",
            remedy="detect them (smplxpp keypoints detect), or name a folder with --keypoints",
        )


class FocalKeypoints(KeypointTerm):
    """Reprojection errors of one camera whose focal length is an unknown: `d pixel / d log f = pixel - centre`."""

    def with_focal(self, log_focal: float) -> None:
        """Set the focal length of the camera, in pixels along x; the ratio of the axes stays."""
        camera = self.cameras[0]
        K = camera.K.copy()
        K[:2, :2] *= np.exp(log_focal) / K[0, 0]
        self.cameras = [replace(camera, K=K)]

    def add(self, equations: Equations, row: int, kinematics: Kinematics, posture: Posture, *, shape: bool) -> None:
        """Add the keypoints of one frame, with the column of the focal length."""
        if not self.used(row):
            return
        columns, camera = equations.columns, self.cameras[0]
        assert isinstance(columns, SharedColumns)
        motion, points = self.landmarks.motion(kinematics, posture)
        pixels, jacobian, seen = projected(camera, points)
        residual = pixels - self.points[0, row]
        scale = self.noise[0] * self.scale
        squared = (residual**2).sum(axis=1) / (self.cutoff * scale) ** 2
        root = np.sqrt(seen * self.confidence[0, row]) / (scale * (1.0 + squared))
        rows = jacobian @ self.landmarks.combined(columns.jacobian(motion))
        rows[:, :, columns.count + columns.focal] = pixels - camera.K[:2, 2]
        rows *= root[:, None, None]
        equations.add(row, rows.reshape(-1, rows.shape[2]), (root[:, None] * residual).reshape(-1), shape=shape)


class _Turn:
    """The state of one registration of a turn."""

    def __init__(
        self, body: BodyModel, observed: Observations, config: TurntableConfig, progress: ProgressCallback
    ) -> None:
        self.body, self.observed, self.config, self.progress = body, observed, config, progress
        self.kinematics = Kinematics(body)
        (self.name, self.camera), *_ = observed.cameras.items()
        seen = prepare_keypoints(body, observed, config.solver)
        assert seen is not None  # `check_turn` has looked
        self.keypoints = _trusted(seen.keypoints[self.name])
        self.notes = list(seen.notes)
        given = {self.name: self.keypoints}
        self.term = FocalKeypoints(body, seen.landmarks, observed.cameras, given, seen.noise_px)
        self.landmarks = seen.landmarks
        self.columns = SharedColumns.of(body, self._free_joints())
        shape_frames = observed.shape_frames or observed.frames
        self.tells_shape = np.isin(observed.frames, shape_frames)
        self.points = BodyPoints.of_vertices(body, np.arange(body.vertex_count))
        self.root = int(np.flatnonzero(body.parents < 0)[0])

    def fit(self) -> TurntableFit:
        """Run the schedule and return the result."""
        state, shared, cost = self._start()
        focal = float(np.exp(shared.log_focal))
        priors = SharedPriors(
            focal,
            self.config.focal_spread,
            self.config.stature,
            up_spread=np.radians(self.config.up_spread),
        )
        # Keypoints alone: first with the lens held and limbs held closely, then with all unknowns.
        steps = self.config.keypoint_steps
        scales = np.concatenate([np.geomspace(40.0, 1.0, max(1, steps // 2)), np.ones(steps - steps // 2)])
        held = replace(priors, focal_spread=0.0, held=0.5)
        equations = NormalEquations(self.columns, len(state))
        for k, scale in enumerate(scales):
            self.term.scale = float(scale)
            known = held if k < steps // 2 else priors
            state, shared, equations = self._step(state, shared, known, None)
            self.progress("joints", (k + 1) / steps)
        focal_spread = self._spread_of_focal(equations)
        # Masks: with the lens as it was found.
        outlines = self._outlines()
        if outlines and self.config.surface_steps:
            found = replace(priors, focal=float(np.exp(shared.log_focal)), focal_spread=0.0)
            surface = self._surface_term(state, outlines)
            for k in range(self.config.surface_steps):
                state, shared, equations = self._step(state, shared, found, surface)
                surface.estimate_gaps()
                surface.reach = max(0.4, 1.0 - 0.15 * k) * surface.first_reach
                self.progress("surfaces", (k + 1) / self.config.surface_steps)
        return self._result(state, shared, equations, (focal_spread, cost))

    # -- preparation

    def _free_joints(self) -> np.ndarray:
        """Choose the joints that rotate: fingers where keypoints show them, neither jaw nor eyes."""
        names = np.array(self.body.joint_names)
        sees_fingers = any(is_finger(name) or name.endswith("_tip") for name in self.landmarks.names)
        free = np.array([sees_fingers or not is_finger(name) for name in names])
        free &= np.array(["eye" not in name and name != "jaw" for name in names])
        return np.flatnonzero(free)

    def _start(self) -> tuple[BodyState, Shared, float]:
        """Return the initial fit, or the standing body with the headings that fit the keypoints."""
        up = np.array([0.0, 1.0, 0.0])
        state, cost = start_of_turn(self.kinematics, self.camera, self.landmarks, self.keypoints, up)
        if self.observed.initial is not None:
            state = BodyState.of_params(self.body, self.observed.initial)
        if not self.term.confidence.any():
            raise InputError("keypoints", expected="a person in some frame", received="none that the body has")
        # The mean pose of the start: its joints are alike in all frames, the root is upright.
        mean = _mean_rotations(state.rotations)
        mean[self.root] = np.eye(3)
        pelvis = state.transl + self.kinematics.rest_joints[self.root]
        return state, Shared(mean, up, float((pelvis @ up).mean()), float(np.log(self.camera.K[0, 0]))), cost

    def _outlines(self) -> dict[tuple[str, int], Outline]:
        """Read the masks as signed distance fields, by camera and row, and note those that are missing."""
        out: dict[tuple[str, int], Outline] = {}
        missing: list[int] = []
        if self.observed.mask is None:
            return out
        for row, frame in enumerate(self.observed.frames):
            mask = self.observed.mask(self.name, frame)
            outline = None if mask is None else Outline.of(mask)
            if outline is None:
                missing.append(frame)
            else:
                out[self.name, row] = outline
        if missing and out:
            self.notes.append(
                f"no mask, or an empty one, in {len(missing)} of {len(self.observed.frames)} frames, "
                f"first in frame {missing[0]}"
            )
        return out

    def _surface_term(self, state: BodyState, outlines: dict[tuple[str, int], Outline]) -> SilhouetteTerm:
        """Return the term of the masks; a frame is one sighting of a place, so that few frames make few of them."""
        rng = np.random.default_rng(self.config.solver.seed)
        index = np.sort(rng.permutation(visible_vertices(self.body))[: self.config.solver.rim_samples])
        shaped = self.points.rest + self.points.shape_dirs @ state.betas
        surface = Surface(self.points, self.body.faces, self.body.mesh(shaped).vertex_normals)
        bare = hand_vertices(self.body) if self.observed.bare is None else self.observed.bare
        cameras = {self.name: self.term.cameras[0]}
        term = SilhouetteTerm(surface, index, bare, cameras, outlines, self.config.solver)
        term.least_sightings = int(np.clip(len(state) // 4, 2, 8))
        return term

    # -- solving

    def _step(
        self, state: BodyState, shared: Shared, priors: SharedPriors, surface: SilhouetteTerm | None
    ) -> tuple[BodyState, Shared, NormalEquations]:
        """Take one damped Gauss-Newton step in all unknowns."""
        self.term.with_focal(shared.log_focal)
        equations = NormalEquations(self.columns, len(state))
        for row in range(len(state)):
            posture = self.kinematics.posture(state, row)
            shape = bool(self.tells_shape[row])
            self.term.add(equations, row, self.kinematics, posture, shape=shape)
            if surface is not None:
                surface.add(equations, row, self.kinematics, posture, shape=shape)
        HeldPose(self.kinematics, self.columns, priors, self.tells_shape).add(equations, state, shared)
        damping = _LENS_DAMPING if priors.focal_spread > 0.0 else 1e-3
        step = equations.solve(damping=damping, solve_shape=True).limited(angle=0.35, length=0.25)
        c = self.columns
        state = self.kinematics.updated(state, step.rotvecs, step.transl, step.betas[: c.shape], step.expression)
        shared = shared.updated(c, step.betas)
        self.term.with_focal(shared.log_focal)
        return state, shared, equations

    def _spread_of_focal(self, equations: NormalEquations) -> float:
        """Return the standard deviation of log f, with all other unknowns eliminated (Schur complement).

        The share of it that keypoints tell is corrected by `_LENS_OVERCONFIDENCE`, that of the prior stands.
        """
        expected = self.config.focal_spread
        if not expected:
            return 0.0
        schur = equations.shape.copy()
        for row in range(equations.frames):
            coupling = equations.shape_blocks[row]
            schur -= coupling.T @ np.linalg.solve(equations.blocks[row] + 1e-6 * np.eye(len(coupling)), coupling)
        variance = np.linalg.pinv(schur + 1e-6 * np.eye(len(schur)))[self.columns.focal, self.columns.focal]
        told = max(0.0, 1.0 / max(variance, 1e-12) - expected**-2) / _LENS_OVERCONFIDENCE**2
        return float((told + expected**-2) ** -0.5)

    # -- results

    def _result(
        self, state: BodyState, shared: Shared, equations: NormalEquations, numbers: tuple[float, float]
    ) -> TurntableFit:
        """Collect poses, residuals, confidence and the camera."""
        rows = range(len(state))
        postures = [self.kinematics.posture(state, row) for row in rows]
        px = [self.term.residual_px(row, self.kinematics, postures[row]) for row in rows]
        residuals = {"keypoints_px": np.array(px)}
        outlines = self._outlines()
        if outlines:
            term = self._surface_term(state, outlines)
            contour = [term.residual_px(row, self.kinematics, postures[row]) for row in rows]
            residuals["silhouette_px"] = np.array(contour)
        confidence = joint_confidence(self.kinematics, state, equations, np.arange(len(state)))
        params = state.to_params(self.body, fps=self.observed.fps)
        fit = BodyFit(tuple(self.observed.frames), params, confidence, residuals, notes=tuple(self.notes))
        focal_spread, cost = numbers
        turned = degrees_turned(state.rotations[:, self.root], shared.up)
        height, by_betas = stature_of(self.body)
        stature = height + float(by_betas @ state.betas)
        return TurntableFit(fit, self.term.cameras[0], shared.up, focal_spread, stature, turned, cost)


def _trusted(keypoints: Keypoints2D) -> Keypoints2D:
    """Return keypoints without those of a confidence below 0.05: no second view shows that they are imagined."""
    confidence = np.where(keypoints.confidence < 0.05, 0.0, keypoints.confidence)
    return replace(keypoints, confidence=confidence)


def degrees_turned(roots: Float64[np.ndarray, "T 3 3"], up: Float64[np.ndarray, " 3"]) -> float:
    """Return the sum of the turns about the vertical from frame to frame, degrees; each is less than half a turn."""
    forward = roots[:, :, 2] - (roots[:, :, 2] @ up)[:, None] * up
    first, later = forward[:-1], forward[1:]
    sine, cosine = np.cross(first, later) @ up, (first * later).sum(axis=1)
    return float(np.degrees(np.arctan2(sine, cosine)).sum())


def _mean_rotations(rotations: Float64[np.ndarray, "T J 3 3"]) -> Float64[np.ndarray, "J 3 3"]:
    """Return the rotation nearest to the mean of the matrices of each joint."""
    u, _, vt = np.linalg.svd(rotations.mean(axis=0))
    sign = np.linalg.det(u @ vt)
    u[:, :, 2] *= sign[:, None]
    return u @ vt
