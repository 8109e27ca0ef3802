"""A contact sheet of the people: coloured front and side, labels, and how the body lies under the clothes.

python -m benchmarks.people --out sheet.png [--cache FOLDER] [--count 12] [--seed 0] [--variant "3 mm noise"]
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.garments.mannequin import shares
from benchmarks.people.access import people
from benchmarks.people.person_scan import PersonScan
from benchmarks.people.stances import FINGERS
from benchmarks.people.variants import variant
from pipelines.figures.sheets import caption, contact_sheet, encode_png, row
from smplxpp.body import load_body
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.labels import LABELS, display_colors
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.raster import render_shaded
from smplxpp.raster.viewpoints import body_cameras


@dataclass(frozen=True)
class PeopleSheet:
    """Make the people and a sheet of them; prints a line for each."""

    out: Path
    """The PNG."""
    cache: Path | None = None
    """A folder that remembers who was made."""
    count: int | None = None
    """Of people; by default the whole cast."""
    seed: int = 0
    """0: as they are described; another one: others of the same kinds."""
    variant: str = "as it is"
    """What has happened to the scans: one of `benchmarks.people.VARIANTS`."""
    height: int = 420
    """Of a person's pictures, pixels."""

    def run(self) -> None:
        """Make, print and write."""
        cells = []
        for scan in people(count=self.count, seed=self.seed, cache=self.cache):
            shown = variant(scan, self.variant).as_read()
            print(describe(shown), flush=True)
            cells.append(self._cell(shown))
        atomic_write_bytes(self.out, encode_png(contact_sheet(cells, columns=4)))

    def _cell(self, scan: PersonScan) -> np.ndarray:
        front, side = body_cameras(scan.mesh, views=("front", "side"), height=self.height)
        pictures = [render_shaded(scan.mesh, camera, vertex_colors=scan.colors) for camera in (front, side)]
        labels = display_colors(np.where(scan.seen, scan.face_labels, -1))
        pictures.append(render_shaded(scan.mesh, front, face_colors=labels))
        return caption(row(pictures, gap=2), scan.name, size=14)


def describe(scan: PersonScan) -> str:
    """Size, share of each label of the area, and how far the body is out of the scan."""
    areas = np.bincount(scan.face_labels, scan.mesh.face_areas, minlength=len(LABELS)) / scan.mesh.face_areas.sum()
    shares = " ".join(f"{label.name} {100 * share:.0f} %" for label, share in zip(LABELS, areas, strict=True) if share)
    out = 1e3 * body_outside(scan)
    return (
        f"{scan.name}: {np.ptp(scan.mesh.vertices[:, 1]):.2f} m, {scan.mesh.face_count} faces, "
        f"{100 * scan.seen.mean():.0f} % seen; {shares}; body out of the scan by more than 3 mm: "
        f"{100 * (out > 3).mean():.2f} % of the vertices, p99 {np.percentile(out, 99):.1f} mm"
    )


def body_outside(scan: PersonScan) -> np.ndarray:
    """How far the body's skin lies outside the scan, metres a vertex, negative within it.

    Without fingers, whose tips a scan rounds off.
    """
    body = load_body()
    kept = (body.part_labels == 0) & (shares(body, body.weights, FINGERS) < 0.5)
    return SignedDistanceField(scan.mesh, solid=True).query(scan.body_vertices[kept]).distance


if __name__ == "__main__":
    tyro.cli(PeopleSheet, prog="python -m benchmarks.people").run()
