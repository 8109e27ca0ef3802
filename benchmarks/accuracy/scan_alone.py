"""Measure bodies found in bare scans against the truth, and the labels that follow from them.

    python -m benchmarks scan_alone [--people 12] [--who NAME ...] [--seed 0] [--things KIND ...]
        [--variants "as it is" "3 mm noise"]

Scans are the fixture's, the captures' that are there, and procedural people (`synth.people`); each is read as a
file without parameters, labels, units and axis would be, and gone through as `smplxpp build --scan` does. With --things
two of the people hold or wear them (`smplxpp.people.things`). The truth is looked at in measuring alone. Wrong facing:
the pelvis' front more than 90 degrees off. Labels are those of `label_by_body`, on faces that the scanner saw.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import tyro

from benchmarks.support.people import captured, captured_names
from benchmarks.support.results import store_results
from smplxpp.body import BodyModel, load_body
from smplxpp.build.locate import certain_labels
from smplxpp.clean import convert_points, find_scan_frame
from smplxpp.core import OBJECT, BodyParams, InputError
from smplxpp.people import CAST, VARIANTS, PersonScan, people, person, variant
from smplxpp.people.making import make_person
from smplxpp.people.scan_simulation import ScanConfig
from smplxpp.people.things import THINGS, WORN, Thing
from smplxpp.register.locate import locate_body
from smplxpp.segment import label_by_body

BODY_JOINTS = 22
COMMAND = "python -m benchmarks scan_alone"
_BEARERS = ("woman T-shirt jeans bob, A", "heavy man T-shirt shorts bald, T")
_SCAN = ScanConfig(cell=0.008, views=26, resolution=512, faces=25000)
_FINE = ScanConfig(cell=0.005, views=26, resolution=768, faces=70000)
"""Scans of what is worn on the face: in cells of 8 mm a bridge of 8 mm is lost, and with it one of two lenses."""


@dataclass(frozen=True)
class ScanAlone:
    """Find bodies in scans and measure them; the worst first."""

    people: int = 12
    """Number of procedural people; 0: none."""
    who: tuple[str, ...] = ()
    """These of them by name (`smplxpp.people.cast`), in place of the first ones."""
    outsiders: bool = False
    """The people whose surface the body model cannot reach, in place of the first ones of the cast."""
    things: tuple[str, ...] = ()
    """Kinds of things that two people of the cast hold or wear, or "all", in place of the first ones."""
    seed: int = 0
    """Seed of the procedural people."""
    captured: bool = True
    """The fixture's scan and those of captures, too."""
    variants: tuple[str, ...] = ("as it is",)
    """Changes of the scans: names of `smplxpp.people.VARIANTS`, or "all"."""
    labels: bool = True
    """Label the scans with the body that was found, too."""
    store: bool = True
    """Write benchmarks/results/scan_alone.json."""
    name: str = "scan_alone"
    """Name of the result."""

    def run(self) -> None:
        """Print and store the figures."""
        body, rows = load_body(), []
        for scan in self._scans():
            rows.append(measured(scan, body, labels=self.labels))
            print(line(rows[-1]), flush=True)
        rows.sort(key=lambda row: -float(row.get("body_mm", np.inf)))
        print("\nworst first:", *map(line, rows), sep="\n")
        figures = {"rows": rows, "summary": summary(rows)}
        print(figures["summary"])
        if self.store:
            print(f"stored {store_results(self.name, COMMAND, figures).name}")

    def _scans(self) -> Iterator[PersonScan]:
        names = tuple(VARIANTS) if "all" in self.variants else self.variants
        if self.things:
            for kind in (*THINGS, *WORN) if "all" in self.things else self.things:
                for who, side in zip(_BEARERS, ("left", "right"), strict=True):
                    thing = Thing(kind, side, (90, 50, 20))
                    scan = _FINE if kind in ("glasses", "sunglasses", "goggles") else _SCAN
                    made = make_person(who, CAST[who], load_body(), seed=self.seed, scan=scan, thing=thing)
                    yield from (variant(replace(made, name=f"{who}: {kind}"), one) for one in names)
            return
        if self.captured:
            for name in captured_names():
                yield from (variant(captured(name), one) for one in names)
        named = (person(name, seed=self.seed) for name in self.who)
        for scan in named if self.who else people(count=self.people, seed=self.seed, outsiders=self.outsiders):
            yield from (variant(scan, one) for one in names)


