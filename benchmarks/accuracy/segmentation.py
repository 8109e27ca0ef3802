"""Measure accuracy and time of the segmentation against a capture's true labels.

    python -m benchmarks segmentation [--capture ../shared/captures/woman_casual]

Label maps of the reference frame vote on the scan: as they are, as the protocol `tracked` has them (borders wander, 5 %
of the pixels wrong; three draws, and one with every other camera), and after corruption (shifted by up to 4 px, four
wrong rectangles a view); then the labels that come with the scan, as they are and with 15 % of the vertices relabelled
at random. Accuracy is area-weighted over the faces against the majority of each face's true vertex labels.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np

from benchmarks.support.results import store_results
from smplxpp.capture.cameras import read_cameras
from smplxpp.core.labels import BACKGROUND, LABELS
from smplxpp.core.mesh_files.mesh_io import read_mesh
from smplxpp.segment import map_labels, read_label_map, read_labels, segment_scan, vote_on_faces
from smplxpp.synth.tracker import estimated_labels


def corrupt(label_map: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The labels shifted within the silhouette, with four rectangles of a random label."""
    foreground = label_map != BACKGROUND
    shift = rng.integers(-4, 5, 2)
    out = np.roll(label_map, shift, axis=(0, 1))
    out = np.where(foreground & (out == BACKGROUND), label_map, out)
    out[~foreground] = BACKGROUND
    pixels = np.argwhere(foreground)
    for _ in range(4):
        (y, x), (h, w) = pixels[rng.integers(len(pixels))], rng.integers(8, 40, 2)
        patch = out[max(0, y - h) : y + h, max(0, x - w) : x + w]
        patch[patch != BACKGROUND] = rng.integers(0, len(LABELS) - 1)
    return out


def tracked(label_maps: list[np.ndarray], seed: int) -> list[np.ndarray]:
    """The maps with a parser's errors (`smplxpp.synth.tracker.estimated_labels`)."""
    numbers = [(labels - BACKGROUND).astype(np.uint8) for labels in label_maps]
    found = [estimated_labels(labels, seed=[seed, k], background=[0]) for k, labels in enumerate(numbers)]
    return [labels.astype(np.int64) + BACKGROUND for labels in found]


def majority(vertex_labels: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(M,) the label of most corners; of the first where all differ."""
    corner = vertex_labels[faces]
    return np.where(corner[:, 1] == corner[:, 2], corner[:, 1], corner[:, 0])


def measure(folder: Path) -> list[dict]:
    """One row a case."""
    mesh = read_mesh(folder / "scans/scan_000000.ply").mesh
    truth_vertex = read_labels(
        folder / "scans/scan_000000_labels.npz",
        vertex_count=mesh.vertex_count,
        face_count=mesh.face_count,
        label_set="capture",
    )
    truth = majority(truth_vertex, mesh.faces)
    area = mesh.face_areas

    def accuracy(labels: np.ndarray, of: np.ndarray | slice = slice(None)) -> float:
        return float(area[of][labels[of] == truth[of]].sum() / area[of].sum())

    rows = []

    def add(case: str, before: np.ndarray, seen: np.ndarray, seconds_votes: float, **given) -> None:
        start = time.perf_counter()
        result = segment_scan(mesh, **given)
        rows.append(
            {
                "case": case,
                "accuracy_before": accuracy(before),
                "accuracy_before_seen": accuracy(before, seen),
                "accuracy": accuracy(result.face_labels),
                "accuracy_seen": accuracy(result.face_labels, seen),
                "seen": float(area[seen].sum() / area.sum()),
                "energy_before": result.energy_before,
                "energy": result.energy_after,
                "island_faces": result.island_faces,
                "seconds_votes": seconds_votes,
                "seconds": time.perf_counter() - start,
            }
        )

    if (folder / "labels").is_dir():
        cameras = read_cameras(folder / "cameras.json")
        clean = [
            read_label_map(folder / "labels" / c.name / f"{c.name}_label000000.png", label_set="capture")
            for c in cameras
        ]
        rng = np.random.default_rng(0)
        corrupted = [corrupt(m, rng) for m in clean]
        # Share of the person's pixels whose labels the corruption leaves right.
        right = sum(int(((a == b) & (a >= 0)).sum()) for a, b in zip(clean, corrupted, strict=True))
        share = right / sum(int((a >= 0).sum()) for a in clean)
        draws = {f"label maps, tracked, draw {seed}": tracked(clean, seed) for seed in (1, 2, 3)}
        every_other = {"label maps, tracked, every other camera": draws["label maps, tracked, draw 1"][::2]}
        for case, maps in {
            "label maps": clean,
            **draws,
            **every_other,
            f"label maps at {share:.1%}": corrupted,
        }.items():
            start = time.perf_counter()
            used = cameras if len(maps) == len(cameras) else cameras[::2]
            votes = vote_on_faces(mesh, list(zip(used, maps, strict=True)))
            add(case, votes.argmax(1), votes.any(1), time.perf_counter() - start, votes=votes)
    rng = np.random.default_rng(1)
    noisy = truth_vertex.copy()
    # Labels of vertices with 15 % replaced at random, as noise without any place.
    wrong = rng.random(len(noisy)) < 0.15
    noisy[wrong] = map_labels(rng.integers(1, 6, int(wrong.sum())), "capture")
    everywhere = np.ones(mesh.face_count, dtype=bool)
    for case, labels in (
        ("vertex labels", truth_vertex),
        (f"vertex labels at {(noisy == truth_vertex).mean():.1%}", noisy),
    ):
        add(case, majority(labels, mesh.faces), everywhere, 0.0, vertex_labels=labels)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    shared = Path(__file__).resolve().parents[3] / "shared/captures"
    parser.add_argument("--capture", type=Path, nargs="+", default=[shared / "woman_casual", shared / "man_casual"])
    results = {folder.name: measure(folder) for folder in parser.parse_args().capture}
    for name, rows in results.items():
        print(f"{name}\n{'case':42s} seen    before  -> after   (seen faces)        energy           votes + cut, s")
        for r in rows:
            print(
                f"{r['case']:42s} {r['seen']:6.2%}  {r['accuracy_before']:6.2%} -> {r['accuracy']:6.2%} "
                f"({r['accuracy_before_seen']:6.2%} -> {r['accuracy_seen']:6.2%})  "
                f"{r['energy_before']:9.0f} -> {r['energy']:7.0f}  {r['seconds_votes']:.2f} + {r['seconds']:.2f}"
            )
    store_results("segmentation", "python -m benchmarks segmentation", results)


if __name__ == "__main__":
    main()
