"""Measure registered bodies against the truth: from every kind of input, and from a few landmarks placed by hand.

smplxpp capture degrade DIR --out TRACKED
python -m benchmarks registration inputs --capture TRACKED [--run RUN]
SMPLXPP_PEOPLE=FOLDER python -m benchmarks registration landmarks
"""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Bool, Float

from benchmarks.support.people import captured, captured_names
from benchmarks.support.results import store_results
from pipelines.commands.options import OptionalPath
from pipelines.runs.artefacts import load_stacked_params
from pipelines.runs.layout import REFINED_HELD_OUT_PARAMS, REFINED_PARAMS
from pipelines.stages.build_config import RegisterInputs
from pipelines.viewer.session import lies_within
from smplxpp.body import BodyModel, load_body, load_params
from smplxpp.build.observe import observe
from smplxpp.core import SKIN, BodyParams, matrix_from_rotvec, spread
from smplxpp.metrics.pose_error import pose_error
from smplxpp.people import CAST, PersonScan, person
from smplxpp.register import BodyState, LandmarkModel, Observations, RegisterConfig, ScanObservation, register
from smplxpp.register.locate import locate_body

OFF_DEGREES = 15.0
"""A start this far off: the length of each joint's error, in a random direction."""
COMMAND = (
    "smplxpp capture degrade DIR --out TRACKED; python -m benchmarks registration inputs --capture TRACKED --run RUN"
)


@dataclass(frozen=True)
class RegistrationBenchmark:
    """Measure registered bodies against the truth, from each kind of input and from bad starts, beside baselines.

    TRACKED has a tracker's inputs by protocol `tracked`: noisy parameters, a detector's keypoints (3 px of noise, 5 %
    outliers, 10 % missing), label maps with 5 % of wrong pixels. The truth is looked at in measuring alone.
    Baselines: keypoints without anything else, and a symmetric fit, which attracts the whole scan and the body to
    each other as iterated closest points do (all of it counts as skin). RUN: a build by that protocol and its refined
    poses, if it has any.
    """

    capture: Path
    """Folder of a capture with the protocols exact and tracked, and true vertices in geometry/."""
    run_folder: OptionalPath = None
    """Run of the capture with refined poses, whose errors are printed too."""
    cases: tuple[str, ...] = ()
    """Names of cases; all by default."""
    store: bool = True
    """Write benchmarks/results/registration_CAPTURE.json."""
    name: str = ""
    """Name of the capture in the result, its folder's by default."""

    def run(self) -> None:
        """Print and store the figures."""
        body = load_body()
        observed = observe(RegisterInputs(capture=self.capture, protocol="tracked"), body)
        seen, capture = observed.observations, observed.capture
        assert capture is not None and seen.initial is not None
        exact = load_params(self.capture / "params" / "params.npz", body=body)
        # Every fit is compared with the exact parameters; held-out frames have figures of their own.
        truth = _Truth(body, exact, bare_and_under(self.capture, body.vertex_count)[1], capture.splits.train_frames)
        rows: dict[str, object] = {"as tracked": truth.errors(seen.frames, seen.initial)}
        # A start that is further off shows how large the region of convergence is.
        off = replace(seen, initial=_off(body, seen.initial))
        rows[f"{OFF_DEGREES:g} degrees off"] = truth.errors(off.frames, off.initial)
        for name, case in _cases(seen, off).items():
            if self.cases and name not in self.cases:
                continue
            begin, cpu = time.perf_counter(), time.process_time()
            fit = register(body, case, RegisterConfig())
            seconds, spent = time.perf_counter() - begin, time.process_time() - cpu
            rows[name] = truth.errors(fit.frames, fit.params) | {
                "frames": len(fit.frames),
                "seconds": seconds,
                "cpu_seconds": spent,
                "residuals": {key: float(np.nanmean(values)) for key, values in fit.residuals.items()},
            }
            print(name, rows[name], *fit.notes, sep="\n  ", flush=True)
        rows |= self._refined(truth)
        if self.store:
            figures = {
                "protocol": "tracked",
                "cameras": len(seen.cameras),
                "peak_memory_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
                "rows": rows,
            }
            path = store_results(f"registration_{self.name or self.capture.name}", COMMAND, figures)
            print(f"stored {path.name}")

    def _refined(self, truth: _Truth) -> dict[str, object]:
        """Return errors of a run's poses after refinement on photographs."""
        if self.run_folder is None or not (self.run_folder / REFINED_PARAMS).is_file():
            return {}
        frames, params = load_stacked_params(self.run_folder / REFINED_PARAMS)
        rows = {"registered, then refined on photographs": truth.errors(tuple(frames), params)}
        apart = self.run_folder / REFINED_HELD_OUT_PARAMS
        if apart.is_file():
            frames, params = load_stacked_params(apart)
            rows["the same, held-out frames refined on training cameras"] = truth.errors(tuple(frames), params)
        print(rows)
        return dict(rows)


