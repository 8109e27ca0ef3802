"""Simulate procedural garments in rough motion: breakdowns, stretch, penetration, milliseconds a step.

    python -m benchmarks cloth_stress [--garments "long skirt"] [--motions kneel] [--sheet worst.png] [--no-store]
        [--keep DIR] [--blender PYTHON]

17 garments and hairstyles are made by procedure on the open body in the T-pose, cut as a run cuts its loose parts, and
stepped through 10 motions of 1.5 s at 30 frames a second, from a cold start each. None of it was fitted to a person.
The coat is sewn of one piece and worn over the long skirt, both simulated.

- *beyond*: frames in which an edge of the simulated mesh is longer than 1.25 times its length at rest; *resets*:
  how often the simulation began again on the body; *longest*, *drawn*: the longest edge of any frame, simulated and
  drawn, over its length at rest.
- *inside*: drawn vertices that the simulation moves and that are more than 3 mm inside of the whole body, the mean of
  every sixth frame, and the deepest of the 99 % that are least deep, mm; the collider is coarser than this body.
- *shows*: skin that comes through drawn cloth, which no vertex of the cloth need tell: vertices of the body 0.5 to 8 mm
  before cloth that faces as they do, % of those within 30 mm of such cloth, the mean of every sixth frame.
- *through*: of garments over another one, free particles of the outer one that are 2 mm to 10 cm behind the simulated
  surface of the inner one, %, the mean of all frames; those nearest to its border do not count.
- *ms*: CPU milliseconds a step, the median, with the measuring.

`--blender` simulates the same particles, pins and body in Blender, too, by its cloth as it comes (cotton, quality 5,
collisions 2, at 6 mm), over the same ramp. *own* and *blender* are of the free particles, over lengths along the cloth;
*blender_s*: its CPU seconds a frame. It is under the GPL: it runs in a process of its own, and nothing here needs it.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
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
from smplxpp.body import BodyModel, load_body
from smplxpp.body.model import PosedBody
from smplxpp.cloth import ClothDriver, ClothShape, DriverConfig, cut_garment
from smplxpp.cloth import Garment as Simulated
from smplxpp.cloth.poses import pose_between, reference_facing_as
from smplxpp.cloth.quality import EdgeLengths
from smplxpp.core import LABELS, BodyParams, GeometryWarning, InputError, SkinWeights, TriangleMesh
from smplxpp.core.files import atomic_write_bytes, atomic_write_text
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.export.fbx import blender_command
from smplxpp.figures import encode_png, fit_cameras
from smplxpp.people.garments.cut import Garment
from smplxpp.people.garments.loose import hung, sewn_coat
from smplxpp.people.garments.mannequin import Mannequin
from smplxpp.people.garments.wardrobe import all_garments
from smplxpp.raster import render_shaded
from smplxpp.template.template import Template

FPS, SECONDS = 30.0, 1.5
SEEN_FROM = (0.6, 0.15, 1.0)
"""Direction from the person to the camera of all pictures."""
START = DriverConfig(ramp=0.4, hold=0.2)
_BLENDER = """
import struct, sys, time, bpy, numpy as np
path = sys.argv[-1]
given, scene = np.load(path), bpy.context.scene
frames = len(given["body"])
scene.render.fps, scene.gravity = int(given["fps"]), (0.0, -9.81, 0.0)
scene.frame_start, scene.frame_end = 1, frames
def moving(name):
    points = given[name].astype("<f4")
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata(points[0].tolist(), [], given[name + "_faces"].tolist())
    thing = bpy.data.objects.new(name, mesh)
    scene.collection.objects.link(thing)
    with open(path + name + ".pc2", "wb") as file:
        file.write(struct.pack("<12siiffi", b"POINTCACHE2", 1, points.shape[1], 1.0, 1.0, frames) + points.tobytes())
    cache = thing.modifiers.new("cache", "MESH_CACHE")
    cache.cache_format, cache.filepath, cache.frame_start = "PC2", path + name + ".pc2", 1.0
    return thing
body, cloth = moving("body"), moving("cloth")
body.modifiers.new("collision", "COLLISION")
body.collision.thickness_outer = 0.001
cloth.vertex_groups.new(name="pins").add(given["pinned"].tolist(), 1.0, "REPLACE")
made = cloth.modifiers.new("cloth", "CLOTH")
made.settings.vertex_group_mass, made.collision_settings.distance_min = "pins", 0.006
made.point_cache.frame_start, made.point_cache.frame_end = 1, frames
found, began = np.empty((frames, given["cloth"].shape[1], 3), np.float32), time.process_time()
for k in range(frames):
    scene.frame_set(k + 1)
    shape = cloth.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    shape.vertices.foreach_get("co", found[k].reshape(-1))
