"""Register bodies to clothed scans from a few landmarks placed by hand.

    SMPLXPP_PEOPLE=FOLDER python -m benchmarks placed_landmarks

A hand is simulated: the truth's points with errors of 8 mm a coordinate on the skin and 15 mm within limbs. Measured
are the body's vertices and 22 joints against the truth, millimetres: of the landmarks alone, with the scan, and with
the scan after a search for the body (`locate_body`) that takes the landmarks.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import tyro
from jaxtyping import Float

from benchmarks.support.people import captured, captured_names
from benchmarks.support.results import store_results
from pipelines.viewer.session import lies_within
from smplxpp.body import BodyModel, load_body
from smplxpp.core import BodyParams, spread
from smplxpp.people import CAST, PersonScan, person
from smplxpp.register import LandmarkModel, Observations, ScanObservation, register
from smplxpp.register.locate import locate_body

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
    """Register people by landmarks and print how far the bodies are."""

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
        path = store_results("placed_landmarks", "python -m benchmarks placed_landmarks", figures)
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
    tyro.cli(PlacedLandmarks).run()