@dataclass(frozen=True, eq=False)
class _Truth:
    """The exact parameters, and the errors of others against them."""

    body: BodyModel
    exact: BodyParams
    covered: Bool[np.ndarray, " V"]
    train_frames: tuple[int, ...]

    def errors(self, frames: tuple[int, ...], params: BodyParams | None) -> dict[str, object]:
        """Errors of training frames, and of held-out frames where there are any."""
        assert params is not None
        train = np.isin(frames, self.train_frames)
        out: dict[str, object] = {}
        for name, rows in (("training", np.flatnonzero(train)), ("held_out", np.flatnonzero(~train))):
            if len(rows):
                numbers = np.asarray(frames)[rows]
                found = pose_error(params.select(rows), self.exact.select(numbers), self.body, self.covered)
                out[name] = asdict(found)
        return out


def _cases(seen: Observations, off: Observations) -> dict[str, Observations]:
    """Inputs in mixtures."""
    no_keypoints: Mapping = {}
    cases = {
        "keypoints alone": replace(seen, initial=None, mask=None, labels=None, scans={}),
        "keypoints, masks": replace(seen, initial=None, labels=None, scans={}),
        "keypoints, masks, labels, scan": replace(seen, initial=None),
        "tracked parameters, masks": replace(seen, keypoints=no_keypoints, labels=None, scans={}),
        "tracked parameters, masks, labels, scan": replace(seen, keypoints=no_keypoints),
        "everything": seen,
        f"everything, from {OFF_DEGREES:g} degrees off": off,
    }
    scanned = [frame for frame in seen.frames if frame in seen.scans]
    if scanned:
        one = _one_frame(seen, scanned[0])
        cases["one scan, ours"] = one
        cases["one scan, symmetric"] = replace(one, scans={k: _all_skin(scan) for k, scan in one.scans.items()})
    return {name: case for name, case in cases.items() if case.keypoints or case.initial is not None}


def _one_frame(seen: Observations, frame: int) -> Observations:
    """A scan and a fit to start from, nothing else."""
    assert seen.initial is not None
    return Observations(
        (frame,),
        scans={frame: seen.scans[frame]},
        initial=seen.initial.select([seen.frames.index(frame)]),
        fps=seen.fps,
    )


def _all_skin(scan: ScanObservation) -> ScanObservation:
    return replace(scan, labels=np.full(scan.mesh.vertex_count, SKIN.id))


def _off(body: BodyModel, params: BodyParams) -> BodyParams:
    """The parameters with each joint of each frame turned by `OFF_DEGREES` about a random axis."""
    state, rng = BodyState.of_params(body, params), np.random.default_rng(0)
    axes = rng.normal(size=(*state.rotations.shape[:2], 3))
    axes /= np.linalg.norm(axes, axis=-1, keepdims=True)
    turned = matrix_from_rotvec(np.radians(OFF_DEGREES) * axes) @ state.rotations
    return replace(state, rotations=turned).to_params(body, fps=params.fps)


def bare_and_under(root: Path, count: int) -> tuple[Bool[np.ndarray, " V"], Bool[np.ndarray, " V"]]:
    """Body vertices of some visible face, and those of hidden faces alone."""
    topology = np.load(root / "geometry" / "topology.npz")
    faces, hidden = topology["faces"], topology["face_hidden"]
    body = (faces < count).all(axis=1)
    bare, covered = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    bare[faces[body & ~hidden]] = True
    covered[faces[body & hidden]] = True
    return bare, covered & ~bare


