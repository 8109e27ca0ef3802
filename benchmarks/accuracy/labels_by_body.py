"""Measure `label_by_body` on scans of known people: accuracy, and the calibration of its confidence.

    SMPLXPP_PEOPLE=DIR python -m benchmarks labels_by_body [--count 36] [--seed 0] [--only NAME] [--outsiders]
        [--faces 16000] [--draws 1] [--cases "a fit" ...]

The cast of `synth.people`, the fixture, and the captures where they are; or with --outsiders the people whose surface
the body model cannot reach. Accuracy is of the seen faces, by area
and by number. The body is
  a fit   every joint turned by 1.5 to 3 degrees about each axis, betas off by 0.3 to 0.5 (stature kept), placed rigidly
          as a fit would place it and then moved by 8 to 15 mm: 13 to 45 mm of mean vertex error; two draws a person
  exact   the truth's; of an outsider the model's nearest shape
and the scan is as it is, or half in shadow (a fit, the left half in 35 % of the light), or as photographs give it (a
fit, colours blurred over 6 rings of vertices, 3 mm of smooth noise), or without colours (a fit, exact). Faces are sure
whose confidence is that of a label for fits, `UNSURE`. `--faces` simplifies every scan first, `--draws` and `--cases`
leave out fits and cases, where time is short.
"""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.support.people import captured, captured_names
from benchmarks.support.results import store_results
from smplxpp.body import BodyModel, load_body
from smplxpp.clean import simplify
from smplxpp.core import LABELS, BodyParams, TriangleMesh, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.colors import linear_from_srgb, srgb_from_linear
from smplxpp.people import CAST, OUTSIDERS, PersonScan, person
from smplxpp.people.outside import reachable
from smplxpp.people.textures import smooth_noise
from smplxpp.segment import label_by_body
from smplxpp.segment.by_body_confidence import UNSURE
from smplxpp.synth.tracker import tracker_noise

BINS = (0.0, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 1.0)
_RINGS, _NOISE = 6, 0.003


def as_fitted(body: BodyModel, params: BodyParams, seed: int) -> BodyParams:
    """Parameters of one frame with the errors of a fit to a scan; see the module."""
    rng = np.random.default_rng([7, seed])
    count = params.betas.shape[1]
    top, low = body.v_template[:, 1].argmax(), body.v_template[:, 1].argmin()
    taller = body.shapedirs[top, 1, :count] - body.shapedirs[low, 1, :count]
    shape = rng.normal(0, rng.uniform(0.3, 0.5), count)
    shape -= taller * (taller @ shape) / (taller @ taller)
    wrong = tracker_noise(params, seed=seed, degrees=rng.uniform(1.5, 3.0), transl=1e-9, betas=1e-9)
    wrong = replace(wrong, betas=params.betas + shape)
    true, off = body.forward(params).vertices[0], body.forward(wrong).vertices[0]
    u, _, vt = np.linalg.svd((true - true.mean(0)).T @ (off - off.mean(0)))
    turn = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    wrong = replace(wrong, global_orient=rotvec_from_matrix(turn @ matrix_from_rotvec(wrong.global_orient)))
    moved = rng.normal(size=3)
    moved *= rng.uniform(0.008, 0.015) / np.linalg.norm(moved)
    back = true.mean(0) - body.forward(wrong).vertices[0].mean(0)
    return replace(wrong, transl=wrong.transl + back + moved)


def as_photographed(scan: PersonScan, seed: int) -> tuple[TriangleMesh, np.ndarray]:
    """The scan as a reconstruction from photographs has it: noisy, its colours blurred."""
    mesh = scan.mesh
    assert scan.colors is not None
    noise = smooth_noise(mesh.vertices, scale=(0.01, 0.01, 0.01), seed=seed)
    noise *= _NOISE / np.sqrt(np.mean(noise**2))
    colors = scan.colors.astype(np.float64)
    edges = mesh.edges
    count = 1 + np.bincount(edges.ravel(), minlength=mesh.vertex_count)
    for _ in range(_RINGS):
        around = [np.bincount(edges.ravel(), c[edges[:, ::-1]].ravel(), minlength=len(c)) for c in colors.T]
        colors = (colors + np.stack(around, axis=1)) / count[:, None]
    moved = mesh.with_vertices(mesh.vertices + noise[:, None] * mesh.vertex_normals)
    return moved, np.clip(np.rint(colors), 0, 255).astype(np.uint8)


