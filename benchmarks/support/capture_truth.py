"""Captures whose truth is known: the reference scan's parts, with the weights that their authors gave them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np

from smplxpp.body import BodyModel, load_body, load_params
from smplxpp.clean import PartsConfig, clean_parts
from smplxpp.core import CLOTH_LABELS, LABEL_BY_NAME, UPPER, BodyParams, TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_mesh

_LABEL_OF_PART = {"hair": "hair", "shoes": "shoe", "upper": "upper", "lower": "lower"}


@dataclass(frozen=True, eq=False)
class TruePart:
    """A loose part cut from the scan, and what is true at its vertices.

    Attributes:
        mesh: cleaned and simplified, in the reference pose.
        weights: (N, J) authored. rest_vertices: (N, 3) authored T-pose, without the cloth's own motion.
    """

    mesh: TriangleMesh
    weights: np.ndarray
    rest_vertices: np.ndarray


@dataclass(frozen=True, eq=False)
class CaptureTruth:
    """Attributes: `parts` by label name; `exact`, `noisy` parameters of the reference frame; `motion` all frames."""

    name: str
    body: BodyModel
    parts: dict[str, TruePart]
    exact: BodyParams
    noisy: BodyParams
    motion: BodyParams


def find_captures(folder: Path) -> list[Path]:
    """The capture folders with a known truth in `folder`, sorted."""
    return sorted(path.parents[1] for path in folder.glob("*/geometry/topology.npz"))


def read_capture_truth(folder: Path, *, cloth_faces: int = UPPER.face_budget) -> CaptureTruth:
    """Read frame 0 of a capture; the scan is cut by its true labels, so that the figures judge what follows alone."""
    body = load_body()
    topology = np.load(folder / "geometry" / "topology.npz")
    names = [str(name) for name in topology["part_names"]]
    posed = np.load(folder / "geometry" / "frame_000000.npz")["verts"].astype(np.float64)
    scan = read_mesh(folder / "scans" / "scan_000000.ply").mesh
    part_of_vertex = np.load(folder / "scans" / "scan_000000_labels.npz")["part"]
    label_of_part = np.array([LABEL_BY_NAME[_LABEL_OF_PART[n]].id if n in _LABEL_OF_PART else 0 for n in names])
    # A face on the seam of two labels goes with its middle one.
    labels = np.sort(label_of_part[part_of_vertex][scan.faces], axis=1)[:, 1]
    budgets = {label.name: cloth_faces for label in CLOTH_LABELS}
    cleaned = clean_parts(scan, labels, config=PartsConfig(face_budgets=budgets))
    parts = {}
    for part, label in _LABEL_OF_PART.items():
        faces = topology["faces"][topology["face_part"] == names.index(part)].astype(np.int64)
        parts[label] = _true_part(
            cleaned[label].mesh, TriangleMesh(posed, faces), topology["weights"], topology["v_tpose"]
        )
    motion = folder / "params" / "params.npz"
    single = folder / "params" / "000000.npz"
    exact = load_params(single if single.exists() else motion)
    return CaptureTruth(
        folder.name,
        body,
        parts,
        exact.frame(0),
        load_params(folder / "params" / "params_noisy.npz").frame(0),
        load_params(motion) if motion.exists() else exact,
    )


def _true_part(mesh: TriangleMesh, layer: TriangleMesh, weights: np.ndarray, rest: np.ndarray) -> TruePart:
    """Authored values of the closest point of the true layer, both in the reference pose."""
    _, face, closest = igl.point_mesh_squared_distance(np.array(mesh.vertices), layer.vertices, layer.faces)
    corners = layer.faces[face]
    barycentric = igl.barycentric_coordinates(
        closest, *(np.ascontiguousarray(layer.triangles[face, k]) for k in range(3))
    )
    barycentric = np.clip(np.nan_to_num(barycentric, nan=1 / 3), 0, None)
    barycentric /= barycentric.sum(axis=1, keepdims=True)
    at = np.einsum("nk,nkj->nj", barycentric, weights.astype(np.float64)[corners])
    return TruePart(
        mesh, at / at.sum(axis=1, keepdims=True), np.einsum("nk,nkd->nd", barycentric, rest.astype(np.float64)[corners])
    )
