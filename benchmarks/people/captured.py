"""The scans with known truth that are not procedural, as the same type: the fixture's and those of captures."""

from __future__ import annotations

from pathlib import Path

import igl
import numpy as np
from jaxtyping import Bool

from benchmarks.people.person_scan import PersonScan, face_majority
from smplxpp.body import load_body, load_params
from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_mesh
from smplxpp.segment import read_labels

_ROOT = Path(__file__).resolve().parents[2]
_CAPTURES = _ROOT.parent / "shared" / "captures"
FOLDERS = {
    "fixture": _ROOT / "data" / "fixtures" / "person",
    "woman_casual": _CAPTURES / "woman_casual",
    "man_casual": _CAPTURES / "man_casual",
}
_TRUE = 0.004  # metres, as for procedural people


def captured_names() -> tuple[str, ...]:
    """Those of `FOLDERS` that are there."""
    return tuple(name for name, folder in FOLDERS.items() if (folder / "scans" / "scan_000000.ply").is_file())


def captured(name: str) -> PersonScan:
    """Frame 0 of one of `captured_names()`, with its exact parameters and true labels.

    Raises:
        InputError: no such capture, or it is not there.
    """
    if name not in captured_names():
        raise InputError("capture with a known truth", expected=f"one of {captured_names()}", received=name)
    folder, body = FOLDERS[name], load_body()
    read = read_mesh(folder / "scans" / "scan_000000.ply")
    labels = read_labels(
        folder / "scans" / "scan_000000_labels.npz",
        vertex_count=read.mesh.vertex_count,
        face_count=read.mesh.face_count,
        label_set="capture",
    )
    return PersonScan.of(
        body,
        load_params(folder / "params" / "params.npz", body=body).frame(0),
        name=name,
        mesh=read.mesh,
        colors=read.vertex_colors,
        face_labels=face_majority(labels, read.mesh.faces),
        seen=_seen(folder, read.mesh),
    )


def _seen(folder: Path, scan: TriangleMesh) -> Bool[np.ndarray, " M"]:
    """Tell the faces that lie on the true surface."""
    with np.load(folder / "geometry" / "topology.npz") as topology:
        faces = topology["faces"][~topology["face_hidden"]]
    with np.load(folder / "geometry" / "frame_000000.npz") as frame:
        vertices = frame["verts"].astype(np.float64)
    squared = igl.point_mesh_squared_distance(scan.vertices, vertices, faces.astype(np.int64))[0]
    return (squared < _TRUE**2)[scan.faces].all(axis=1)
