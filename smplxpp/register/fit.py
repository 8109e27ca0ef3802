"""Register a body to what was seen of a person, over all frames: `register`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from smplxpp.body import BodyModel
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.core.spread import spread
from smplxpp.register.anatomy import Anatomy
from smplxpp.register.bare import bare_vertices, hands_of
from smplxpp.register.body_fit import BodyFit
from smplxpp.register.config import RegisterConfig
from smplxpp.register.keypoint_term import KeypointTerm
from smplxpp.register.kinematics import BodyPoints, BodyState, Kinematics
from smplxpp.register.landmark_term import LandmarkTerm, PlacedLandmarks
from smplxpp.register.normal_equations import Columns, NormalEquations
from smplxpp.register.observations import Observations, check_observations
from smplxpp.register.outline import Outline
from smplxpp.register.priors import Priors, Start, white_noise
from smplxpp.register.scan_term import ScanTerm
from smplxpp.register.seen_keypoints import SeenKeypoints, see_keypoints
from smplxpp.register.silhouette_term import SilhouetteTerm, Surface
from smplxpp.register.solver import Terms, gauss_newton
from smplxpp.register.start import joined_points, state_from_points

# Deviations that a fit is believed to have where nothing tells them: radians, metres, betas.
_START_NOISE = (np.radians(2.0), 0.01, 0.3)
# A fit has slow errors too, which its noise does not show: beside keypoints it counts as so many times as noisy.
_BESIDE_KEYPOINTS = 2.0
_LEAST_NOISE = (np.radians(0.5), 0.003)
_OVERLAP = 10
# A joint whose place is known to this (metres) has confidence 1/2.
_HALF_KNOWN = 0.02
_FACE = "face_"


def register(
    body: BodyModel,
    observed: Observations,
    config: RegisterConfig | None = None,
    *,
    progress: ProgressCallback = ignore_progress,
) -> BodyFit:
    """Fit pose, shape and translation of a body to keypoints, landmarks, masks, label maps and scans in any mixture.

    Gauss-Newton on the sum of squares of: keypoints (robust, pixels), landmarks (robust, metres), masks
    (`SilhouetteTerm`), scans (`ScanTerm`), joint ranges, a zero-mean pose prior and unit betas (`Anatomy`; no data set
    was learned from), robust accelerations, and a given fit as far as its own noise says. Named points alone come
    first. One shape for all frames, told by `observed.shape_frames`. Clothes never pull the body onto themselves: they
    keep a gap that is learned (`Gaps`).

    Args:
        observed: cameras and everything seen through them; held-out cameras are not in it.
        progress: called with the work under way and its share done.

    Raises:
        InputError: nothing to register to, or nothing to start from.

    Example:
        >>> fit = register(load_body(), Observations(frames, cameras, keypoints=keypoints, mask=capture.mask, fps=20))
        >>> fit.params.save("params.npz")
    """
    config = config or RegisterConfig()
    check_observations(body, observed)
    run = _Registration(body, observed, config, progress)
    return run.fit()


@dataclass(frozen=True, eq=False)
class _Window:
    """Frames that are solved together: rows of the whole. `kept`: those whose answer counts."""

    rows: np.ndarray
    kept: Bool[np.ndarray, " T"]


class _Registration:
    """One registration under way."""

    def __init__(
        self, body: BodyModel, observed: Observations, config: RegisterConfig, progress: ProgressCallback
    ) -> None:
        self.body, self.observed, self.config, self.progress = body, observed, config, progress
        self.kinematics, self.frames = Kinematics(body), np.array(observed.frames)
        self.points = BodyPoints.of_vertices(body, np.arange(body.vertex_count))
        self.seen: SeenKeypoints | None = see_keypoints(body, observed, config)
        self.placed = PlacedLandmarks.of(body, observed.landmarks, observed.frames)
        self.problems = [words for one in (self.seen, self.placed) if one is not None for words in one.problems]
        shape_frames = observed.shape_frames or observed.frames
        self.tells_shape = np.isin(self.frames, shape_frames)
        self.outlines = self._outlines()
        self.columns = self._columns()
        self.bare = np.zeros(body.vertex_count, dtype=bool)

    def fit(self) -> BodyFit:
        state = self._start()
        before = state
        whole = len(self.frames) <= self.config.window
        if whole:
            state, equations = self._solve(
                state, _Window(np.arange(len(self.frames)), np.ones(len(self.frames), dtype=bool)), True
            )
            confidence = self._confidence(state, equations, np.arange(len(self.frames)))
        else:
            state = self._solve_shape(state)
            state, confidence = self._solve_windows(state)
        residuals = self._measure(state)
        self.problems += self._far_landmarks(state)
        start = self._measure(before) if self.observed.initial is not None else {}
        params = state.to_params(self.body, fps=self.observed.fps)
        return BodyFit(tuple(self.observed.frames), params, confidence, residuals, start, tuple(self.problems))

    # -- what is there

    def _columns(self) -> Columns:
        names = np.array(self.body.joint_names)
        landmarks = {name for one in (self.seen, self.placed) if one is not None for name in one.landmarks.names}
        fingers = np.array([not _is_finger(name) for name in names])
        sees_fingers = any(_is_finger(name) or name.endswith("_tip") for name in landmarks)
        face = any(name.startswith(_FACE) for name in landmarks)
        # A given fit is kept slow and believed where nothing else is seen.
        given = self.observed.initial is not None
        turns = np.full(len(names), True)
        turns[~fingers] = sees_fingers or given
        turns[["eye" in name for name in names]] = False
        turns[names == "jaw"] = face or given
        E = self.body.num_expressions
        return Columns(np.flatnonzero(turns), len(names), E if face else 0, E, self.body.num_betas)

    def _outlines(self) -> dict[tuple[str, int], Outline]:
        read = self.observed.mask
        out: dict[tuple[str, int], Outline] = {}
        if read is None:
            return out
        missing: dict[str, list[int]] = {}
        for row, frame in enumerate(self.frames.tolist()):
            for name in self.observed.cameras:
                mask = read(name, frame)
                outline = None if mask is None else Outline.of(mask)
                if outline is not None:
                    out[name, row] = outline
                else:
                    missing.setdefault(name, []).append(frame)
            self.progress("masks", (row + 1) / len(self.frames))
        for name, frames in missing.items():
            if len(frames) < len(self.frames) or out:
                self.problems.append(
                    f"camera {name}: no mask, or an empty one, in {len(frames)} of {len(self.frames)} frames, "
                    f"first in frame {frames[0]}; they are left out"
                )
        return out

    def _start(self) -> BodyState:
        if self.observed.initial is not None:
            return BodyState.of_params(self.body, self.observed.initial)
        tables = [(one.landmarks.names, one.points) for one in (self.seen, self.placed) if one is not None]
        state = state_from_points(self.kinematics, *joined_points(self.body, tables)) if tables else None
        if state is None and self.seen is None:
            raise InputError(
                "landmarks",
                expected="three points of the trunk (hips, shoulders, pelvis, neck), or four that lie on no line",
                received=", ".join(tables[0][0]) if tables else "none of these frames that the body has",
                remedy="place more of them in `smplxpp label RUN`, or give a fit to start from",
            )
        if state is None:
            raise InputError(
                "keypoints",
                expected="three points of the trunk in two views of some frame",
                received="none that the views agree on",
                remedy="check the calibration with `smplxpp capture check`, or give a fit to start from",
            )
        return state

    # -- solving

    def _solve_shape(self, state: BodyState) -> BodyState:
        """The shape, and poses, of frames spread over those that may tell it."""
        rows = np.array(spread(np.flatnonzero(self.tells_shape).tolist(), self.config.shape_frames))
        solved, _ = self._solve(state.select(rows), _Window(rows, np.ones(len(rows), dtype=bool)), True)
        return replace(state, betas=solved.betas)

    def _solve_windows(self, state: BodyState) -> tuple[BodyState, Float64[np.ndarray, "T J"]]:
        """Poses of all frames, window after window, of the solved shape."""
        count, length = len(self.frames), self.config.window
        rotations, transl, expression = state.rotations.copy(), state.transl.copy(), state.expression.copy()
        confidence = np.zeros((count, self.body.joint_count))
        for first in range(0, count, length):
            inner = np.arange(first, min(first + length, count))
            rows = np.arange(max(0, first - _OVERLAP), min(count, first + length + _OVERLAP))
            window = _Window(rows, np.isin(rows, inner))
            solved, equations = self._solve(state.select(rows), window, False)
            rotations[inner] = solved.rotations[window.kept]
            transl[inner] = solved.transl[window.kept]
            expression[inner] = solved.expression[window.kept]
            confidence[inner] = self._confidence(solved, equations, np.flatnonzero(window.kept))
        return BodyState(rotations, transl, state.betas, expression), confidence

    def _solve(self, state: BodyState, window: _Window, solve_shape: bool) -> tuple[BodyState, NormalEquations]:
        config, rows = self.config, window.rows
        terms = self._terms(state, rows)
        equations = NormalEquations(self.columns, len(state))
        if terms.points():
            scales = np.geomspace(40.0, 1.0, max(1, 2 * config.joint_steps // 3))
            scales = np.concatenate([scales, np.ones(config.joint_steps - len(scales))])
            state, equations = self._step("joints", state, terms, config.joint_steps, solve_shape, scales)
        bare = bare_vertices(self.kinematics, state, self.observed, self.frames[rows].tolist(), self.points)
        if bare is not None:
            self.bare = bare
        elif not self.bare.any():
            self.bare = hands_of(self.body) if self.observed.bare is None else self.observed.bare
        terms = replace(terms, silhouettes=self._silhouettes(state, rows), scans=self._scans(rows))
        if terms.surfaces():
            state, equations = self._step("surfaces", state, terms, config.surface_steps, solve_shape, None)
        elif not terms.points():
            state, equations = self._step("priors", state, terms, config.surface_steps, solve_shape, None)
        return state, equations

    def _step(
        self,
        what: str,
        state: BodyState,
        terms: Terms,
        steps: int,
        solve_shape: bool,
        scales: Float64[np.ndarray, " n"] | None,
    ) -> tuple[BodyState, NormalEquations]:
        def done(k: int) -> None:
            self.progress(what, (k + 1) / steps)
            for term in terms.surfaces():
                # What is far is believed at first; a contour of something else less and less.
                term.reach = max(0.4, 1.0 - 0.15 * k) * term.first_reach

        return gauss_newton(
            self.kinematics,
            self.columns,
            state,
            terms,
            steps=steps,
            solve_shape=solve_shape,
            point_scales=scales,
            step_done=done,
        )

    def _terms(self, state: BodyState, rows: np.ndarray) -> Terms:
        frames, anatomy = self.frames[rows], Anatomy.of(self.body.joint_count)
        start = None
        if self.observed.initial is not None:
            given = BodyState.of_params(self.body, self.observed.initial)
            start = self._believed(given, rows)
        priors = Priors(self.columns, frames, anatomy, self.config, start=start, fps=self.observed.fps)
        keypoints = None
        if self.seen is not None:
            chosen = {name: k.select(k.names, frames.tolist()) for name, k in self.seen.keypoints.items()}
            keypoints = KeypointTerm(self.body, self.seen.landmarks, self.observed.cameras, chosen, self.seen.noise_px)
        return Terms(priors, self.tells_shape[rows], keypoints, self._landmark_term(rows))

    def _landmark_term(self, rows: np.ndarray) -> LandmarkTerm | None:
        return (
            None if self.placed is None else LandmarkTerm(self.body, self.placed.of_rows(rows), self.config.landmark_m)
        )

    def _believed(self, given: BodyState, rows: np.ndarray) -> Start | None:
        """A given fit as a measurement: as good as it is smooth; beside keypoints what these do not tell, as twists."""
        stated = self.observed.initial_noise
        if stated is not None:
            return Start(given.select(rows), stated.pose, stated.transl, stated.shape)
        pose, transl = white_noise(given, self.frames) or _START_NOISE[:2]
        pose, transl = max(pose, _LEAST_NOISE[0]), max(transl, _LEAST_NOISE[1])
        if self.seen is not None:
            return Start(given.select(rows), max(_BESIDE_KEYPOINTS * pose, _START_NOISE[0]), np.inf, np.inf)
        if self.placed is not None:  # what a hand corrects is believed less; a few points do not tell the shape
            return Start(given.select(rows), max(_BESIDE_KEYPOINTS * pose, _START_NOISE[0]), np.inf, _START_NOISE[2])
        return Start(given.select(rows), pose, transl, _START_NOISE[2])

    def _silhouettes(self, state: BodyState, rows: np.ndarray) -> SilhouetteTerm | None:
        outlines = {
            (name, k): self.outlines[name, int(row)]
            for k, row in enumerate(rows)
            for name in self.observed.cameras
            if (name, int(row)) in self.outlines
        }
        if not outlines:
            return None
        rng = np.random.default_rng(self.config.seed)
        skin = np.flatnonzero(_outer_part(self.body))
        index = np.sort(rng.permutation(skin)[: self.config.rim_samples])
        shaped = self.points.rest + self.points.shape_dirs @ state.betas
        surface = Surface(self.points, self.body.faces, self.body.mesh(shaped).vertex_normals)
        return SilhouetteTerm(surface, index, self.bare, self.observed.cameras, outlines, self.config)

    def _scans(self, rows: np.ndarray) -> ScanTerm | None:
        frames = self.frames[rows].tolist()
        scans = {k: self.observed.scans[frame] for k, frame in enumerate(frames) if frame in self.observed.scans}
        return ScanTerm(self.kinematics, self.points, self.bare, scans, self.config) if scans else None

    # -- what came out

    def _confidence(self, state: BodyState, equations: NormalEquations, rows: np.ndarray) -> Float64[np.ndarray, "n J"]:
        """`1 / (1 + (s / 20 mm)^2)` with s the standard deviation of a joint's place."""
        joints = BodyPoints.of_joints(self.body, np.arange(self.body.joint_count))
        out = np.zeros((len(rows), self.body.joint_count))
        for k, row in enumerate(rows):
            motion = self.kinematics.motion(joints, self.kinematics.posture(state, int(row)))
            jacobian = self.columns.jacobian(motion)[..., : self.columns.count]
            covariance = equations.covariance(int(row))
            variance = np.einsum("jxp,pq,jxq->j", jacobian, covariance, jacobian, optimize=True)
            out[k] = 1.0 / (1.0 + np.maximum(variance, 0.0) / _HALF_KNOWN**2)
        return out

    def _measure(self, state: BodyState) -> dict[str, Float64[np.ndarray, " T"]]:
        rows = np.arange(len(self.frames))
        terms = self._terms(state, rows)
        silhouettes, scans = self._silhouettes(state, rows), self._scans(rows)
        postures = [self.kinematics.posture(state, int(row)) for row in rows]
        out: dict[str, np.ndarray] = {}
        if terms.keypoints is not None:
            term = terms.keypoints
            out["keypoints_px"] = np.array([term.residual_px(r, self.kinematics, p) for r, p in enumerate(postures)])
        if terms.landmarks is not None:
            away = np.array([terms.landmarks.distances(r, self.kinematics, p) for r, p in enumerate(postures)])
            out["landmarks_mm"] = 1e3 * np.array([np.median(d[d == d]) if (d == d).any() else np.nan for d in away])
        if silhouettes is not None:
            out["silhouette_px"] = np.array(
                [silhouettes.residual_px(r, self.kinematics, p) for r, p in enumerate(postures)]
            )
        if scans is not None:
            both = np.array([scans.residual_mm(r, self.kinematics, p) for r, p in enumerate(postures)])
            out["skin_mm"], out["inside_mm"] = both[:, 0], both[:, 1]
        return out

    def _far_landmarks(self, state: BodyState) -> list[str]:
        """Which landmarks the body did not come to: misplaced ones, or a fit that went wrong."""
        out = []
        for row in range(len(self.frames) if self.placed is not None else 0):
            term = self._landmark_term(np.array([row]))
            assert term is not None
            posture = self.kinematics.posture(state, row)
            far = term.far(term.distances(0, self.kinematics, posture))
            if far:
                out.append(f"frame {self.frames[row]}: landmarks far from the fitted body's: {', '.join(far)}")
        return out


def _is_finger(name: str) -> bool:
    return any(finger in name for finger in ("index", "middle", "pinky", "ring", "thumb"))


def _outer_part(body: BodyModel) -> Bool[np.ndarray, " V"]:
    """Vertices that images can show: no eyes, teeth and tongue."""
    hidden = [k for k, name in enumerate(body.part_label_names) if any(w in name for w in ("eye", "teeth", "tongue"))]
    return ~np.isin(body.part_labels, hidden)
