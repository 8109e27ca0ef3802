"""Measure what one camera gives of a person who turns before it: body, poses, lens and surface, against the truth.

    smplxpp synth --motion turntable --frames 8 --fps 1 --size 960 --seed 1 --out trousers8
    smplxpp synth --motion turntable --frames 8 --fps 1 --size 960 --seed 2 --outside 8 --out outside8
    smplxpp synth --motion turntable --frames 8 --fps 1 --size 960 --seed 3 --clothes skirt --out skirt8
    smplxpp synth --motion turntable --frames 24 --fps 3 --size 960 --out trousers24
    python -m benchmarks turntable --captures trousers8 outside8 skirt8 trousers24

Captures of `smplxpp synth --motion turntable`, rows called by their folders: a tracker's keypoints (3 px of noise at
640 rows, 5 % outliers, 10 % missing), true masks. Body: mean distance of the skin's vertices in a frame after a rigid
alignment, over all frames; similar: after one with a scale. Surface: the reconstruction in the pose of frame 0,
aligned as that frame's body is, to the true outer surface (P2S) and back from those points that two frames see
(completeness).
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float64

from benchmarks.accuracy.reconstruction import SAMPLES, distances, seen_by_two, true_surface
from benchmarks.support.results import store_results
from smplxpp.body import BodyModel, load_body
from smplxpp.build.turning import posed_person
from smplxpp.capture import Capture, open_capture
from smplxpp.core import BodyParams, Camera, normalize_rows
from smplxpp.metrics.comparison import MM
from smplxpp.metrics.sampling import sample_surface
from smplxpp.reconstruct import PhotoView, Reconstruction
from smplxpp.reconstruct.turntable import reconstruct_turntable
from smplxpp.register import Observations
from smplxpp.register.turntable import TurntableConfig, TurntableFit, register_turntable

COMMAND = "python -m benchmarks turntable --captures DIR ..."
CASES = {
    "lens and height told": (1.0, 0.0, True),
    "height told, lens taken for 25 % longer": (1.25, 0.25, True),
    "nothing told, lens taken for 25 % longer": (1.25, 0.25, False),
}
"""Factor on the true focal length, its stated spread, and whether the height is told."""


@dataclass(frozen=True)
class TurntableBenchmark:
    """Register and reconstruct turns, and measure."""

    captures: tuple[Path, ...]
    """Captures of `smplxpp synth --motion turntable`."""
    cases: tuple[str, ...] = tuple(CASES)
    """Names of cases."""
    store: bool = True
    """Write benchmarks/results/turntable.json."""

    def run(self) -> None:
        """Print and store the figures."""
        body, rows = load_body(), {}
        for folder in self.captures:
            seen, exact = open_capture(folder, protocol="tracked"), open_capture(folder, protocol="exact")
            truth = BodyParams.concatenate([exact.params(frame) for frame in exact.frames])
            for case in self.cases:
                begin = time.process_time()
                found = registered(body, seen, truth, case)
                row = body_figures(body, seen, found, truth) | {"register_cpu_s": time.process_time() - begin}
                if case == next(iter(CASES)):
                    begin = time.process_time()
                    made = surface(body, seen, found)
                    row |= {"surface_cpu_s": time.process_time() - begin}
                    row |= surface_figures(body, folder, seen, (found, made), truth)
                rows[f"{folder.name}, {case}"] = row
                print(folder.name, case, row, flush=True)
        if self.store:
            print(f"stored {store_results('turntable', COMMAND, {'rows': rows}).name}")


def registered(body: BodyModel, capture: Capture, truth: BodyParams, case: str) -> TurntableFit:
    """Register a turn of a capture, with a camera at the origin whose lens is wrong by the case's factor."""
    factor, spread, told = CASES[case]
    ((name, camera),) = capture.cameras.items()
    K = camera.K.copy()
    K[:2, :2] *= factor
    level = Camera(K, np.diag([1.0, -1.0, -1.0, 1.0]), camera.width, camera.height, name=name)
    keypoints = capture.keypoints(name)
    assert keypoints is not None
    observed = Observations(capture.frames, {name: level}, {name: keypoints}, mask=capture.mask)
    rest = body.v_template + body.shapedirs @ truth.betas[0]
    stature = float(np.ptp(rest[:, 1])) if told else None
    return register_turntable(body, observed, TurntableConfig(stature=stature, focal_spread=spread))


