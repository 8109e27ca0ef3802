"""Register a body to keypoints, landmarks, masks, label maps and scans over all frames: `register`.

The package's docstring states what is minimised; this module holds the schedule.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from smplxpp.body import BodyModel
from smplxpp.core import InputError, ProgressCallback, ignore_progress, spread
from smplxpp.register.clothing import bare_vertices, hand_vertices
from smplxpp.register.keypoint_term import KeypointTerm, PreparedKeypoints, prepare_keypoints
from smplxpp.register.kinematics import BodyPoints, BodyState, Kinematics
from smplxpp.register.landmark_term import LandmarkTerm, PlacedLandmarks
from smplxpp.register.landmarks import is_finger, visible_vertices
from smplxpp.register.normal_equations import Columns, NormalEquations
from smplxpp.register.observations import BodyFit, Observations, RegisterConfig, check_observations
from smplxpp.register.priors import Anatomy, Priors
from smplxpp.register.scan_term import ScanTerm
from smplxpp.register.silhouette_term import Outline, SilhouetteTerm, Surface
from smplxpp.register.solver import Terms, explains_as_well, gauss_newton, joint_confidence, unlikely_shape
from smplxpp.register.start import joined_points, start_of, state_from_points


def register(
    body: BodyModel,
    observed: Observations,
    config: RegisterConfig | None = None,
    *,
    progress: ProgressCallback = ignore_progress,
) -> BodyFit:
    """Fit pose, shape and translation of a body to keypoints, landmarks, masks, label maps and scans in any mixture.

    Gauss-Newton minimises the robust sum of squares that the package's docstring states. Keypoints and landmarks alone
    are fitted first, then everything. All frames share one shape, which `observed.shape_frames` determine. Cloth never
    pulls the body onto itself: it keeps a gap that is estimated (`Gaps`).

    Args:
        body: the body model.
        observed: cameras and everything seen through them, without held-out cameras.
        config: options.
        progress: called with the running step and its share done.

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
    """Frames of a motion that are solved together.

    Attributes:
        rows: of the frames in the whole sequence.
        kept: whether a frame's result is used; the others overlap with the neighbouring windows.
    """

    rows: np.ndarray
    kept: Bool[np.ndarray, " T"]