ON_SKIN, WITHIN = 0.008, 0.015
"""Metres, standard deviations of a hand's error."""
EIGHT = (
    "nose",
    "pelvis",
    *(f"{side}_{part}" for part in ("shoulder", "wrist", "ankle") for side in ("left", "right")),
)
FIFTEEN = (
    "nose",
    "neck",
    "left_big_toe",
    *(
        f"{side}_{part}"
        for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
        for side in ("left", "right")
    ),
)
BODY_JOINTS = 22
_KEYS = ("vertices", "joints", "worst joint")


@dataclass(frozen=True)
class PlacedLandmarks:
    """Register bodies to clothed scans from a few landmarks placed by hand.

    A hand is simulated: the truth's points with errors of 8 mm a coordinate on the skin and 15 mm within limbs.
    Measured are the body's vertices and 22 joints against the truth, millimetres: of the landmarks alone, with the
    scan, and with the scan after a search for the body (`locate_body`) that takes the landmarks.
    """

    people: int = 6
    """Procedural people beside the captured ones, spread over the cast."""
    seed: int = 0
    """Seed of the simulated hand's errors."""

    def run(self) -> None:
        """Print and store the errors of everybody."""
        body, figures = load_body(), dict[str, dict[str, dict[str, float]]]()
        for scan in self._scans():
            found = {name: _errors(body, params, scan) for name, params in self._fits(body, scan)}
            figures[scan.name] = found
            print(scan.name, *(f"{name}: {_in_words(one)}" for name, one in found.items()), sep="\n    ", flush=True)
        for name in next(iter(figures.values())):
            worst = {key: max(found[name][key] for found in figures.values()) for key in _KEYS}
            print(f"worst of {name}: {_in_words(worst)}")
        path = store_results("placed_landmarks", "python -m benchmarks registration landmarks", figures)
        print(f"stored {path.name}")

    def _scans(self) -> Iterator[PersonScan]:
        for name in captured_names():
            yield captured(name)
        for name in spread(tuple(CAST), self.people):
            yield person(name).as_read()

    def _fits(self, body: BodyModel, scan: PersonScan) -> Iterator[tuple[str, BodyParams]]:
        scans = {0: ScanObservation(scan.mesh)}
        for names in (EIGHT, FIFTEEN):
            points = self._placed(body, scan, names)
            count = f"{len(names)} landmarks"
            yield f"{count} alone", register(body, Observations((0,), landmarks={0: points})).params
            yield f"{count}, scan", register(body, Observations((0,), landmarks={0: points}, scans=scans)).params
        points = self._placed(body, scan, EIGHT)
        yield "8 landmarks, searched", locate_body(body, scan.mesh, colors=scan.colors, landmarks=points).params

    def _placed(
        self, body: BodyModel, scan: PersonScan, names: tuple[str, ...]
    ) -> Mapping[str, Float[np.ndarray, " 3"]]:
        points = LandmarkModel.of(body, names).points(scan.body_vertices, scan.joints)
        sigma = np.array([WITHIN if lies_within(name) else ON_SKIN for name in names])
        points = points + sigma[:, None] * np.random.default_rng(self.seed).normal(size=points.shape)
        return dict(zip(names, points, strict=True))


def _errors(body: BodyModel, params: BodyParams, scan: PersonScan) -> dict[str, float]:
    """Means of vertices and joints, and the worst joint, millimetres."""
    posed = body.forward(params).frame(0)
    joints = 1e3 * np.linalg.norm(posed.joints - scan.joints, axis=1)[:BODY_JOINTS]
    vertices = 1e3 * np.linalg.norm(posed.vertices - scan.body_vertices, axis=1)
    return dict(zip(_KEYS, (float(vertices.mean()), float(joints.mean()), float(joints.max())), strict=True))


def _in_words(errors: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.1f}" for name, value in errors.items())


if __name__ == "__main__":
    tyro.extras.subcommand_cli_from_dict({"inputs": RegistrationBenchmark, "landmarks": PlacedLandmarks}).run()
