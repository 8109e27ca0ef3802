"""Armpits that nobody saw: the patch that closes what the cut of a web opens, against the cloth that is truly there.

    python -m benchmarks.darning --runs DIR --captures DIR

Every run of the folder that has a capture of its name, with a truth, is measured: its template as it is, and without
what was darned. The true garment is the capture's, in its authored T-pose and driven by its authored weights with arms
overhead; distances in mm from points of it to the template's same part, of all points and of those whose nearest face
of the darned part is a patch, and from the patch to the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import igl
import numpy as np
import tyro
from rich.console import Console

from benchmarks.capture_truth import find_captures
from benchmarks.machine import store_results
from pipelines.runs.artefacts import load_params_of_run, load_parts
from pipelines.runs.layout import TEMPLATE
from smplxpp.body.stress_poses import STRESS_POSES, stress_poses
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.core.topology import border_loops
from smplxpp.metrics.distance import MM
from smplxpp.skinning import skin
from smplxpp.template.template import Template

PART = "upper"
ARMS = "arms_overhead"


@dataclass(frozen=True)
class Darnings:
    """Measure, print, store."""

    runs: Path
    """Folder of runs, each named as its capture, built with exact parameters."""
    captures: Path
    """Folder of captures with a truth."""

    def run(self) -> None:
        """Measure every run that has a capture of its name."""
        people = {
            folder.name: measured(Template.load(self.runs / folder.name / TEMPLATE), folder, self.runs / folder.name)
            for folder in find_captures(self.captures)
            if (self.runs / folder.name / TEMPLATE).is_file()
        }
        Console().print_json(data=people)
        store_results(
            "darning", "python -m benchmarks.darning --runs DIR --captures DIR", {"protocol": "exact", "people": people}
        )


def measured(template: Template, capture: Path, run: Path) -> dict[str, Any]:
    """Figures of one person."""
    topology = np.load(capture / "geometry" / "topology.npz")
    names = [str(name) for name in topology["part_names"]]
    faces = topology["faces"][topology["face_part"] == names.index(PART)].astype(np.int64)
    reference = load_params_of_run(run)
    poses = {
        "T-pose": BodyParams.rest(betas=reference.betas[0], expressions=0, v_shape=reference.v_shape),
        ARMS: stress_poses(reference).frame(list(STRESS_POSES).index(ARMS)),
    }
    part_faces = template.part_faces(PART)
    darned, _ = template.mesh.submesh(part_faces)
    # What was darned comes behind the scan's faces.
    patch = np.arange(darned.face_count) >= load_parts(run)[PART][0].face_count
    out: dict[str, Any] = {
        "openings": len(border_loops(darned.submesh(~patch)[0].faces)),
        "openings, darned": len(border_loops(darned.faces)),
        "patch, cm2": round(float(darned.face_areas[patch].sum()) * 1e4, 1),
    }
    for name, params in poses.items():
        moves = template.body.forward(params).frame(0).posed_from_rest
        truth = TriangleMesh(skin(topology["v_tpose"], topology["weights"], moves), faces)
        posed = template.mesh.with_vertices(template.pose(params)[0]).submesh(part_faces)[0]
        out[name] = distances(truth, posed, patch)
    return out


def distances(truth: TriangleMesh, part: TriangleMesh, patch: np.ndarray) -> dict[str, Any]:
    """Distances between a true garment and a part, darned and with its holes."""
    points = truth.face_centers
    closed, face, _ = igl.point_mesh_squared_distance(points, part.vertices, part.faces)
    opened, _, _ = igl.point_mesh_squared_distance(points, part.vertices, part.faces[~patch])
    back, _, _ = igl.point_mesh_squared_distance(part.face_centers[patch], truth.vertices, truth.faces)
    there = patch[face]
    rows = {
        "truth to part, holes": opened,
        "truth to part, darned": closed,
        "at the patch, holes": opened[there],
        "at the patch, darned": closed[there],
        "patch to truth": back,
    }
    spread = {name: np.sqrt(squared) * MM for name, squared in rows.items()}
    return {
        "share of the truth at the patch, %": round(100.0 * float(there.mean()), 2),
        **{name: [round(float(d.mean()), 2), round(float(np.quantile(d, 0.95)), 2)] for name, d in spread.items()},
    }


def main() -> None:
    """Run as a script."""
    tyro.cli(Darnings).run()


if __name__ == "__main__":
    main()
