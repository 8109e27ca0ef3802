"""Measure surfaces from photographs against the truth: visual hull and refined, with true and with wrong masks.

    python -m benchmarks reconstruction --capture DIR [--name NAME]

A capture with true vertices in `geometry/`. The truth is looked at in measuring alone; the cameras are those that are
trained on unless a row says otherwise. P2S: from points spread over the reconstruction to the true outer surface, all
of it and what two cameras see. Completeness: from points of the true surface that two of the cameras see to the
reconstruction. `estimated masks`: every other mask grown, the rest shrunk by 2 pixels, one of the background, one 12 %
of the image off.
"""

from __future__ import annotations

import resource
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float64
from scipy import ndimage

from benchmarks.support.results import store_results
from smplxpp.capture import open_capture
from smplxpp.core import GeometryWarning, TriangleMesh, normalize_rows
from smplxpp.metrics.distance import MM, point_to_surface
from smplxpp.metrics.sampling import sample_surface
from smplxpp.raster import rasterize_mesh
from smplxpp.reconstruct import PhotoView, ReconstructConfig, Reconstruction, reconstruct, silhouette_agreement

COMMAND = "python -m benchmarks reconstruction --capture DIR"
SAMPLES = 100_000
NEAR_MM = 5.0
_FACING, _BEHIND = 0.2, 3e-3
_OFF = 2
_AWAY = 0.12


@dataclass(frozen=True)
class ReconstructionBenchmark:
    """Reconstruct one frame in several ways and measure."""

    capture: Path
    """Folder of a capture with geometry/topology.npz and geometry/frame_FFFFFF.npz."""
    frame: int = 0
    """Frame that is reconstructed."""
    cases: tuple[str, ...] = ("training cameras", "training cameras, estimated masks", "all cameras")
    """Names of cases."""
    store: bool = True
    """Write benchmarks/results/reconstruction_CAPTURE.json."""
    name: str = ""
    """Name of the capture in the result, its folder's by default."""

    def run(self) -> None:
        """Print and store the figures."""
        capture = open_capture(self.capture)
        truth = true_surface(self.capture, self.frame)
        rows: dict[str, object] = {}
        for case in self.cases:
            cameras = list(capture.cameras) if case.startswith("all") else list(capture.splits.train_cameras)
            if case.startswith("all") and not capture.splits.novel_view_cameras:
                continue
            views = []
            for name in cameras:
                mask = capture.mask(name, self.frame)
                assert mask is not None
                views.append(PhotoView(name, capture.cameras[name], capture.image(name, self.frame), mask))
            if "estimated" in case:
                views = with_estimated_masks(views)
            begin, cpu = time.perf_counter(), time.process_time()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", GeometryWarning)  # the bad masks are named in `left_out`
                found = reconstruct(views, ReconstructConfig())
            seconds, spent = time.perf_counter() - begin, time.process_time() - cpu
            rows[case] = self._row(found, views, truth) | {
                "seconds": seconds,
                "cpu_seconds": spent,
                "peak_memory_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
            }
            print(case, rows[case], sep="\n  ", flush=True)
            if not self.store:
                continue
            sizes = sorted({(camera.width, camera.height) for camera in capture.cameras.values()})
            figures = {"frame": self.frame, "images": sizes, "cameras": len(capture.cameras), "rows": rows}
            print(f"stored {store_results(f'reconstruction_{self.name or self.capture.name}', COMMAND, figures).name}")

    def _row(self, found: Reconstruction, views: Sequence[PhotoView], truth: TriangleMesh) -> dict[str, object]:
        points = sample_surface(truth, SAMPLES, seed=1)
        kept = [view for view in views if view.name in found.numbers["views"]]
        visible = points.points[seen_by_two(truth, points.points, normalize_rows(points.normals), kept)]
        agreement = silhouette_agreement(found.mesh, kept)
        return {
            "views": len(kept),
            "left_out": found.numbers["left_out"],
            "pixel_mm": found.numbers["pixel_mm"],
            "cell_mm": found.numbers["cell_mm"],
            "vertices": found.mesh.vertex_count,
            "genus": found.numbers["genus"],
            "unseen": found.unseen,
            "silhouettes": float(np.mean(list(agreement.values()))),
            "hull": distances(found.hull, truth, visible),
            "refined": distances(found.mesh, truth, visible)
            | {"by_confidence": by_confidence(found, truth), "seen_by_two": p2s_of_seen(found, truth)},
        }


