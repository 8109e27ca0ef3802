"""Measure the body found in a real scan against the body that others fitted to it, and draw a sheet of its build."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from benchmarks.support.real_sources import Truth
from pipelines.runs.artefacts import load_scan, load_scan_labels
from pipelines.runs.layout import LOCATE_STAGE, LOCATED_PARAMS, LOCATION_FILE, PARAMS, SCAN, SCAN_LABELS, TEMPLATE
from smplxpp.body import BodyModel, load_params
from smplxpp.body.named_poses import STRESS_POSES, stress_poses
from smplxpp.body.smpl_joints import smpl_joints
from smplxpp.build.scan import read_scan
from smplxpp.clean import convert_points
from smplxpp.core import BodyParams, Camera, InputError, TriangleMesh, display_colors
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.figures import VIEWS, caption, contact_sheet, encode_png, fit_cameras, render_overlay, row
from smplxpp.metrics import point_to_surface
from smplxpp.raster import render_shaded
from smplxpp.raster.viewpoints import body_cameras
from smplxpp.template import Template

BODY_JOINTS = 22
MM = 1e3
POSES = ("high_step", "twist")
"""Driven poses: legs apart and bent, and a turn of the trunk with hanging arms, where glued limbs show."""


def found_body(run: Path, body: BodyModel) -> BodyParams | None:
    """Return the body that a run found or used, None where it found none."""
    for name in (PARAMS, LOCATED_PARAMS):
        if (run / name).is_file():
            return load_params(run / name, body=body)
    return None


def found_frame(run: Path) -> tuple[str, str]:
    """Return units and upward axis in which a run read its scan."""
    path = run / LOCATE_STAGE / LOCATION_FILE
    read = json.loads(path.read_text()) if path.is_file() else {}
    return read.get("units", "m"), read.get("up", "y")


def skin_mesh(body: BodyModel, vertices: Float64[np.ndarray, "V 3"]) -> TriangleMesh:
    """Return the body's outer skin, without eyes, teeth and tongue."""
    kept = body.part_labels == body.part_label_names.index("body")
    return TriangleMesh(vertices, body.faces[kept[body.faces].all(axis=1)])


def distances(run: Path, folder: Path, truth: Truth, body: BodyModel) -> dict[str, float] | None:
    """Measure a found body against a known one, in millimetres.

    Args:
        run: folder of a build.
        folder: folder of sources.
        truth: the known body.
        body: the body model of the run.

    Returns:
        `surface`: mean distance of the found skin's vertices to the known surface; `back`: of the known vertices to the
        found skin; `p95` of both; where joints are known, `joints`: mean over SMPL's 22 joints of the body, at SMPL's
        places on the open body; `own_joints`: of the open body's own. None where no body was found.
    """
    params = found_body(run, body)
    if params is None:
        return None
    # The truth lies in the scan's file: bring it to the metres and the upward axis that the run has found.
    units, up = found_frame(run)
    raw = read_raw_mesh(folder / truth.surface)
    known = TriangleMesh(convert_points(raw.vertices, units=units, up=up), raw.faces)
    posed = body.forward(params)
    skin = skin_mesh(body, posed.vertices[0])
    forth = MM * point_to_surface(skin.vertices[np.unique(skin.faces)], known)[0]
    back = MM * point_to_surface(known.vertices, skin)[0]
    found = {
        "surface": float(forth.mean()),
        "back": float(back.mean()),
        "p95": float(np.percentile(np.concatenate([forth, back]), 95)),
    }
    if truth.joints:
        with np.load(folder / truth.joints, allow_pickle=False) as file:
            joints = convert_points(file["joints"][:BODY_JOINTS].astype(np.float64), units=units, up=up)
        # The open body's own joints lie elsewhere than SMPL's; compare the same places of both bodies.
        for name, own in (("joints", smpl_joints(body, params)[0]), ("own_joints", posed.joints[0, :BODY_JOINTS])):
            found[name] = float(MM * np.linalg.norm(own - joints, axis=1).mean())
    return {name: round(value, 1) for name, value in found.items()}


def fingerprint(run: Path, words: str) -> str:
    """Return 12 hexadecimal digits that change with the template of a run, or with the words about it without one."""
    content = (run / TEMPLATE).read_bytes() if (run / TEMPLATE).is_file() else words.encode()
    return hashlib.sha256(content).hexdigest()[:12]


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