def measured(scan: PersonScan, body: BodyModel, *, labels: bool) -> dict[str, float | str | bool | list[str]]:
    """Errors of one scan: millimetres, degrees, shares."""
    begin = time.process_time()
    try:
        frame = find_scan_frame(scan.mesh.vertices, scan.mesh.faces)
        mesh = scan.mesh.with_vertices(convert_points(scan.mesh.vertices, units=frame.units, up=frame.up))
        # Nothing is given: units, axis, body and labels are found as `smplxpp build --scan` alone does.
        labeller = partial(certain_labels, mesh, body, scan.colors)
        found = locate_body(body, mesh, colors=scan.colors, labeller=labeller)
    except InputError as error:
        return {"scan": scan.name, "refused": str(error)}
    seconds = time.process_time() - begin
    posed = body.forward(found.params)
    # The same joint and the same vertex in both bodies, in millimetres.
    joints = 1e3 * np.linalg.norm(posed.joints[0] - scan.joints, axis=1)[:BODY_JOINTS]
    row: dict[str, float | str | bool | list[str]] = {
        "scan": scan.name,
        "frame_found": (frame.units, frame.up) == (scan.units, scan.up),
        "body_mm": 1e3 * float(np.linalg.norm(posed.vertices[0] - scan.body_vertices, axis=1).mean()),
        "joints_mm": float(joints.mean()),
        "worst_joint_mm": float(joints.max()),
        "facing_degrees": _facing_off(body, found.params, scan.params),
        "confidence": found.confidence,
        "problems": list(found.notes),
        "cpu_seconds": seconds,
    }
    if labels:
        labelled = label_by_body(mesh, body, found.params, colors=scan.colors)
        row["labels_right"] = float((labelled.face_labels == scan.face_labels)[scan.seen].mean())
        true, own = (labels == OBJECT.id for labels in (scan.face_labels, labelled.face_labels))
        if true.any():
            # Intersection over union of the thing's area.
            row["thing_iou"] = float(mesh.face_areas[true & own].sum() / mesh.face_areas[true | own].sum())
    return row


def summary(rows: list[dict[str, float | str | bool | list[str]]]) -> dict[str, float]:
    """Over all scans that were not refused."""
    kept = [row for row in rows if "refused" not in row]
    body, joints, facing = (np.array([row[k] for row in kept]) for k in ("body_mm", "joints_mm", "facing_degrees"))
    if not kept:
        return {"scans": float(len(rows)), "refused": float(len(rows))}
    # A thing is found where what is labelled object covers it by half, intersection over union.
    found = {
        what: [float(row["thing_iou"]) >= 0.5 for row in kept if "thing_iou" in row and _kind(row) in kinds]
        for what, kinds in (("held", THINGS), ("worn", WORN))
    }
    things = {what: one for what, one in found.items() if one}
    return {
        **{f"{what}_things": float(len(one)) for what, one in things.items()},
        **{f"{what}_things_found": float(sum(one)) for what, one in things.items()},
        "scans": float(len(rows)),
        "refused": float(len(rows) - len(kept)),
        "body_mm_median": float(np.median(body)),
        "body_mm_worst": float(body.max()),
        "body_within_15_mm": float((body <= 15.0).mean()),
        "joints_mm_median": float(np.median(joints)),
        "joints_mm_worst": float(joints.max()),
        "joints_within_12_mm": float((joints <= 12.0).mean()),
        "wrong_facing": float((facing > 90.0).sum()),
        "wrong_frame": float(sum(not row["frame_found"] for row in kept)),
    }


def _kind(row: dict[str, float | str | bool | list[str]]) -> str:
    """The kind of the thing that the person of a row holds or wears."""
    return str(row["scan"]).split(" | ")[0].rpartition(": ")[2]


def line(row: dict[str, float | str | bool | list[str]]) -> str:
    """A row in words."""
    if "refused" in row:
        return f"{row['scan']}: REFUSED {row['refused']}"
    shown = f"body {row['body_mm']:.1f} mm, joints {row['joints_mm']:.1f} (worst {row['worst_joint_mm']:.0f}) mm, "
    shown += f"facing {row['facing_degrees']:.0f} degrees off, "
    shown += f"{'' if row['frame_found'] else 'WRONG UNITS OR AXIS, '}confidence {row['confidence']:.2f}, "
    shown += f"labels {row['labels_right']:.1%}, " if "labels_right" in row else ""
    shown += f"thing {row['thing_iou']:.2f}, " if "thing_iou" in row else ""
    return f"{row['scan']}: {shown}{row['cpu_seconds']:.0f} s" + "".join(f"; {p}" for p in row["problems"])


def _facing_off(body: BodyModel, found: BodyParams, true: BodyParams) -> float:
    """Angle between the pelvis' fronts as seen from above, degrees."""
    one, other = (body.joint_rotations(params)[0, 0][[0, 2], 2] for params in (found, true))
    cosine = one @ other / (np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


if __name__ == "__main__":
    tyro.cli(ScanAlone).run()