def half_in_shadow(scan: PersonScan, body: BodyModel, params: BodyParams) -> np.ndarray:
    """The colours in a shadow over the left half of the body, whose border is 2 cm wide."""
    assert scan.colors is not None
    joints = body.forward(params).joints[0]
    left, right = (joints[body.joint_names.index(f"{side}_hip")] for side in ("left", "right"))
    across = (left - right) * [1.0, 0.0, 1.0]
    along = (scan.mesh.vertices - (left + right) / 2) @ (across / np.linalg.norm(across))
    light = 1.0 - 0.65 / (1.0 + np.exp(-np.clip(along / 0.005, -50, 50)))
    return srgb_from_linear(linear_from_srgb(scan.colors) * light[:, None])


def simplified(scan: PersonScan, faces: int | None) -> PersonScan:
    """Return a scan with about so many faces, whose truth is that of the nearest faces before."""
    if faces is None or scan.mesh.face_count <= faces:
        return scan
    kept = simplify(scan.mesh, faces)
    nearest = cKDTree(scan.mesh.face_centers).query(kept.mesh.face_centers)[1]
    colors = None if scan.colors is None else scan.colors[kept.source_vertex]
    return replace(scan, mesh=kept.mesh, colors=colors, face_labels=scan.face_labels[nearest], seen=scan.seen[nearest])


def measure(scan: PersonScan, body: BodyModel, seed: int, *, draws: int = 2, cases: Sequence[str] = ()) -> list[dict]:
    """One row a case; all of them where `cases` is empty."""
    nearest = reachable(body, scan.body, scan.params)
    fits = [as_fitted(body, nearest, 2 * seed + k) for k in range(1, draws + 1)]
    rows = []

    def add(case: str, mesh: TriangleMesh, params: BodyParams, colors: np.ndarray | None) -> None:
        if cases and case not in cases:
            return
        start = time.perf_counter()
        found = label_by_body(mesh, body, params, colors=colors)
        seconds = time.perf_counter() - start
        # Faces count by area, without those of bridges and filled holes, which no scanner saw.
        area = mesh.face_areas * scan.seen
        right = found.face_labels == scan.face_labels
        wrong = np.zeros((len(LABELS), len(LABELS)))
        np.add.at(wrong, (scan.face_labels, found.face_labels), area / area.sum())
        # Calibration: within a bin of confidence the share of right area should equal the confidence.
        bins = np.digitize(found.confidence, BINS[1:-1])
        rows.append(
            {
                "case": case,
                "person": scan.name,
                "accuracy": float(area @ right / area.sum()),
                "accuracy_faces": float(right[scan.seen].mean()),
                "worst": _worst(wrong),
                "notes": list(found.notes),
                "unsure": float(area[found.confidence < UNSURE].sum() / area.sum()),
                "sure_and_wrong": float(area[(found.confidence >= UNSURE) & ~right].sum() / area.sum()),
                "bin_area": np.bincount(bins, area / area.sum(), minlength=len(BINS) - 1).round(6).tolist(),
                "bin_right": np.bincount(bins, area * right / area.sum(), minlength=len(BINS) - 1).round(6).tolist(),
                "seconds": seconds,
            }
        )

    if scan.colors is not None:
        for fit in fits:
            add("a fit", scan.mesh, fit, scan.colors)
        add("half in shadow, a fit", scan.mesh, fits[0], half_in_shadow(scan, body, nearest))
        add("exact", scan.mesh, nearest, scan.colors)
        mesh, colors = as_photographed(scan, seed)
        add("photographs, a fit", mesh, fits[0], colors)
    add("without colours, a fit", scan.mesh, fits[0], None)
    add("without colours, exact", scan.mesh, nearest, None)
    return rows


def _worst(wrong: np.ndarray) -> str:
    """The two most frequent confusions above 1 % of the area."""
    names = [label.name for label in LABELS]
    np.fill_diagonal(wrong, 0.0)
    order = np.argsort(-wrong, axis=None)[:2]
    pairs = [np.unravel_index(k, wrong.shape) for k in order if wrong.flat[k] > 0.01]
    return ", ".join(f"{names[i]} as {names[j]} {wrong[i, j]:.1%}" for i, j in pairs)


