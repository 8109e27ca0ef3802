"""How near refined poses come to the truth: starts as a registration leaves them, errors before and after.

    python -m benchmarks refinement --run RUN --capture DIR

RUN holds the template of the capture (`smplxpp build`). The starts are the exact parameters with white noise of 0.6
degrees a joint and 4 mm (`noise`), and the capture's noisy parameters smoothed in time (`smoothed`). The truth is
looked at in measuring alone: posed body vertices of `geometry/`, bare skin and under cloth apart.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import tyro
from jaxtyping import Bool
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from avatar.data.sequence import AvatarSequence, SequenceConfig
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.refine import Refinement, refine_held_out, refine_poses
from benchmarks.support.results import store_results
from smplxpp.body import load_params
from smplxpp.capture import Capture, open_capture
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix
from smplxpp.metrics.distance import MM
from smplxpp.register.kinematics import BodyState
from smplxpp.template.template import Template

NOISE_DEGREES, NOISE_MM, NOISE_EXPRESSION = 0.6, 4.0, 0.04
SMOOTHED_FRAMES = 1.5
"""Standard deviation of the filter in time."""
BODY_JOINTS = 22


@dataclass(frozen=True)
class RefinementBenchmark:
    """Refine from both starts and measure."""

    run_folder: Annotated[Path, tyro.conf.arg(name="run", metavar="RUN")]
    """Run with the template of the capture."""
    capture: Path
    """Folder of the capture, with exact and noisy parameters and true vertices."""
    starts: tuple[str, ...] = ("noise", "smoothed")
    """Of noise, smoothed, given (noisy parameters as they are), exact (what refinement does to right poses)."""
    frames: int = 10_000
    """At most so many training frames, from the first."""
    held_out: bool = False
    """Refine the held-out frames too, with the colours of the training frames."""
    cameras: bool = False
    """Correct the cameras too."""
    store: bool = True
    """Write benchmarks/results/refinement_CAPTURE.json."""
    states: Path | None = None
    """Folder for the refined parameters, START.npz with a row a refined frame."""

    def run(self) -> None:
        """Print and store the figures."""
        template = Template.load(self.run_folder / "60_assemble" / "smplxpp.npz")
        exact = load_params(self.capture / "params" / "params.npz")
        figures: dict[str, dict[str, object]] = {}
        config = RefineConfig(cameras=self.cameras)
        for name in self.starts:
            start = _START[name](template, exact, self.capture)
            with TemporaryDirectory() as folder:
                path = Path(folder) / "start.npz"
                start.save(path)
                sequence = AvatarSequence(
                    open_capture(self.capture, params=path), template, SequenceConfig(normals=False)
                )
                frames = sequence.train_frames[: self.frames]
                begin, spent = time.perf_counter(), time.process_time()
                found = refine_poses(sequence, config, frames=frames)
                figures[name] = {
                    "seconds": time.perf_counter() - begin,
                    "cpu_seconds": time.process_time() - spent,
                    "training": _compared(found, template, sequence.capture, exact),
                }
                if self.held_out:
                    apart = refine_held_out(sequence, found.gaussians, config)
                    figures[name]["held_out"] = _compared(apart, template, sequence.capture, exact)
            if self.states is not None:
                found.params.save(self.states / f"{name}.npz")
            print(name, figures[name], flush=True)
        if self.store:
            command = "python -m benchmarks refinement --run RUN --capture DIR"
            print(f"stored {store_results(f'refinement_{self.capture.name}', command, figures).name}")


def noise(template: Template, exact: BodyParams, capture: Path, *, seed: int = 0) -> BodyParams:
    """White noise on the truth, as a good registration leaves it."""
    state, random = BodyState.of_params(template.body, exact), np.random.default_rng(seed)
    turns = np.radians(NOISE_DEGREES) * random.normal(size=(*state.rotations.shape[:2], 3))
    noisy = BodyState(
        matrix_from_rotvec(turns) @ state.rotations,
        state.transl + NOISE_MM / MM * random.normal(size=state.transl.shape),
        state.betas,
        state.expression + NOISE_EXPRESSION * random.normal(size=state.expression.shape),
    )
    return replace(noisy.to_params(template.body, fps=exact.fps), betas=exact.betas)


def smoothed(template: Template, exact: BodyParams, capture: Path) -> BodyParams:
    """The capture's noisy parameters, every number smoothed in time: the least that a registration does."""
    given = load_params(capture / "params" / "params_noisy.npz")
    state = BodyState.of_params(template.body, given)

    def slow(values: np.ndarray) -> np.ndarray:
        return gaussian_filter1d(values, SMOOTHED_FRAMES, axis=0, mode="nearest")

    mean = Rotation.from_matrix(slow(state.rotations).reshape(-1, 3, 3)).as_matrix().reshape(state.rotations.shape)
    quiet = BodyState(mean, slow(state.transl), state.betas, slow(state.expression))
    return replace(quiet.to_params(template.body, fps=given.fps), betas=exact.betas)


