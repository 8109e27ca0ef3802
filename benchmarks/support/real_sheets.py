"""Draw a sheet of a build from a real scan: scan, body inside, labels, T-pose, two driven poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.support.real_truth import found_body, found_frame, skin_mesh
from pipelines.runs.artefacts import load_scan, load_scan_labels
from pipelines.runs.layout import SCAN, SCAN_LABELS, TEMPLATE
from smplxpp.body import BodyModel
from smplxpp.body.named_poses import STRESS_POSES, stress_poses
from smplxpp.build.scan import read_scan
from smplxpp.core import Camera, InputError, TriangleMesh, display_colors
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.figures import VIEWS, caption, contact_sheet, encode_png, fit_cameras, render_overlay, row
from smplxpp.raster import render_shaded
from smplxpp.raster.viewpoints import body_cameras
from smplxpp.template import Template

POSES = ("high_step", "twist")
"""Driven poses: legs apart and bent, and a turn of the trunk with hanging arms, where glued limbs show."""


def write_sheet(path: Path, run: Path, scan: Path, body: BodyModel, *, height: int = 520) -> None:
    """Write what a build has made of a scan as a PNG; what it has not made is left out.

    Args:
        path: the picture.
        run: folder of the build.
        scan: file of the scan, drawn as it lies there if the run has not read it.
        body: the body model of the run.
        height: of a picture of the sheet, pixels.
    """
    mesh, colors = _scan(run, scan)
    params = found_body(run, body)
    cameras = _around(mesh, None if params is None else body.joint_rotations(params)[0, 0], height)
    cells = [_cell([render_shaded(mesh, camera, vertex_colors=colors) for camera in cameras], "scan")]
    if params is not None:
        skin = skin_mesh(body, body.forward(params).vertices[0])
        cells.append(_cell([render_overlay(skin, mesh, camera) for camera in cameras], "body inside"))
    if (run / SCAN_LABELS).is_file():
        labels = display_colors(load_scan_labels(run, mesh.face_count))
        cells.append(_cell([render_shaded(mesh, camera, face_colors=labels) for camera in cameras], "labels"))
    if (run / TEMPLATE).is_file() and params is not None:
        template = Template.load(run / TEMPLATE)
        posed = template.pose(stress_poses(params))[[list(STRESS_POSES).index(name) for name in POSES]]
        for name, vertices in zip(("T-pose", *POSES), (template.vertices, *posed), strict=True):
            surface = template.mesh.with_vertices(vertices)
            views = body_cameras(surface, views=("front", "three-quarter-back"), height=height)
            drawn = [render_shaded(surface, camera, vertex_colors=template.vertex_colors) for camera in views]
            cells.append(_cell(drawn, name.replace("_", " ")))
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write_bytes(path, encode_png(contact_sheet(cells, columns=3)))


def _scan(run: Path, scan: Path) -> tuple[TriangleMesh, np.ndarray | None]:
    """Return the scan as the run read it, else as its file has it, scaled to the height of a person."""
    if (run / SCAN).is_file():
        mesh, colors, _ = load_scan(run)
        return mesh, colors
    units, up = found_frame(run)
    try:
        read = read_scan(scan, units=units, up=up)
    except InputError:
        # A file that no build could read as a person is drawn with its longest side upright, 1.75 m high.
        read = read_scan(_upright(scan))
    return read.clean.mesh, read.colors


def _upright(scan: Path) -> TriangleMesh:
    raw = read_raw_mesh(scan)
    size = np.ptp(raw.vertices, axis=0)
    return TriangleMesh(raw.vertices * (1.75 / size.max()), raw.faces)


def _around(mesh: TriangleMesh, pelvis: np.ndarray | None, height: int) -> list[Camera]:
    """Return cameras in front of the person, beside and behind, whichever way the scan faces."""
    forward = np.array([0.0, 0.0, 1.0]) if pelvis is None else pelvis[:, 2]
    angle = np.arctan2(forward[0], forward[2])
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    directions = [turn @ np.array(VIEWS[name]) for name in ("front", "side", "back")]
    return fit_cameras(mesh.vertices[np.unique(mesh.faces)], directions=directions, height=height)


def _cell(pictures: list[np.ndarray], words: str) -> np.ndarray:
    return caption(row(pictures, gap=2), words, size=16)