class _Registration:
    """The state of one registration: prepared observations, and the vertices known to be bare."""

    def __init__(
        self, body: BodyModel, observed: Observations, config: RegisterConfig, progress: ProgressCallback
    ) -> None:
        self.body, self.observed, self.config, self.progress = body, observed, config, progress
        self.kinematics, self.frames = Kinematics(body), np.array(observed.frames)
        # All vertices with their shape, expression and skinning weights: masks and scans share them and their
        # derivatives.
        self.points = BodyPoints.of_vertices(body, np.arange(body.vertex_count))
        self.seen: PreparedKeypoints | None = prepare_keypoints(body, observed, config)
        self.placed = PlacedLandmarks.of(body, observed.landmarks, observed.frames)
        self.notes = [note for one in (self.seen, self.placed) if one is not None for note in one.notes]
        shape_frames = observed.shape_frames or observed.frames
        self.tells_shape = np.isin(self.frames, shape_frames)
        self.outlines = self._outlines()
        self.columns = self._columns()
        # No vertex counts as bare before labels were looked up on an approximate body.
        self.bare = np.zeros(body.vertex_count, dtype=bool)
        self.labelled_only = False

    def fit(self) -> BodyFit:
        """Run the schedule and return the result with its residuals and confidence."""
        initial = state = self._start()
        everything = np.arange(len(self.frames))
        if self.observed.shape is not None:
            state, confidence = self._solve_windows(self._with_shape(state, self.observed.shape))
        elif len(self.frames) <= self.config.window:
            # A short take is one window, in which shape and poses are solved together.
            state, equations = self._solve(state, _Window(everything, np.ones(len(everything), dtype=bool)), True)
            confidence = joint_confidence(self.kinematics, state, equations, everything)
        else:
            # A long one gets its shape from some frames, then the poses of window after window with that shape.
            state = self._solve_shape(state)
            state, confidence = self._solve_windows(state)
        residuals = self._measure(state)
        self.notes += self._far_landmarks(state)
        # The same residuals of the fit that was given show how much the registration improved on it.
        before = self._measure(initial) if self.observed.initial is not None else {}
        params = state.to_params(self.body, fps=self.observed.fps)
        return BodyFit(tuple(self.observed.frames), params, confidence, residuals, before, tuple(self.notes))

    # -- preparation

    def _columns(self) -> Columns:
        """Choose the unknowns: parameters that nothing observes are not solved for and keep their values."""
        names = np.array(self.body.joint_names)
        landmarks = {name for one in (self.seen, self.placed) if one is not None for name in one.landmarks.names}
        sees_fingers = any(is_finger(name) or name.endswith("_tip") for name in landmarks)
        face = any(name.startswith("face_") for name in landmarks)
        # An initial fit is a measurement of fingers and jaw, which smoothness then keeps slow.
        given = self.observed.initial is not None
        free = np.full(len(names), True)
        free[[is_finger(name) for name in names]] = sees_fingers or given
        # No term observes the direction of gaze, so that the eyes keep their rotations.
        free[["eye" in name for name in names]] = False
        free[names == "jaw"] = face or given
        E = self.body.num_expressions
        # Without points of the face no coefficient of the expression is free.
        return Columns(np.flatnonzero(free), len(names), E if face else 0, E, self.body.num_betas)

    def _outlines(self) -> dict[tuple[str, int], Outline]:
        """Read all masks as signed distance fields, by camera and row, and note those that are missing."""
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
        # A capture without any mask needs no note, because masks are then not among its observations.
        for name, frames in missing.items():
            if len(frames) < len(self.frames) or out:
                self.notes.append(
                    f"camera {name}: no mask, or an empty one, in {len(frames)} of {len(self.frames)} frames, "
                    f"first in frame {frames[0]}; they are left out"
                )
        return out

    def _start(self) -> BodyState:
        """Return the initial fit, or the T-pose aligned to triangulated keypoints and landmarks."""
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

    def _with_shape(self, state: BodyState, shape: Float64[np.ndarray, " B"]) -> BodyState:
        """Return poses that named points give, with a shape that is given.

        The poses are found with a free shape first, because bones of another length than the start's may fold an elbow
        the wrong way, from where surfaces do not lead back.
        """
        given, count = np.atleast_1d(np.asarray(shape, dtype=np.float64)).ravel(), self.body.num_betas
        if np.abs(given[count:]).max(initial=0.0) > 0 or not np.isfinite(given).all():
            raise InputError("shape", expected=f"at most {count} finite betas", received=f"{len(given)}")
        terms = self._terms(state, np.arange(len(self.frames)))
        if terms.points():
            scales = np.geomspace(40.0, 1.0, self.config.joint_steps)
            state, _ = self._step("joints", state, terms, self.config.joint_steps, True, scales)
        return replace(state, betas=np.concatenate([given[:count], np.zeros(max(0, count - len(given)))]))

    # -- solving

    def _solve_shape(self, state: BodyState) -> BodyState:
        """Return the state with the shape that evenly spread frames determine."""
        # Frames spread over the take show the body in many poses, which separates shape from pose. Only the shape of
        # this solution is kept.
        rows = np.array(spread(np.flatnonzero(self.tells_shape).tolist(), self.config.shape_frames))
        solved, _ = self._solve(state.select(rows), _Window(rows, np.ones(len(rows), dtype=bool)), True)
        return replace(state, betas=solved.betas)

    def _solve_windows(self, state: BodyState) -> tuple[BodyState, Float64[np.ndarray, "T J"]]:
        """Return the poses of all frames, solved in overlapping windows with the shape held, and their confidence."""
        overlap = 10  # frames on each side whose results are dropped, so that windows join smoothly
        count, length = len(self.frames), self.config.window
        rotations, transl, expression = state.rotations.copy(), state.transl.copy(), state.expression.copy()
        confidence = np.zeros((count, self.body.joint_count))
        for first in range(0, count, length):
            inner = np.arange(first, min(first + length, count))
            rows = np.arange(max(0, first - overlap), min(count, first + length + overlap))
            window = _Window(rows, np.isin(rows, inner))
            # The overlap is solved with the window, so that the smoothness term acts across both of its ends.
            solved, equations = self._solve(state.select(rows), window, False)
            rotations[inner] = solved.rotations[window.kept]
            transl[inner] = solved.transl[window.kept]
            expression[inner] = solved.expression[window.kept]
            confidence[inner] = joint_confidence(self.kinematics, solved, equations, np.flatnonzero(window.kept))
        return BodyState(rotations, transl, state.betas, expression), confidence

    def _solve(self, state: BodyState, window: _Window, solve_shape: bool) -> tuple[BodyState, NormalEquations]:
        """Solve one window, and again where the shape is that of no person: without scans that are not labelled.

        Dents of a rough scan push the body inwards, and nothing but the prior pulls it out below clothes, whose
        distance grows with it. If the shape stays unlikely, its prior gets heavier. A person who really is so has
        keypoints, contours and labelled skin that no likelier shape explains.
        """
        solved = self._solved(state, window, solve_shape)
        if not solve_shape or not unlikely_shape(solved[0]):
            return solved
        # What is left out of a solution takes no part in the comparison either, see `_scans`.
        config, before = self.config, self._measure(solved[0], window.rows)
        self.labelled_only = True
        for weight in (1.0, 4.0, 16.0):
            self.config = replace(config, shape_prior=weight * config.shape_prior)
            other = self._solved(state, window, solve_shape)
            if not explains_as_well(self._measure(other[0], window.rows), before):
                break
            solved = other
            if not unlikely_shape(solved[0]):
                break
        self.config, self.labelled_only = config, False
        return solved

    def _solved(self, state: BodyState, window: _Window, solve_shape: bool) -> tuple[BodyState, NormalEquations]:
        """Solve one window: named points first, then all terms with the vertices that are now known to be bare."""
        config, rows = self.config, window.rows
        terms = self._terms(state, rows)
        equations = NormalEquations(self.columns, len(state))
        if terms.points():
            # The robust kernel narrows from 40 standard deviations to one in two thirds of the steps.
            scales = np.geomspace(40.0, 1.0, max(1, 2 * config.joint_steps // 3))
            scales = np.concatenate([scales, np.ones(config.joint_steps - len(scales))])
            state, equations = self._step("joints", state, terms, config.joint_steps, solve_shape, scales)
        # Labels are looked up on the body as it stands now; without any labels, hands are taken for bare.
        bare = bare_vertices(self.kinematics, state, self.observed, self.frames[rows].tolist(), self.points)
        if bare is not None:
            self.bare = bare
        elif not self.bare.any():
            self.bare = hand_vertices(self.body) if self.observed.bare is None else self.observed.bare
        # Surfaces need an approximate body, because their correspondences are nearest points.
        terms = replace(terms, silhouettes=self._silhouettes(state, rows), scans=self._scans(rows))
        if terms.surfaces():
            state, equations = self._step("surfaces", state, terms, config.surface_steps, solve_shape, None)
        # An initial fit alone: smoothness and priors filter it, and it enters as a measurement of itself.
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
        """Run Gauss-Newton steps, report them, and let the cutoff of surfaces fall from step to step."""

        def done(k: int) -> None:
            self.progress(what, (k + 1) / steps)
            for term in terms.surfaces():
                # From the whole reach to 0.4 of it in four steps: far points pull at first, outliers less and less.
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
        """Return the priors and the terms of named points for some rows."""
        frames, anatomy = self.frames[rows], Anatomy.of(self.body.joint_count)
        # The initial fit counts as a measurement, with the noise that is stated or that its jitter shows.
        start = None
        if self.observed.initial is not None:
            start = start_of(
                BodyState.of_params(self.body, self.observed.initial),
                self.frames,
                rows,
                stated=self.observed.initial_noise,
                beside_keypoints=self.seen is not None,
                beside_landmarks=self.placed is not None,
            )
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

    def _silhouettes(self, state: BodyState, rows: np.ndarray) -> SilhouetteTerm | None:
        """Return the term of masks for some rows; None if they have no masks."""
        outlines = {
            (name, k): self.outlines[name, int(row)]
            for k, row in enumerate(rows)
            for name in self.observed.cameras
            if (name, int(row)) in self.outlines
        }
        if not outlines:
            return None
        # A random sample of the visible vertices, and normals of the shape as it stands.
        rng = np.random.default_rng(self.config.seed)
        index = np.sort(rng.permutation(visible_vertices(self.body))[: self.config.rim_samples])
        shaped = self.points.rest + self.points.shape_dirs @ state.betas
        surface = Surface(self.points, self.body.faces, self.body.mesh(shaped).vertex_normals)
        return SilhouetteTerm(surface, index, self.bare, self.observed.cameras, outlines, self.config)

    def _scans(self, rows: np.ndarray) -> ScanTerm | None:
        """Return the term of scans for some rows; None if they have no scans."""
        frames = self.frames[rows].tolist()
        scans = {k: self.observed.scans[frame] for k, frame in enumerate(frames) if frame in self.observed.scans}
        if self.labelled_only:
            scans = {k: scan for k, scan in scans.items() if scan.labels is not None}
        return ScanTerm(self.kinematics, self.points, self.bare, scans, self.config) if scans else None

    # -- results

    def _measure(self, state: BodyState, rows: np.ndarray | None = None) -> dict[str, Float64[np.ndarray, " T"]]:
        """Return the residuals of a state in all or some frames; gaps are not known, so all cloth counts as it is."""
        # All frames at once, because residuals need no linear system and windows would only divide the result.
        rows = np.arange(len(self.frames)) if rows is None else rows
        terms = replace(self._terms(state, rows), silhouettes=self._silhouettes(state, rows), scans=self._scans(rows))
        return terms.residuals(self.kinematics, state)

    def _far_landmarks(self, state: BodyState) -> list[str]:
        """Return notes about landmarks far from the fitted body: misplaced ones, or a fit that failed."""
        out = []
        for row in range(len(self.frames) if self.placed is not None else 0):
            # A term of this frame alone, whose row is therefore 0.
            term = self._landmark_term(np.array([row]))
            assert term is not None
            posture = self.kinematics.posture(state, row)
            far = term.far(term.distances(0, self.kinematics, posture))
            if far:
                out.append(f"frame {self.frames[row]}: landmarks far from the fitted body's: {', '.join(far)}")
        return out
