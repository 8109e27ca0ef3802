"""Measure a synthetic capture: skinning, cloth strain, depth of clothes in the body, and the scan."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from smplxpp.core import BodyParams, TriangleMesh, row_lengths
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.people.fixture_person import PART_NAMES, Person
from smplxpp.people.scan_simulation import SimulatedScan
from smplxpp.synth.simulate import Take

_MM = 1e3
_GARMENTS = ("upper", "lower")


def take_checks(person: Person, take: Take, noisy: BodyParams) -> dict[str, float]:
    """Return figures of a take: distances from skinning, strain of free edges, depth in the body, tracker's error."""
    count = person.body.vertex_count
    # The body of the take has to equal the posed model.
    posed = person.body.forward(take.params).vertices
    moved = row_lengths((take.vertices - take.skinned).reshape(-1, 3)).reshape(take.vertices.shape[:2])
    tracked = person.body.forward(noisy).vertices
    out = {
        "body_vs_skinning_max_mm": _MM * float(np.abs(posed - take.vertices[:, :count]).max()),
        "tracker_error_mean_mm": _MM * float(row_lengths((tracked - posed).reshape(-1, 3)).mean()),
    }
    for name in (*_GARMENTS, "hair"):
        own = person.vertex_part == PART_NAMES.index(name)
        out[f"{name}_vs_skinning_mean_mm"] = _MM * float(moved[:, own].mean())
    # Depth costs a distance query a frame, so that about 100 frames at even steps stand for all.
    depth = _depths(person, take.vertices[:: -(-len(take.vertices) // 100)])
    for name in _GARMENTS:
        # Garments that are attached all over have no free edges.
        strain = free_edge_strain(person, take, name)
        out |= {
            f"{name}_depth_max_mm": _MM * float(depth[name].max()),
            f"{name}_vertices_deeper_1mm_percent": 100 * float((depth[name] > 1e-3).mean()),
        }
        if strain.size:
            out[f"{name}_strain_p99_percent"] = 100 * float(np.percentile(np.abs(strain), 99))
    return out


def _depths(person: Person, frames: Float[np.ndarray, "T V 3"]) -> dict[str, Float[np.ndarray, "T _"]]:
    """Return the depth of the garments' vertices in the body by garment, metres; 0 outside."""
    count, own = person.body.vertex_count, {k: person.vertex_part == PART_NAMES.index(k) for k in _GARMENTS}
    found: dict[str, list[np.ndarray]] = {name: [] for name in _GARMENTS}
    for vertices in frames:
        body = SignedDistanceField(TriangleMesh(vertices[:count], person.body.faces), solid=True)
        for name in _GARMENTS:
            found[name].append(_depths_in(body, vertices[own[name]]))
    return {name: np.stack(rows) for name, rows in found.items()}


def depths(surface: TriangleMesh, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
    """Return the depth of points inside a closed surface, metres; 0 outside. Winding numbers give the side exactly."""
    return _depths_in(SignedDistanceField(surface, solid=True), points)


def _depths_in(solid: SignedDistanceField, points: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, " P"]:
    return np.maximum(-solid.query(points).distance, 0.0)


def free_edge_strain(person: Person, take: Take, garment: str) -> Float[np.ndarray, "T E"]:
    """Return the strain of edges between two free vertices, relative to the skinned layer of frame 0."""
    mesh, used = person.tpose.submesh(person.face_part == PART_NAMES.index(garment))
    edges = used[mesh.edges]
    # Attached vertices follow skinning, whose strain is not the simulation's.
    edges = edges[(take.attachment[edges] < 1.0).all(axis=1)]

    def lengths(vertices: Float[np.ndarray, "*T V 3"]) -> Float[np.ndarray, "*T E"]:
        return np.linalg.norm(vertices[..., edges[:, 0], :] - vertices[..., edges[:, 1], :], axis=-1)

    return lengths(take.vertices) / lengths(take.skinned[0]) - 1.0


def scan_checks(reference: TriangleMesh, scan: SimulatedScan) -> dict[str, float]:
    """Return figures of a scan: distances from the layers that it shows, share of bridges, topology."""
    # Vertices farther than 5 mm from what they show belong to bridges.
    shown = scan.shown_on(reference)
    distance = row_lengths(scan.mesh.vertices - shown) * _MM
    inside = SignedDistanceField(scan.mesh, solid=True).query(shown[distance < 5]).distance
    counts = scan.mesh.edges_with_counts[1]
    return {
        "scan_to_layers_mean_mm": float(distance.mean()),
        "scan_to_layers_p99_mm": float(np.percentile(distance, 99)),
        "layers_to_scan_mean_signed_mm": float(inside.mean() * _MM),
        "scan_vertices_webbed_percent": float(100 * (distance > 5).mean()),
        "scan_faces": scan.mesh.face_count,
        "scan_open_edges": int((counts == 1).sum()),
        "scan_nonmanifold_edges": int((counts > 2).sum()),
    }
