"""Measure the body found in a real scan against the body that others fitted to it."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from benchmarks.support.real_sources import Truth
from pipelines.runs.layout import LOCATE_STAGE, LOCATED_PARAMS, LOCATION_FILE, PARAMS, TEMPLATE
from smplxpp.body import BodyModel, load_params
from smplxpp.body.smpl_joints import smpl_joints
from smplxpp.clean import convert_points
from smplxpp.core import BodyParams, TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.metrics import point_to_surface

BODY_JOINTS = 22
MM = 1e3


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
