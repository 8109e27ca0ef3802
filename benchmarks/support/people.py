"""Scans and captures with known truth: the fixture's, parts with authored weights; a sheet of procedural people.

python -m benchmarks.support.people --out sheet.png [--cache FOLDER] [--count 12] [--seed 0] [--variant "3 mm noise"]
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import igl
import numpy as np
import tyro
from jaxtyping import Bool

from benchmarks.support.results import ROOT
from smplxpp.body import BodyModel, load_body, load_params
from smplxpp.clean import PartsConfig, clean_parts
from smplxpp.core import (
    CLOTH_LABELS,
    LABEL_BY_NAME,
    LABELS,
    UPPER,
    BodyParams,
    InputError,
    SkinWeights,
    TriangleMesh,
    display_colors,
)
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.mesh_files.mesh_io import read_mesh
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.figures.sheets import caption, contact_sheet, encode_png, row
from smplxpp.people import PersonScan, people, variant
from smplxpp.people.bodies import FINGERS
from smplxpp.people.garments.mannequin import shares
from smplxpp.people.garments.wardrobe import Case
from smplxpp.people.person_scan import face_majority
from smplxpp.raster import render_shaded
from smplxpp.raster.viewpoints import body_cameras
from smplxpp.segment import read_labels
from smplxpp.skinning import unpose
from smplxpp.template import Template

_LABEL_OF_PART = {"hair": "hair", "shoes": "shoe", "upper": "upper", "lower": "lower"}
_CAPTURES = ROOT.parent / "shared" / "captures"
FOLDERS = {
    "fixture": ROOT / "data" / "fixtures" / "person",
    "woman_casual": _CAPTURES / "woman_casual",
    "man_casual": _CAPTURES / "man_casual",
}


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


def captured_names() -> tuple[str, ...]:
    """Return the names of `FOLDERS` whose scans are on this machine."""
    return tuple(name for name, folder in FOLDERS.items() if (folder / "scans" / "scan_000000.ply").is_file())


def captured(name: str) -> PersonScan:
    """Return frame 0 of one of `captured_names()`, with its exact parameters and true labels.

    Raises:
        InputError: an unknown capture, or one that is not on this machine.
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


def worn_template(body: BodyModel, case: Case, *, under: Bool[np.ndarray, " N"] | None = None) -> Template:
    """Return the person of a case in its garment: a template of two or three parts by the authored weights.

    In the pose of the scan it has the scan's shape, folds and noise included. The part has the garment's label as its
    name. Where vertices are `under` the others, and come first, they are the part "lower" and the rest is "outer".
    """
    rest = unpose(case.mesh.vertices, case.weights, body.forward(case.params).posed_from_rest[0]).vertices
    bare = BodyParams.rest(betas=case.params.betas[0], expressions=body.num_expressions)
    count = body.vertex_count
    part, names = np.repeat([0, 1], [count, len(rest)]), ("body", case.garment.label)
    if under is not None and under.any():
        part[count:] += ~under
        names = ("body", "lower", "outer")
    return Template(
        body=body,
        vertices=np.concatenate([body.forward(bare).vertices[0], rest]),
        faces=np.concatenate([body.faces, case.mesh.faces + count]),
        vertex_labels=np.array([0, *(LABEL_BY_NAME[name].id for name in names[1:])])[part],
        vertex_part=part,
        part_names=names,
        vertex_colors=np.full((len(part), 3), 128),
        weights=SkinWeights.from_dense(np.concatenate([body.weights, case.weights])),
        betas=case.params.betas[0],
        body_index=np.where(part == 0, np.arange(len(part)), 0),
        scan_index=np.full(len(part), -1),
    )


def _seen(folder: Path, scan: TriangleMesh) -> Bool[np.ndarray, " M"]:
    """Return which faces lie within 4 mm of the true surface, as for procedural people."""
    with np.load(folder / "geometry" / "topology.npz") as topology:
        faces = topology["faces"][~topology["face_hidden"]]
    with np.load(folder / "geometry" / "frame_000000.npz") as frame:
        vertices = frame["verts"].astype(np.float64)
    squared = igl.point_mesh_squared_distance(scan.vertices, vertices, faces.astype(np.int64))[0]
    return (squared < 0.004**2)[scan.faces].all(axis=1)


@dataclass(frozen=True)
class PeopleSheet:
    """Make the people and a contact sheet of them."""

    out: Path
    """The PNG."""
    cache: Path | None = None
    """A folder of people made before."""
    count: int | None = None
    """Number of people; by default the whole cast."""
    seed: int = 0
    """0: as the cast describes them; another one: others of the same kinds."""
    variant: str = "as it is"
    """Change of the scans: one of `smplxpp.people.VARIANTS`."""
    height: int = 420
    """Height of a person's pictures, pixels."""

    def run(self) -> None:
        """Make the people, print a line for each and write the sheet."""
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
    """Return size, share of each label in the area, and how far the body is outside the scan."""
    areas = np.bincount(scan.face_labels, scan.mesh.face_areas, minlength=len(LABELS)) / scan.mesh.face_areas.sum()
    shares = " ".join(f"{label.name} {100 * share:.0f} %" for label, share in zip(LABELS, areas, strict=True) if share)
    out = 1e3 * body_outside(scan)
    return (
        f"{scan.name}: {np.ptp(scan.mesh.vertices[:, 1]):.2f} m, {scan.mesh.face_count} faces, "
        f"{100 * scan.seen.mean():.0f} % seen; {shares}; body out of the scan by more than 3 mm: "
        f"{100 * (out > 3).mean():.2f} % of the vertices, p99 {np.percentile(out, 99):.1f} mm"
    )


def body_outside(scan: PersonScan) -> np.ndarray:
    """Return how far the body's skin lies outside the scan, metres a vertex, negative within it.

    Fingers are left out, because a scan rounds off their tips.
    """
    body = load_body()
    kept = (body.part_labels == body.part_label_names.index("body")) & (shares(body, body.weights, FINGERS) < 0.5)
    return SignedDistanceField(scan.mesh, solid=True).query(scan.body_vertices[kept]).distance


if __name__ == "__main__":
    tyro.cli(PeopleSheet, prog="python -m benchmarks.support.people").run()