np.savez(path, cloth=found, seconds=(time.process_time() - began) / frames)
"""
GARMENTS = (
    *("mini skirt", "knee skirt", "mid-calf skirt", "long skirt", "flared skirt", "full circle skirt"),
    *("pleated skirt", "dress", "coat over long skirt", "cape", "wide trousers, hem 24 cm", "hakama", "wide sleeves"),
    *("scarf", "tie", "long loose hair", "ponytail"),
)
UNDER = {"coat over long skirt": "long skirt"}
"""What garments are worn over."""
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

SWING_AND_SIT: tuple[_Key, ...] = (
    *((0.45 * k, {} if not k else (_STRIDE, _BACK)[k % 2], (0, 0, 0)) for k in range(5)),
    *((1.9 + 0.4 * k, {"pelvis": (0, 65.0 * (-1) ** k, 0)}, (0, 0, 0)) for k in range(1, 4)),
    *((3.4, {}, (0, 0, 0)), (4.4, {}, (0, 0, 0)), (5.3, _SIT, (0, -0.4, -0.2)), (7.0, _SIT, (0, -0.4, -0.2))),
)
"""Walks, turns about, stands still and sits down: the motion of `cloth_film`."""


def motion(
    body: BodyModel, keys: Sequence[_Key], betas: Float[np.ndarray, " B"], seconds: float = SECONDS
) -> BodyParams:
    """Return a motion through key poses, monotone between them: seconds, turns over lowered arms, metres."""
    pose = np.zeros((len(keys), body.joint_count, 3))
    for k, (_, turns, _) in enumerate(keys):
        for name, degrees in {**_DOWN, **turns}.items():
            pose[k, body.joint_names.index(name)] = np.radians(degrees)
    times, at = [key[0] for key in keys], np.arange(round(seconds * FPS) + 1) / FPS
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
    coat = Garment(
        "coat over long skirt",
        "outer",
        lambda: sewn_coat(mannequin, known[UNDER["coat over long skirt"]].cloth),
        loose=True,
    )
    return {**known, **{garment.name: garment for garment in (*more, coat)}}


def dressed(mannequin: Mannequin, *garments: Garment) -> Template:
    """Return the person in garments as a template, the innermost one first."""
    body, cloths = mannequin.body, [garment.cloth for garment in garments]
    own = body.forward(mannequin.params).vertices[0]
    counts = [len(own), *(len(cloth.vertices) for cloth in cloths)]
    first = np.cumsum(counts)
    colors = np.array([[205, 165, 140], [70, 95, 160], [165, 80, 80]], dtype=np.uint8)
    return Template(
        body=body,
        vertices=np.concatenate([own, *(cloth.vertices for cloth in cloths)]),
        faces=np.concatenate([body.faces, *(cloth.faces + k for cloth, k in zip(cloths, first, strict=False))]),
        vertex_labels=np.repeat([0, *(LABELS.named(garment.label).id for garment in garments)], counts),
        vertex_part=np.repeat(np.arange(len(counts)), counts),
        part_names=("body", *(garment.label for garment in garments)),
        vertex_colors=np.repeat(colors[: len(counts)], counts, axis=0),
        weights=SkinWeights.from_dense(np.concatenate([body.weights, *(cloth.weights for cloth in cloths)])),
        betas=mannequin.params.betas[0],
        body_index=np.where(np.arange(first[-1]) < len(own), np.arange(first[-1]), 0),
        scan_index=np.full(first[-1], -1),
    )


@dataclass(frozen=True)
class Stress:
    """Simulate, measure, store."""

    garments: tuple[str, ...] = GARMENTS
    motions: tuple[str, ...] = tuple(MOTIONS)
    sheet: Path | None = None
    """A picture of every sixth frame of each row, for looking at; PNG."""
    store: bool = True
    keep: Path | None = None
    """Folder of finished cases, a file each: what lies there is not run again, so that a bench may run in pieces."""
    blender: str | None = None
    """Blender, or a Python with bpy, to hold each case against."""
    _pictures: tyro.conf.Suppress[list[np.ndarray]] = field(default_factory=list, init=False)

    def run(self) -> None:
        """Print and store all rows."""
        body = load_body()
        mannequin = Mannequin.of(body, np.zeros(body.num_betas))
        known = wardrobe(mannequin)
        rows: dict[str, dict[str, dict[str, float]]] = {}
        cuts: dict[str, tuple[Template, list[Simulated]] | None] = {}
        for name in self.motions:
            params = motion(body, MOTIONS[name], mannequin.params.betas[0])
            bodies: list[PosedBody] = []
            for garment in self.garments:
                kept = self.keep / f"{garment}-{name}.json".replace(" ", "_").replace(",", "") if self.keep else None
                if kept is not None and kept.exists():
                    rows.setdefault(garment, {})[name] = json.loads(kept.read_text())
                    continue
                if garment not in cuts:
                    worn = [known[name] for name in (UNDER.get(garment), garment) if name]
                    cuts[garment] = self._cut(mannequin, worn)
                if (made := cuts[garment]) is None:
                    continue
                template, cut = made
                bodies = bodies or [template.posed_body(params.frame(k)) for k in range(len(params))]
                figures, ours = self._stepped(template, cut, params, bodies)
                if self.blender is not None and len(cut) == 1:
                    figures |= self._peer(template, cut[0], params, ours)
                rows.setdefault(garment, {})[name] = figures
                if kept is not None:
                    atomic_write_text(kept, json.dumps(figures))
                print(f"{garment:26s} {name:8s} {figures}", flush=True)
        summary = _summary(rows)
        print(summary)
        if self.sheet is not None and self._pictures:
            atomic_write_bytes(self.sheet, encode_png(np.concatenate(self._pictures)))
        if self.store:
            name = "cloth_stress_blender" if self.blender else "cloth_stress"
            command = "python -m benchmarks cloth_stress" + " --blender PYTHON" * bool(self.blender)
            by_motion = {m: _summary({g: {m: found[m]} for g, found in rows.items()}) for m in self.motions}
            flat = {garment: _summary({garment: found}) for garment, found in rows.items()}
            stored: dict[str, object] = {"all": summary, "motions": by_motion, "garments": flat}
            print(f"stored {store_results(name, command, stored).name}")

    def _cut(self, mannequin: Mannequin, worn: Sequence[Garment]) -> tuple[Template, list[Simulated]] | None:
        template = dressed(mannequin, *worn)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", GeometryWarning)
                return template, [cut_garment(template, one.label, mannequin.params) for one in worn]
        except InputError as error:
            print(f"{worn[-1].name}: {error}")
            return None

    def _stepped(
        self, template: Template, cuts: Sequence[Simulated], params: BodyParams, bodies: Sequence[PosedBody]
    ) -> tuple[dict[str, float], list[Float[np.ndarray, "n 3"]]]:
        """What was measured, and where the particles of the outermost garment were."""
        driver, outer = ClothDriver(template, cuts, START), cuts[-1]
        weights, took, inside, particles, beyond = template.weights.dense(), [], [], [], 0
        shows: list[float] = []
        simulated = np.sort(np.concatenate([cut.vertices[cut.share() > 0.5] for cut in cuts]))
        through: list[float] = []
        some = simulated[:: max(1, len(simulated) // 1500)]
        for k, posed in enumerate(bodies):
            begin, before = time.process_time(), driver.quality
            driver.measure_anew()
            shape = driver.step(params.frame(k), 1.0 / FPS, posed=posed)
            took.append(time.process_time() - begin)
            particles.append(driver.particles(outer.part).astype(float))
            for inner in cuts[:-1]:
                sheet = TriangleMesh(driver.particles(inner.part).astype(float), inner.rest.faces)
                where = SignedDistanceField(sheet, solid=False).query(particles[-1][~outer.pinned])
                # Arms far from a skirt lie on the back of one fold or another.
                behind = (where.distance < -0.002) & (where.distance > -0.1)
                through.append(float((behind & ~where.on_border).mean()))
            beyond += any(one.longest > 1.25 or one.resets > 0 for one in driver.quality)
            if k:
                driver.quality = [a.with_(b) for a, b in zip(before, driver.quality, strict=True)]
            if k % 6:
                continue
            surface = drawn_surface(template, weights, posed, shape)
            skin = TriangleMesh(surface[: template.body.vertex_count], template.body.faces)
            inside.append(-SignedDistanceField(skin, solid=True).query(surface[some]).distance)
            shows.append(
                _shown(skin, TriangleMesh(surface, template.faces[template.faces[:, 0] >= len(skin.vertices)]))
            )
            if self.sheet is not None:
                self._draw(template, surface, first=k == 0)
        found, depth = driver.quality, np.concatenate(inside)
        figures = {
            "beyond": int(beyond),
            "resets": sum(one.resets for one in found),
            "longest": round(min(max(one.longest for one in found), 99.0), 2),
            "drawn": round(min(max(one.drawn for one in found), 99.0), 2),
            "inside": round(100.0 * float((depth > 0.003).mean()), 2),
            "deep": round(1e3 * max(float(np.quantile(depth, 0.99)), 0.0), 1),
            "shows": round(100.0 * float(np.mean(shows)), 3),
            "released": sum(one.released for one in found),
            "ms": round(1e3 * float(np.median(took[1:])), 2),
        } | ({"through": round(100.0 * float(np.mean(through)), 2)} if through else {})
        return figures, particles

    def _peer(
        self, template: Template, cut: Simulated, params: BodyParams, ours: Sequence[Float[np.ndarray, "n 3"]]
    ) -> dict[str, float]:
        """What both have of the free particles, over the same ramp from the pose at rest."""
        first, ramp, still = params.frame(0), round(START.ramp * FPS), round(START.hold * FPS)
        start = reference_facing_as(cut.reference, first)
        way = [pose_between(start, first, (t := k / ramp) * t * (3.0 - 2.0 * t)) for k in range(1, ramp)]
        lead = [start, start, *way, *[first] * (still + 1)]
        poses = [*lead, *(params.frame(k) for k in range(1, len(params)))]
        surfaces = np.array([template.pose(one)[0] for one in poses], np.float32)
        bodies = surfaces[:, : template.body.vertex_count]
        with tempfile.TemporaryDirectory() as folder:
            script, path = Path(folder) / "peer.py", Path(folder) / "case.npz"
            script.write_text(_BLENDER)
            np.savez(
                path,
                **{"body": bodies, "body_faces": template.body.faces, "pinned": np.flatnonzero(cut.pinned)},
                **{"cloth": surfaces[:, cut.particles], "cloth_faces": cut.rest.faces, "fps": np.array(FPS)},
            )
            subprocess.run([*blender_command(self.blender), str(script), str(path)], check=True, capture_output=True)
            with np.load(path) as found:
                theirs, seconds = found["cloth"][len(lead) - 1 :], float(found["seconds"])
        free, out = ~cut.pinned, {"blender_s": round(seconds, 4)}
        lengths = EdgeLengths(cut.model().edges, cut.model().lengths, 0.0)
        skins = [TriangleMesh(body.astype(float), template.body.faces) for body in bodies[len(lead) - 1 :: 6]]
        solids = [SignedDistanceField(skin, solid=True) for skin in skins]
        for name, run in (("own", ours), ("blender", theirs.astype(float))):
            depth = -np.concatenate([solid.query(run[6 * k][free]).distance for k, solid in enumerate(solids)])
            out[f"{name}_longest"] = round(max(lengths.longest(x.astype(np.float32)) for x in run), 2)
            out[f"{name}_inside"] = round(100.0 * float((depth > 0.003).mean()), 2)
            out[f"{name}_deep"] = round(1e3 * max(float(np.quantile(depth, 0.99)), 0.0), 1)
        return out

    def _draw(self, template: Template, surface: Float[np.ndarray, "V 3"], *, first: bool) -> None:
        mesh = template.mesh.with_vertices(surface)
        (camera,) = fit_cameras(surface, directions=[SEEN_FROM], height=300, width=220)
        image = render_shaded(mesh, camera, vertex_colors=template.vertex_colors)
        if first:
            self._pictures.append(image)
        else:
            self._pictures[-1] = np.concatenate([self._pictures[-1], image], axis=1)


def drawn_surface(
    template: Template, weights: Float[np.ndarray, "V J"], posed: PosedBody, shape: ClothShape
) -> Float[np.ndarray, "V 3"]:
    """Return the posed vertices of a template whose simulated clothes are displaced before skinning."""
    rest = template.vertices.copy()
    rest[shape.vertices] += shape.share[:, None] * shape.displacements
    blended = (weights @ posed.posed_from_rest[0, :, :3].reshape(-1, 12)).reshape(-1, 3, 4)
    return np.einsum("vij,vj->vi", blended[:, :, :3], rest) + blended[:, :, 3]


def _shown(skin: TriangleMesh, cloth: TriangleMesh) -> float:
    """Return the share of the skin under drawn cloth that comes through it."""
    near = SignedDistanceField(cloth, solid=False).query(skin.vertices)
    along = np.einsum("ij,ij->i", near.normal, skin.vertex_normals)
    # Skin of another limb that is far before the cloth is beside it, and has not come through.
    under = (near.distance > -0.03) & (near.distance < 0.008) & ~near.on_border & (along > 0.3)
    return float((near.distance[under] > 0.0005).mean()) if under.any() else 0.0


def _summary(rows: Mapping[str, Mapping[str, Mapping[str, float]]]) -> dict[str, float]:
    every = [figures for found in rows.values() for figures in found.values()]
    out: dict[str, float] = {"cases": len(every)}
    # Some figures are of some garments alone.
    for name in dict.fromkeys(name for one in every for name in one):
        values = [one[name] for one in every if name in one]
        if name in ("beyond", "resets", "released"):
            out[name] = int(sum(values))
        elif name.endswith(("longest", "drawn")):
            out[name] = max(values)
        else:
            out[name] = round(float(np.mean(values)), {"blender_s": 4, "shows": 3}.get(name, 2))
    return out


if __name__ == "__main__":
    tyro.cli(Stress, prog="python -m benchmarks cloth_stress").run()
