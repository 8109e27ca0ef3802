"""Compare point-to-surface distances with other libraries on the same points and meshes: values and times.

    python -m benchmarks metrics_peers --capture DIR [--peer-python PYTHON]

`--peer-python` is an interpreter that has the peers (trimesh with rtree, open3d, point-cloud-utils), so that they need
not share this project's environment; a peer that does not import there is reported as absent. Prints a table and stores
benchmarks/results/metrics_peers.json.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

PEERS = ("trimesh", "open3d", "point_cloud_utils")
REPEATS = 3


def peer_distance(name: str, vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(P,) distances by one peer, its tree built in the call as ours is."""
    if name == "trimesh":
        import trimesh

        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return trimesh.proximity.closest_point(mesh, points)[1]
    if name == "open3d":
        import open3d

        scene = open3d.t.geometry.RaycastingScene()
        scene.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))
        return scene.compute_distance(points.astype(np.float32)).numpy().astype(np.float64)
    import point_cloud_utils

    return point_cloud_utils.closest_points_on_mesh(points, vertices, faces)[0]


def worker(name: str, folder: Path) -> None:
    """Run one peer on the stored problems; writes its distances and seconds. Needs numpy and the peer alone."""
    __import__(name)
    with np.load(folder / "problem.npz") as data:
        problem = dict(data)
    out = {}
    for direction in ("pred_to_gt", "gt_to_pred"):
        seconds = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            out[direction] = peer_distance(
                name, problem[f"{direction}_vertices"], problem[f"{direction}_faces"], problem[f"{direction}_points"]
            )
            seconds.append(time.perf_counter() - start)
        out[f"{direction}_seconds"] = np.array(statistics.median(seconds))
    np.savez(folder / f"{name}.npz", **out)


def load_pair(capture: Path):
    """The capture's visible layers of its reference frame, and the scan of that frame."""
    from smplxpp.core.mesh import TriangleMesh
    from smplxpp.core.mesh_files.mesh_io import read_mesh

    with np.load(capture / "geometry" / "topology.npz") as topology:
        faces = topology["faces"][~topology["face_hidden"]]
    with np.load(capture / "geometry" / "frame_000000.npz") as frame:
        pred = TriangleMesh(frame["verts"], faces)
    return pred, read_mesh(capture / "scans" / "scan_000000.ply").mesh


def run(capture: Path, peer_python: str, samples: int) -> dict:
    """Measure ours and every peer; returns what is stored."""
    from smplxpp.metrics import compare, point_to_surface, sample_surface

    pred, gt = load_pair(capture)
    directions = {
        "pred_to_gt": (sample_surface(pred, samples).points, gt),
        "gt_to_pred": (sample_surface(gt, samples).points, pred),
    }
    ours, rows = {}, []
    row = {"library": "smplxpp"}
    for direction, (points, mesh) in directions.items():
        seconds = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            ours[direction] = point_to_surface(points, mesh)[0]
            seconds.append(time.perf_counter() - start)
        row |= {f"{direction}_mm": ours[direction].mean() * 1e3, f"{direction}_seconds": statistics.median(seconds)}
    rows.append(row)
    seconds = []
    for _ in range(REPEATS):
        # Fresh meshes: areas and normals are cached on them, a user's first call pays for them.
        fresh = [m.with_vertices(m.vertices) for m in (pred, gt)]
        start = time.perf_counter()
        result = compare(*fresh, samples=samples)
        seconds.append(time.perf_counter() - start)
    with tempfile.TemporaryDirectory() as folder:
        problem = {}
        for direction, (points, mesh) in directions.items():
            problem |= {
                f"{direction}_points": points,
                f"{direction}_vertices": mesh.vertices,
                f"{direction}_faces": mesh.faces,
            }
        np.savez(Path(folder) / "problem.npz", **problem)
        for name in PEERS:
            command = [peer_python, str(Path(__file__).resolve()), "--worker", name, folder]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            if done.returncode:
                rows.append({"library": name, "absent": done.stderr.strip().splitlines()[-1]})
                continue
            with np.load(Path(folder) / f"{name}.npz") as theirs:
                row = {"library": name}
                for direction in directions:
                    row |= {
                        f"{direction}_mm": float(theirs[direction].mean() * 1e3),
                        f"{direction}_seconds": float(theirs[f"{direction}_seconds"]),
                        f"{direction}_max_difference_mm": float(
                            np.abs(theirs[direction] - ours[direction]).max() * 1e3
                        ),
                    }
                total = sum(row[f"{direction}_seconds"] for direction in directions)
                row["times_ours"] = total / sum(rows[0][f"{direction}_seconds"] for direction in directions)
                rows.append(row)
    return {
        "capture": capture.name,
        "pred_faces": pred.face_count,
        "gt_faces": gt.face_count,
        "samples": samples,
        "compare_seconds": statistics.median(seconds),
        "compare": {k: v for k, v in result.as_dict().items() if k != "labels"},
        "rows": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    root = Path(__file__).resolve().parents[2]
    parser.add_argument("--capture", type=Path, default=root.parent / "shared" / "captures" / "woman_casual")
    parser.add_argument("--peer-python", default=sys.executable)
    parser.add_argument("--samples", type=int, default=100_000)
    parser.add_argument("--worker", nargs=2, metavar=("PEER", "FOLDER"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker:
        worker(args.worker[0], Path(args.worker[1]))
        return
    # Not at the top: a peer's interpreter runs this file without the project.
    from benchmarks.support.results import store_results

    report = run(args.capture, args.peer_python, args.samples)
    print(
        f"{report['pred_faces']} faces against a scan of {report['gt_faces']}, {report['samples']} points a direction"
    )
    print(f"{'library':18} {'p2s mm':>9} {'s2p mm':>9} {'max diff mm':>12} {'seconds':>8} {'x ours':>7}")
    for row in report["rows"]:
        if "absent" in row:
            print(f"{row['library']:18} absent: {row['absent']}")
            continue
        difference = max(row.get(f"{direction}_max_difference_mm", 0.0) for direction in ("pred_to_gt", "gt_to_pred"))
        seconds = row["pred_to_gt_seconds"] + row["gt_to_pred_seconds"]
        print(
            f"{row['library']:18} {row['pred_to_gt_mm']:9.5f} {row['gt_to_pred_mm']:9.5f} {difference:12.2g} "
            f"{seconds:8.2f} {row.get('times_ours', 1.0):7.1f}"
        )
    print(f"compare(), everything: {report['compare_seconds']:.2f} s")
    store_results("metrics_peers", "python -m benchmarks metrics_peers", report)


if __name__ == "__main__":
    main()
