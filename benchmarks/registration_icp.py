"""Iterated closest points of open3d as the baseline of a body found in a scan: the mean body in an A-pose, moved.

    pip install 'smplxpp[scan]'; python -m benchmarks.registration_icp --names fixture woman_casual man_casual

Point to plane (Chen and Medioni 1992), and point to point with scale, from the true facing and from a quarter and half
a turn off, with the body's middle on the scan's; correspondences within 10 cm, then 3. The truth is looked at in
measuring alone. What `smplxpp.register.locate` finds in the same scans is `python -m benchmarks.scan_alone`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro

from benchmarks.machine import store_results
from benchmarks.people import PersonScan, captured, captured_names
from smplxpp.body import BodyModel, load_body
from smplxpp.body.standing_poses import standing_poses
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec

_POINTS = 20_000
_REACHES = (0.10, 0.03)
_STEPS = 100
_POSE = "arms lowered, legs apart"
TURNS = (0, 90, 180)


@dataclass(frozen=True)
class RegistrationIcp:
    """Run and store the baseline."""

    names: tuple[str, ...] = ()
    """Captures; all that are there by default."""

    def run(self) -> None:
        """Print and store the figures."""
        body, rows = load_body(), []
        for name in self.names or captured_names():
            scan = captured(name)
            for turn in TURNS:
                for scaled in (False, True):
                    error = vertex_error(body, scan, turn=turn, scaled=scaled)
                    method = "point to point, scaled" if scaled else "point to plane"
                    rows.append({"scan": name, "degrees_off": turn, "method": method, "body_mm": error})
                    print(rows[-1], flush=True)
        store_results("registration_icp", "python -m benchmarks.registration_icp", {"rows": rows})


def vertex_error(body: BodyModel, scan: PersonScan, *, turn: float, scaled: bool) -> float:
    """Mean distance of the moved body's vertices to the true ones, mm."""
    import open3d

    params = BodyParams.from_full_pose(
        dict(standing_poses(body.joint_count))[_POSE][None],
        betas=np.zeros((1, 0)),
        expression=np.zeros((1, 0)),
        transl=np.zeros((1, 3)),
    )
    mean = body.forward(params).vertices[0]
    facing = matrix_from_rotvec(np.array([0.0, np.radians(turn), 0.0])) @ _upright(scan.params)
    start = (mean - mean.mean(axis=0)) @ facing.T + scan.mesh.vertices.mean(axis=0)
    rng = np.random.default_rng(0)
    chosen = rng.permutation(scan.mesh.vertex_count)[:_POINTS]
    target = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(scan.mesh.vertices[chosen]))
    target.normals = open3d.utility.Vector3dVector(scan.mesh.vertex_normals[chosen])
    source = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(start))
    icp = open3d.pipelines.registration
    kind = icp.TransformationEstimationPointToPoint(True) if scaled else icp.TransformationEstimationPointToPlane()
    found: Any = np.eye(4)
    for reach in _REACHES:
        criteria = icp.ICPConvergenceCriteria(max_iteration=_STEPS)
        found = icp.registration_icp(source, target, reach, found, kind, criteria).transformation
    moved = start @ found[:3, :3].T + found[:3, 3]
    return float(1e3 * np.linalg.norm(moved - scan.body_vertices, axis=1).mean())


def _upright(params: BodyParams) -> np.ndarray:
    """The true turn about the vertical axis."""
    front = matrix_from_rotvec(params.full_pose[0, 0]) @ np.array([0.0, 0.0, 1.0])
    return matrix_from_rotvec(np.array([0.0, np.arctan2(front[0], front[2]), 0.0]))


if __name__ == "__main__":
    tyro.cli(RegistrationIcp).run()