def _worst_by_confidence(rows: list[dict]) -> list[dict]:
    """Of every bin of confidence the scan with the lowest rate of right faces, that rate, and the share of scans whose
    rate is below the bin's lower edge; scans with less than 2 % of their area in it do not count.
    """
    out = []
    for k in range(len(BINS) - 1):
        rates = [(r["bin_right"][k] / r["bin_area"][k], r["person"]) for r in rows if r["bin_area"][k] > 0.02]
        rate, name = min(rates, default=(None, None))
        below = sum(own < BINS[k] for own, _ in rates) / max(len(rates), 1)
        out.append({"scan": name, "right": rate, "scans_below_it": below})
    return out


def scans(count: int | None, seed: int, only: str, outsiders: bool) -> Iterator[PersonScan]:
    """The captures, then the cast; or the outsiders."""
    for name in () if outsiders else captured_names():
        if only in name:
            yield captured(name)
    names = tuple(OUTSIDERS if outsiders else CAST)
    for k in range(len(names) if count is None else count):
        if only in names[k % len(names)]:
            yield person(names[k % len(names)], seed=seed + k // len(names)).as_read()


def summarise(rows: list[dict]) -> dict[str, dict]:
    """Return the figures of each case, which weigh scans alike for accuracy, and area alike for calibration."""
    summary = {}
    for case in dict.fromkeys(r["case"] for r in rows):
        own = sorted((r for r in rows if r["case"] == case), key=lambda r: r["accuracy"])
        of = np.array([r["accuracy"] for r in own])
        area, right = (np.sum([r[key] for r in own], axis=0) for key in ("bin_area", "bin_right"))
        summary[case] = {
            "scans": len(own),
            "mean": float(of.mean()),
            "mean_faces": float(np.mean([r["accuracy_faces"] for r in own])),
            "median": float(np.median(of)),
            "at_least_93": float((of >= 0.93).mean()),
            "unsure": float(np.mean([r["unsure"] for r in own])),
            "sure_and_wrong": float(np.mean([r["sure_and_wrong"] for r in own])),
            "share_by_confidence": (area / area.sum()).tolist(),
            "right_by_confidence": np.divide(right, area, out=np.full(len(area), np.nan), where=area > 0).tolist(),
            "worst_by_confidence": _worst_by_confidence(own),
            "seconds_most": max(r["seconds"] for r in own),
        }
    return summary


def show(summary: dict[str, dict], rows: list[dict]) -> None:
    """Print the figures of each case, and its worst scans."""
    for case, s in summary.items():
        own = sorted((r for r in rows if r["case"] == case), key=lambda r: r["accuracy"])
        print(
            f"\n{case}: {len(own)} scans, mean {s['mean']:.1%} by area, {s['mean_faces']:.1%} by faces, "
            f"median {s['median']:.1%}, at least 93 %: {s['at_least_93']:.0%}; "
            f"not sure {s['unsure']:.1%}, sure and wrong {s['sure_and_wrong']:.1%}"
        )
        told = zip(s["share_by_confidence"], s["right_by_confidence"], s["worst_by_confidence"], strict=True)
        for low, high, (share, good, worst) in zip(BINS[:-1], BINS[1:], told, strict=True):
            least = "" if worst["scan"] is None else f", worst {worst['right']:6.1%} ({worst['scan'][:40]})"
            print(f"  confidence {low:.2f} to {high:.2f}: {share:6.1%} of the area, {good:6.1%} right{least}")
        for r in own[:12]:
            print(
                f"  {r['accuracy']:6.1%} {r['accuracy_faces']:6.1%} not sure {r['unsure']:6.1%}, sure and wrong "
                f"{r['sure_and_wrong']:6.1%}  {r['person'][:44]:44s} {r['worst']}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=None)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--outsiders", action="store_true")
    parser.add_argument("--faces", type=int, default=None)
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--cases", nargs="+", default=[])
    options = parser.parse_args()
    body, rows = load_body(), []
    for k, scan in enumerate(scans(options.count, options.seed, options.only, options.outsiders)):
        scan = simplified(scan, options.faces)
        own = measure(scan, body, k, draws=options.draws, cases=options.cases)
        print(f"{scan.name}: {', '.join(format(r['accuracy'], '.3f') for r in own)}", flush=True)
        rows += own
    summary = summarise(rows)
    show(summary, rows)
    if not options.only:
        command = shlex.join(["python", "-m", "benchmarks", "labels_by_body", *sys.argv[1:]])
        name = "labels_by_body_outsiders" if options.outsiders else "labels_by_body"
        store_results(name, command, {"bins": BINS, "summary": summary, "rows": rows})


if __name__ == "__main__":
    main()