def body_figures(body: BodyModel, capture: Capture, found: TurntableFit, truth: BodyParams) -> dict[str, float]:
    """Return the body's errors in millimetres, residuals in pixels, and the errors of lens and vertical."""
    own, true = body.forward(found.fit.params), body.forward(truth)
    skin = np.flatnonzero(body.part_labels == body.part_label_names.index("body"))
    errors = {"body_mm": [], "similar_mm": [], "joints_mm": []}
    for a, b, p, q in zip(own.vertices, true.vertices, own.joints, true.joints, strict=True):
        errors["body_mm"].append(_off(a[skin], b[skin], scaled=False))
        errors["similar_mm"].append(_off(a[skin], b[skin], scaled=True))
        errors["joints_mm"].append(_off(p[:22], q[:22], scaled=False))
    (camera,) = capture.cameras.values()
    residuals = {name: float(np.nanmedian(values)) for name, values in found.fit.residuals.items()}
    return {
        **{name: MM * float(np.mean(values)) for name, values in errors.items()},
        "worst_frame_mm": MM * float(np.max(errors["body_mm"])),
        **residuals,
        "focal_over_true": float(found.camera.K[0, 0] / camera.K[0, 0]),
    }


def surface(body: BodyModel, capture: Capture, found: TurntableFit) -> Reconstruction:
    """Reconstruct the surface in the pose of the first frame."""
    (name,) = capture.cameras
    views = []
    for frame in capture.frames:
        mask = capture.mask(name, frame)
        assert mask is not None
        views.append(PhotoView(str(frame), found.camera, capture.image(name, frame), mask))
    return reconstruct_turntable(views, posed_person(body, found.fit.params))


def surface_figures(
    body: BodyModel, folder: Path, capture: Capture, made: tuple[TurntableFit, Reconstruction], truth: BodyParams
) -> dict[str, object]:
    """Return distances between the reconstruction and the true surface of the first frame."""
    found, result = made
    rotation, move, _ = _alignment(
        body.forward(found.fit.params.frame(0)).vertices[0], body.forward(truth.frame(0)).vertices[0], scaled=False
    )
    mesh = result.mesh.with_vertices(result.mesh.vertices @ rotation.T + move)
    true, ((_, camera),) = true_surface(folder, capture.frames[0]), capture.cameras.items()
    # Frames as rigid cameras about the true body, to tell which points two of them see.
    moved = posed_person(body, truth).transforms[:, 0]
    blank = np.zeros((camera.height, camera.width, 3), np.uint8)
    views = [
        PhotoView(str(k), replace(camera, cam_from_world=camera.cam_from_world @ one), blank, blank[..., 0])
        for k, one in enumerate(moved)
    ]
    points = sample_surface(true, SAMPLES, seed=1)
    visible = points.points[seen_by_two(true, points.points, normalize_rows(points.normals), views)]
    return {
        **distances(mesh, true, visible),
        "silhouettes": float(np.mean(list(result.numbers["silhouettes"].values()))),
        "left_out": len(result.numbers["left_out"]),
        "unseen": result.unseen,
    }


def _alignment(
    source: Float64[np.ndarray, "N 3"], target: Float64[np.ndarray, "N 3"], *, scaled: bool
) -> tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, " 3"], float]:
    """Return scale times rotation, translation and scale that map points to others best (Umeyama 1991)."""
    a, b = source.mean(axis=0), target.mean(axis=0)
    u, s, vt = np.linalg.svd((target - b).T @ (source - a))
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    scale = float((s * signs).sum() / ((source - a) ** 2).sum()) if scaled else 1.0
    turn = scale * (u * signs) @ vt
    return turn, b - turn @ a, scale


def _off(source: np.ndarray, target: np.ndarray, *, scaled: bool) -> float:
    """Return the mean distance after alignment, metres."""
    turn, move, _ = _alignment(source, target, scaled=scaled)
    return float(np.linalg.norm(source @ turn.T + move - target, axis=1).mean())


if __name__ == "__main__":
    tyro.cli(TurntableBenchmark).run()