def given(template: Template, exact: BodyParams, capture: Path) -> BodyParams:
    """The capture's noisy parameters as they are; the shape is the template's."""
    return replace(load_params(capture / "params" / "params_noisy.npz"), betas=exact.betas)


_START = {"noise": noise, "smoothed": smoothed, "given": given, "exact": lambda template, exact, capture: exact}


def _compared(
    found: Refinement, template: Template, capture: Capture, exact: BodyParams
) -> dict[str, dict[str, float] | list[int]]:
    return {
        "before": errors(template, found.start, exact.select(list(found.frames)), capture.root, found.frames),
        "after": errors(template, found.params, exact.select(list(found.frames)), capture.root, found.frames),
        "loss": {"before": float(found.before.mean()), "after": float(found.after.mean())},
        "kept": list(found.kept),
    }


def errors(
    template: Template, params: BodyParams, exact: BodyParams, root: Path, frames: tuple[int, ...]
) -> dict[str, float]:
    """Mean distances to the truth in mm: body vertices, bare skin, skin under cloth, joints; degrees a joint."""
    bare, under = bare_and_under(root, template.body.vertex_count)
    distance = []
    for row, frame in enumerate(frames):
        path = root / "geometry" / f"frame_{frame:06d}.npz"
        if not path.is_file():
            continue
        truth = np.load(path)["verts"][: template.body.vertex_count]
        posed = template.posed_body(params.frame(row)).vertices[0]
        distance.append(MM * np.linalg.norm(posed - truth, axis=1))
    of_vertices = np.array(distance)
    ours, true = (template.posed_body(p) for p in (params, exact))
    own, known = (BodyState.of_params(template.body, p).rotations[:, :BODY_JOINTS] for p in (params, exact))
    turned = np.degrees(np.linalg.norm(rotvec_from_matrix(own @ known.swapaxes(-1, -2)), axis=-1))
    apart = MM * np.linalg.norm(ours.joints - true.joints, axis=-1)[:, :BODY_JOINTS]
    return {
        "vertices_mm": float(of_vertices.mean()),
        "bare_skin_mm": float(of_vertices[:, bare].mean()),
        "under_cloth_mm": float(of_vertices[:, under].mean()),
        "worst_frame_mm": float(of_vertices.mean(axis=1).max()),
        "joints_mm": float(apart.mean()),
        "degrees_a_joint": float(turned.mean()),
    }


def bare_and_under(root: Path, count: int) -> tuple[Bool[np.ndarray, " V"], Bool[np.ndarray, " V"]]:
    """Body vertices of some visible face, and those of hidden faces alone."""
    topology = np.load(root / "geometry" / "topology.npz")
    faces, hidden = topology["faces"], topology["face_hidden"]
    body = (faces < count).all(axis=1)
    bare, covered = np.zeros(count, dtype=bool), np.zeros(count, dtype=bool)
    bare[faces[body & ~hidden]] = True
    covered[faces[body & hidden]] = True
    return bare, covered & ~bare


if __name__ == "__main__":
    tyro.cli(RefinementBenchmark).run()