def true_surface(folder: Path, frame: int) -> TriangleMesh:
    """The surface that the images show: all layers without the skin that clothes hide."""
    topology = np.load(folder / "geometry" / "topology.npz")
    vertices = np.load(folder / "geometry" / f"frame_{frame:06d}.npz")["verts"].astype(np.float64)
    return TriangleMesh(vertices, topology["faces"][~topology["face_hidden"]].astype(np.int64))


def with_estimated_masks(views: Sequence[PhotoView]) -> list[PhotoView]:
    """Masks as a poor matting model makes them: 2 pixels off, and two that are wrong."""
    out = []
    for k, view in enumerate(views):
        change = ndimage.binary_erosion if k % 2 else ndimage.binary_dilation
        mask = 255 * change(view.opacity > 127, iterations=_OFF).astype(np.uint8)
        out.append(replace(view, opacity=mask))
    out[1] = replace(out[1], opacity=255 - out[1].opacity)
    pixels = round(_AWAY * out[3].camera.width)
    out[3] = replace(out[3], opacity=np.roll(out[3].opacity, pixels, axis=1))
    return out


def seen_by_two(
    truth: TriangleMesh,
    points: Float64[np.ndarray, "P 3"],
    normals: Float64[np.ndarray, "P 3"],
    views: Sequence[PhotoView],
) -> np.ndarray:
    """The points that two cameras see, no steeper than 78 degrees."""
    seen = np.zeros(len(points), dtype=np.int64)
    for view in views:
        camera = view.camera
        to_camera = normalize_rows(camera.position - points)
        x, y, z = camera.screen_from_world(points).T[:3]
        shown = (z > 0) & (x >= 0) & (y >= 0) & (x < camera.width) & (y < camera.height)
        # Both sides of a sheet of cloth are surface.
        shown &= np.abs(np.einsum("ij,ij->i", to_camera, normals)) > _FACING
        depth = rasterize_mesh(truth, camera).depth
        row, column = y[shown].astype(int), x[shown].astype(int)
        seen[np.flatnonzero(shown)[z[shown] <= depth[row, column] + _BEHIND]] += 1
    return seen >= 2


def distances(mesh: TriangleMesh, truth: TriangleMesh, visible: Float64[np.ndarray, "P 3"]) -> dict[str, object]:
    """Both directions, mm."""
    forth = MM * point_to_surface(sample_surface(mesh, SAMPLES, seed=0).points, truth)[0]
    back = MM * point_to_surface(visible, mesh)[0]
    return {
        "p2s": {"mean": forth.mean(), "median": np.median(forth), "p95": np.percentile(forth, 95)},
        "completeness": {
            "mean": back.mean(),
            "median": np.median(back),
            "p95": np.percentile(back, 95),
            f"within_{NEAR_MM:g}_mm": (back < NEAR_MM).mean(),
        },
    }


def p2s_of_seen(found: Reconstruction, truth: TriangleMesh) -> dict[str, float]:
    """P2S of the vertices that two cameras see."""
    off = MM * point_to_surface(found.mesh.vertices[found.seen >= 2], truth)[0]
    return {"mean": off.mean(), "median": float(np.median(off)), "p95": float(np.percentile(off, 95))}


def by_confidence(found: Reconstruction, truth: TriangleMesh) -> list[dict[str, float]]:
    """Return the error of vertices by their confidence."""
    off = MM * point_to_surface(found.mesh.vertices, truth)[0]
    rows = []
    for low, high in ((0.0, 0.01), (0.01, 0.5), (0.5, 0.99), (0.99, 2.0)):
        chosen = (found.confidence >= low) & (found.confidence < high)
        if chosen.any():
            rows.append(
                {
                    "from": low,
                    "share": chosen.mean(),
                    "mean": off[chosen].mean(),
                    "median": float(np.median(off[chosen])),
                    "p95": float(np.percentile(off[chosen], 95)),
                }
            )
    return rows


if __name__ == "__main__":
    tyro.cli(ReconstructionBenchmark).run()
