"""Simulate procedural garments in rough motion: breakdowns, stretch, penetration, milliseconds a step.

    python -m benchmarks cloth_stress [--garments "long skirt"] [--motions kneel] [--sheet worst.png] [--no-store]

17 garments and hairstyles are made by procedure on the open body in the T-pose, cut as a run cuts its loose parts, and
stepped through 10 motions of 1.5 s at 30 frames a second, from a cold start each. None of it was fitted to a person.

- *beyond*: frames in which an edge of the simulated mesh is longer than 1.25 times its length at rest; *resets*:
  how often the simulation began again on the body; *longest*, *drawn*: the longest edge of any frame, simulated and
  drawn, over its length at rest.
- *inside*: drawn vertices that the simulation moves and that are more than 3 mm inside of the whole body, the mean of
  every sixth frame, and the deepest of the 99 % that are least deep, mm; the collider is coarser than this body.
- *ms*: CPU milliseconds a step, the median, with the measuring.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from jaxtyping import Float
from scipy.interpolate import PchipInterpolator

from benchmarks.support.results import store_results
from pipelines.figures import encode_png, fit_cameras
from smplxpp.body import BodyModel, load_body
from smplxpp.body.model import PosedBody
from smplxpp.cloth import ClothDriver, DriverConfig, cut_garment
from smplxpp.cloth import Garment as Simulated
from smplxpp.core import LABELS, BodyParams, GeometryWarning, InputError, SkinWeights, TriangleMesh
from smplxpp.core.files import atomic_write_bytes
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.people.garments.cut import Garment
from smplxpp.people.garments.loose import hung
from smplxpp.people.garments.mannequin import Mannequin
from smplxpp.people.garments.wardrobe import all_garments
from smplxpp.raster import render_shaded
from smplxpp.template.template import Template

FPS, SECONDS = 30.0, 1.5
GARMENTS = (
    *("mini skirt", "knee skirt", "mid-calf skirt", "long skirt", "flared skirt", "full circle skirt"),
    *("pleated skirt", "dress", "open coat", "cape", "wide trousers, hem 24 cm", "hakama", "wide sleeves"),
    *("scarf", "tie", "long loose hair", "ponytail"),
)
_Turns = Mapping[str, tuple[float, float, float]]
_Key = tuple[float, _Turns, tuple[float, float, float]]


def _both(name: str, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> _Turns:
    """A joint of both sides turned mirrored, degrees."""
    return {f"left_{name}": (x, y, z), f"right_{name}": (x, -y, -z)}


_DOWN = _both("shoulder", z=-55.0)
_STRIDE = {"left_hip": (-32.0, 0, 3), "left_knee": (12.0, 0, 0), "right_hip": (24.0, 0, -3), "right_knee": (30.0, 0, 0)}
_BACK = {"right_hip": (-32.0, 0, -3), "right_knee": (12.0, 0, 0), "left_hip": (24.0, 0, 3), "left_knee": (30.0, 0, 0)}
_RUN = {"left_hip": (-62.0, 0, 3), "left_knee": (80.0, 0, 0), "right_hip": (28.0, 0, -3), "right_knee": (55.0, 0, 0)}
_RUN_BACK = {
    "right_hip": (-62.0, 0, -3),
    "right_knee": (80.0, 0, 0),
    "left_hip": (28.0, 0, 3),
    "left_knee": (55.0, 0, 0),
}
_SIT = {**_both("hip", x=-88.0, z=6.0), **_both("knee", x=88.0), "spine1": (8.0, 0, 0)}
_SQUAT = {**_both("hip", x=-115.0, z=18.0), **_both("knee", x=128.0), "pelvis": (22.0, 0, 0), "spine1": (15.0, 0, 0)}
_KNEEL = {**_both("hip", x=-20.0, z=5.0), **_both("knee", x=115.0), **_both("ankle", x=30.0)}
_SPLIT = {"left_hip": (-95.0, 0, 20), "left_knee": (15.0, 0, 0), "right_hip": (20.0, 0, -8), "right_knee": (20.0, 0, 0)}
_LYING = {**_both("hip", x=-12.0, z=6.0), **_both("knee", x=25.0), "pelvis": (-88.0, 0, 0)}
MOTIONS: Mapping[str, tuple[_Key, ...]] = {
    "walk": tuple((0.25 * k, {} if not k else (_STRIDE, _BACK)[k % 2], (0, 0, 0.33 * k)) for k in range(7)),
    "run": tuple((0.16 * k, {} if not k else (_RUN, _RUN_BACK)[k % 2], (0, 0, 0.5 * k)) for k in range(11)),
    "sit": ((0.0, {}, (0, 0, 0)), (0.7, _SIT, (0, -0.4, -0.2)), (1.1, _SIT, (0, -0.4, -0.2)), (1.5, {}, (0, 0, 0))),
    "kneel": ((0.0, {}, (0, 0, 0)), (0.7, _KNEEL, (0, -0.42, 0)), (1.5, _KNEEL, (0, -0.42, 0))),
    "squat": ((0.0, {}, (0, 0, 0)), (0.5, _SQUAT, (0, -0.55, 0)), (0.9, _SQUAT, (0, -0.55, 0)), (1.5, {}, (0, 0, 0))),
    "twist": tuple((0.3 * k, {"pelvis": (0, 75.0 * (-1) ** k * (k > 0), 0)}, (0, 0, 0)) for k in range(6)),
    "dance": (
        (0.0, {}, (0, 0, 0)),
        (0.35, {**_SPLIT, "pelvis": (0, 120.0, 0)}, (0, 0, 0.2)),
        (0.8, {**_STRIDE, **_both("shoulder", z=40.0), "pelvis": (0, 240.0, 0)}, (0.3, 0, 0.2)),
        (1.15, {**_BACK, "pelvis": (0, 340.0, 0), "spine2": (0, 30.0, 0)}, (0.3, 0, 0)),
        (1.5, {"pelvis": (0, 380.0, 0)}, (0, 0, 0)),
    ),
    "arms up": (
        (0.0, {}, (0, 0, 0)),
        (0.4, {**_both("collar", z=15.0), **_both("shoulder", z=70.0), "spine2": (-10.0, 0, 0)}, (0, 0, 0)),
        (0.8, _DOWN, (0, 0, 0)),
        (1.2, {**_both("shoulder", y=-70.0, z=-10.0), **_both("elbow", y=-60.0)}, (0, 0, 0)),
        (1.5, _DOWN, (0, 0, 0)),
    ),
    "fall": (
        (0.0, {}, (0, 0, 0)),
        (0.4, {**_KNEEL, "pelvis": (30.0, 0, 0), **_both("shoulder", y=-60.0)}, (0, -0.42, 0.3)),
        (0.75, {**_both("hip", x=-30.0), **_both("knee", x=40.0), "pelvis": (85.0, 0, 0)}, (0, -0.8, 0.7)),
        (1.5, {**_both("hip", x=-8.0), **_both("knee", x=15.0), "pelvis": (88.0, 0, 0)}, (0, -0.85, 0.8)),
    ),
    "floor": (
        *((0.0, {}, (0, 0, 0)), (0.55, _SQUAT, (0, -0.62, -0.1)), (0.85, _LYING, (0, -0.85, -0.5))),
        (1.15, {**_SPLIT, "pelvis": (-80.0, 40.0, 0)}, (0.2, -0.85, -0.5)),
        (1.5, {**_LYING, "left_hip": (-70.0, 0, 10), "left_knee": (90.0, 0, 0)}, (0.2, -0.85, -0.5)),
    ),
}


def motion(body: BodyModel, keys: Sequence[_Key], betas: Float[np.ndarray, " B"]) -> BodyParams:
    """Return a motion through key poses, monotone between them: seconds, turns over lowered arms, metres."""
    pose = np.zeros((len(keys), body.joint_count, 3))
    for k, (_, turns, _) in enumerate(keys):
        for name, degrees in {**_DOWN, **turns}.items():
            pose[k, body.joint_names.index(name)] = np.radians(degrees)
    times, at = [key[0] for key in keys], np.arange(round(SECONDS * FPS) + 1) / FPS
    moved = PchipInterpolator(times, pose)(np.minimum(at, times[-1]))
    return BodyParams.from_full_pose(
        moved,
        betas=np.repeat(betas[None], len(at), axis=0),
        expression=np.zeros((len(at), body.num_expressions)),
        transl=PchipInterpolator(times, np.array([key[2] for key in keys], float))(np.minimum(at, times[-1])),
        fps=FPS,
    )


def wardrobe(mannequin: Mannequin) -> dict[str, Garment]:
    """Return the garments of the bench by name."""
    j, known = mannequin.joints, all_garments(mannequin)
    waist = j["spine1"][1] + 0.04
    calf = 0.45 * j["left_knee"][1] + 0.55 * j["left_ankle"][1]

    def skirt(name: str, top: float, hem: float, label: str = "lower", **cut: Any) -> Garment:
        return Garment(name, label, partial(hung, mannequin, top, hem, **cut), loose=True)

    more = (
        skirt("mid-calf skirt", waist, calf, legs=0.85, shins=0.4, flare=0.12),
        skirt("pleated skirt", waist, j["left_knee"][1] + 0.04, legs=0.8, shins=0.3, flare=0.15, pleats=(20, 0.05)),
        skirt("tie", j["neck"][1] - 0.07, j["spine1"][1], "outer", legs=0.0, shins=0.0, front=0.35, stand_off=0.006),
    )
    return {**known, **{garment.name: garment for garment in more}}


def dressed(mannequin: Mannequin, garment: Garment) -> Template:
    """Return the person in one garment as a template."""
    body, cloth = mannequin.body, garment.cloth
    own = body.forward(mannequin.params).vertices[0]
    count, more = len(own), len(cloth.vertices)
    label = LABELS.named(garment.label).id
    return Template(
        body=body,
        vertices=np.concatenate([own, cloth.vertices]),
        faces=np.concatenate([body.faces, cloth.faces + count]),
        vertex_labels=np.repeat([0, label], [count, more]),
        vertex_part=np.repeat([0, 1], [count, more]),
        part_names=("body", garment.label),
        vertex_colors=np.repeat(np.array([[205, 165, 140], [70, 95, 160]], dtype=np.uint8), [count, more], axis=0),
        weights=SkinWeights.from_dense(np.concatenate([body.weights, cloth.weights])),
        betas=mannequin.params.betas[0],
        body_index=np.concatenate([np.arange(count), np.zeros(more, int)]),
        scan_index=np.full(count + more, -1),
    )


@dataclass(frozen=True)
class Stress:
    """Simulate, measure, store."""

    garments: tuple[str, ...] = GARMENTS
    motions: tuple[str, ...] = tuple(MOTIONS)
    sheet: Path | None = None
    """A picture of every sixth frame of each row, for looking at; PNG."""
    store: bool = True
    _pictures: tyro.conf.Suppress[list[np.ndarray]] = field(default_factory=list, init=False)

    def run(self) -> None:
        """Print and store all rows."""
        body = load_body()
        mannequin = Mannequin.of(body, np.zeros(body.num_betas))
        known = wardrobe(mannequin)
        rows: dict[str, dict[str, dict[str, float]]] = {}
        garments = {name: self._cut(mannequin, known[name]) for name in self.garments}
        for name in self.motions:
            params = motion(body, MOTIONS[name], mannequin.params.betas[0])
            bodies: list[PosedBody] = []
            for garment, made in garments.items():
                if made is None:
                    continue
                template, cut = made
                bodies = bodies or [template.posed_body(params.frame(k)) for k in range(len(params))]
                figures = self._stepped(template, cut, params, bodies)
                rows.setdefault(garment, {})[name] = figures
                print(f"{garment:26s} {name:8s} {figures}", flush=True)
        summary = _summary(rows)
        print(summary)
        if self.sheet is not None:
            atomic_write_bytes(self.sheet, encode_png(np.concatenate(self._pictures)))
        if self.store:
            command = "python -m benchmarks cloth_stress"
            flat = {garment: _summary({garment: found}) for garment, found in rows.items()}
            print(f"stored {store_results('cloth_stress', command, {'all': summary, 'garments': flat}).name}")

    def _cut(self, mannequin: Mannequin, garment: Garment) -> tuple[Template, Simulated] | None:
        template = dressed(mannequin, garment)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", GeometryWarning)
                return template, cut_garment(template, garment.label, mannequin.params)
        except InputError as error:
            print(f"{garment.name}: {error}")
            return None

    def _stepped(
        self, template: Template, cut: Simulated, params: BodyParams, bodies: Sequence[PosedBody]
    ) -> dict[str, float]:
        driver = ClothDriver(template, [cut], DriverConfig(ramp=0.4, hold=0.2))
        weights, took, inside, beyond = template.weights.dense(), [], [], 0
        simulated = np.flatnonzero(np.isin(np.arange(template.vertex_count), cut.vertices[cut.share() > 0.5]))
        some = simulated[:: max(1, len(simulated) // 1500)]
        for k, posed in enumerate(bodies):
            begin, before = time.process_time(), driver.quality[0]
            driver.measure_anew()
            shape = driver.step(params.frame(k), 1.0 / FPS, posed=posed)
            took.append(time.process_time() - begin)
            beyond += driver.quality[0].longest > 1.25 or driver.quality[0].resets > 0
            driver.quality[0] = before.with_(driver.quality[0]) if k else driver.quality[0]
            if k % 6:
                continue
            rest = template.vertices.copy()
            rest[shape.vertices] += shape.share[:, None] * shape.displacements
            blended = (weights @ posed.posed_from_rest[0, :, :3].reshape(-1, 12)).reshape(-1, 3, 4)
            surface = np.einsum("vij,vj->vi", blended[:, :, :3], rest) + blended[:, :, 3]
            skin = TriangleMesh(surface[: template.body.vertex_count], template.body.faces)
            inside.append(-SignedDistanceField(skin, solid=True).query(surface[some]).distance)
            if self.sheet is not None:
                self._draw(template, surface, first=k == 0)
        found, depth = driver.quality[0], np.concatenate(inside)
        return {
            "beyond": int(beyond),
            "resets": found.resets,
            "longest": round(min(found.longest, 99.0), 2),
            "drawn": round(min(found.drawn, 99.0), 2),
            "inside": round(100.0 * float((depth > 0.003).mean()), 2),
            "deep": round(1e3 * max(float(np.quantile(depth, 0.99)), 0.0), 1),
            "released": found.released,
            "ms": round(1e3 * float(np.median(took[1:])), 2),
        }

    def _draw(self, template: Template, surface: Float[np.ndarray, "V 3"], *, first: bool) -> None:
        mesh = template.mesh.with_vertices(surface)
        (camera,) = fit_cameras(surface, directions=[(0.6, 0.15, 1.0)], height=300, width=220)
        image = render_shaded(mesh, camera, vertex_colors=template.vertex_colors)
        if first:
            self._pictures.append(image)
        else:
            self._pictures[-1] = np.concatenate([self._pictures[-1], image], axis=1)


def _summary(rows: Mapping[str, Mapping[str, Mapping[str, float]]]) -> dict[str, float]:
    every = [figures for found in rows.values() for figures in found.values()]
    total = {name: sum(int(one[name]) for one in every) for name in ("beyond", "resets", "released")}
    worst = {name: max(one[name] for one in every) for name in ("longest", "drawn")}
    means = {name: round(float(np.mean([one[name] for one in every])), 2) for name in ("inside", "deep", "ms")}
    return {"cases": len(every), **total, **worst, **means}


if __name__ == "__main__":
    tyro.cli(Stress, prog="python -m benchmarks cloth_stress").run()
