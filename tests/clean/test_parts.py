"""Parts of a labelled scan: specks, pinholes, openings, budgets, source maps."""

from __future__ import annotations

from pathlib import Path

import igl
import numpy as np
import pytest
import trimesh

from smplxpp.clean import PartsConfig, clean_parts, drop_specks, fill_pinholes, loop_lengths, sanitize, simplify
from smplxpp.clean.parts import split_long_edges
from smplxpp.clean.simplify import _collapse
from smplxpp.core import LOWER, SHOE, SKIN, UPPER, GeometryWarning, InputError, TriangleMesh, concatenate_meshes
from smplxpp.core.mesh_files.mesh_io import read_mesh
from smplxpp.core.topology import border_loops, edge_groups, face_components

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"


def tube(rows: int = 60, columns: int = 80) -> TriangleMesh:
    """An open sleeve of radius 0.1 m along y, wavy."""
    u, v = np.meshgrid(np.arange(columns) * 2 * np.pi / columns, np.linspace(0, 0.5, rows))
    r = 0.1 + 0.005 * np.sin(3 * u + 20 * v)
    vertices = np.stack([r * np.cos(u), v, -r * np.sin(u)], axis=2).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    faces = np.concatenate([np.stack([a, b, d], 2), np.stack([a, d, c], 2)]).reshape(-1, 3)
    return TriangleMesh(vertices, faces)


def test_simplify_keeps_borders_and_traces_every_vertex():
    sleeve = tube()
    result = simplify(sleeve, 1500)
    mesh = result.mesh
    assert mesh.face_count <= 1500
    assert igl.is_edge_manifold(mesh.faces) and igl.is_vertex_manifold(mesh.faces).all()
    assert result.flipped_faces == 0
    border = np.unique(sleeve.border_edges)
    np.testing.assert_allclose(mesh.vertices[result.new_from_old[border]], sleeve.vertices[border], atol=0)
    np.testing.assert_array_equal(result.new_from_old[result.source_vertex], np.arange(mesh.vertex_count))
    assert (result.new_from_old >= 0).all()
    lengths = [sorted(loop_lengths(m, border_loops(m.faces))) for m in (sleeve, mesh)]
    np.testing.assert_allclose(*lengths, rtol=1e-12)


def finer(mesh: TriangleMesh) -> TriangleMesh:
    """Every face in four, in its own plane."""
    fine = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).subdivide()
    return TriangleMesh(fine.vertices, fine.faces)


@pytest.mark.long
def test_a_scan_much_finer_than_its_features_keeps_edges_with_a_length():
    # Sixteen flat faces in the place of each: the best place of many vertices is the same old corner, and edges of
    # 1e-16 m between them grew by a factor of millions when they were posed.
    rough = tube()
    rough = rough.with_vertices(rough.vertices + np.random.default_rng(0).normal(0, 7e-4, rough.vertices.shape))
    fine = finer(finer(rough))
    result = simplify(fine, 5000)
    mesh = result.mesh
    length = np.linalg.norm(np.diff(mesh.vertices[mesh.edges], axis=1), axis=2)
    assert length.min() > 1e-3 * length.mean() and mesh.face_areas.min() > 0
    assert 4000 < mesh.face_count <= 5000
    assert igl.is_edge_manifold(mesh.faces) and result.flipped_faces == 0
    np.testing.assert_array_equal(result.new_from_old[result.source_vertex], np.arange(mesh.vertex_count))
    tree = igl.AABB()
    tree.init(mesh.vertices, mesh.faces)
    assert np.sqrt(tree.squared_distance(mesh.vertices, mesh.faces, fine.vertices)[0]).max() < 3e-3


@pytest.mark.parametrize("budget", [8000, 9000, 9500])
@pytest.mark.long
def test_no_two_vertices_of_a_simplified_person_share_a_place(budget: int):
    # Fingers that collapse touch in single vertices, which were doubled in place: reading the mesh welded them again.
    mesh = simplify(read_mesh(FIXTURE / "scans" / "scan_000000.ply").mesh, budget).mesh
    assert sanitize(mesh.vertices, mesh.faces).report.is_clean


@pytest.mark.parametrize("scale", [1e-2, 1.0, 100.0, 1000.0])
def test_simplify_reaches_its_budget_in_any_unit(scale: float):
    # The library's thresholds are absolute: of 8,000 faces asked for 32,144 were left in millimetres.
    sleeve = tube()
    small = simplify(sleeve.with_vertices(scale * sleeve.vertices), 2000).mesh
    assert 1900 <= small.face_count <= 2000
    tree = igl.AABB()
    tree.init(small.vertices / scale, small.faces)
    distance = np.sqrt(tree.squared_distance(small.vertices / scale, small.faces, sleeve.vertices)[0])
    assert distance.max() < 1e-3


def test_simplify_says_when_borders_keep_it_above_the_budget():
    strip = tube(4, 200)
    with pytest.warns(GeometryWarning, match=r"left \d+ faces where 100 were asked for"):
        result = simplify(strip, 100)
    assert result.mesh.face_count >= 400  # two borders of 200 edges


def test_a_mesh_within_budget_stays():
    sleeve = tube(8, 10)
    result = simplify(sleeve, 1000)
    np.testing.assert_array_equal(result.mesh.faces, sleeve.faces)
    np.testing.assert_array_equal(result.source_vertex, np.arange(sleeve.vertex_count))
    with pytest.raises(InputError, match="face budget"):
        simplify(sleeve, 0)


def test_pinholes_close_and_openings_stay():
    sleeve = tube()
    center = sleeve.triangles.mean(axis=1)
    hole = np.linalg.norm(center - center[2000], axis=1) < 0.006
    pierced, _ = sleeve.submesh(~hole)
    single, _ = sleeve.submesh(np.arange(sleeve.face_count) != 1000)
    for mesh in (pierced, single):
        assert len(border_loops(mesh.faces)) == 3
        filled, source = fill_pinholes(mesh, max_length=0.1)
        assert len(border_loops(filled.faces)) == 2
        assert igl.is_edge_manifold(filled.faces)
        assert (filled.face_normals[mesh.face_count :] @ filled.face_normals[mesh.face_count - 1] > -1).all()
        np.testing.assert_array_equal(source[: mesh.vertex_count], np.arange(mesh.vertex_count))
        directed = np.sort(edge_groups(filled.faces)[2])
        assert directed.max() == 2


def test_a_filled_hole_faces_outward():
    ball = trimesh.creation.icosphere(subdivisions=4)
    kept = np.linalg.norm(ball.triangles_center - [0, 0, 1], axis=1) > 0.1
    mesh, _ = TriangleMesh(ball.vertices, ball.faces).submesh(kept)
    filled, _ = fill_pinholes(mesh, max_length=2.0)
    assert not len(border_loops(filled.faces))
    assert (filled.face_normals[mesh.face_count :, 2] > 0.9).all()


def test_a_lone_triangle_is_no_hole():
    flake = TriangleMesh(np.eye(3) * 1e-3, np.array([[0, 1, 2]]))
    assert fill_pinholes(flake)[0].face_count == 1


def test_specks_go_and_the_largest_stays():
    sleeve = tube()
    speck = TriangleMesh(np.eye(3) * 1e-3 + 1, np.array([[0, 1, 2]]))
    both = concatenate_meshes([speck, sleeve])
    np.testing.assert_array_equal(drop_specks(both), np.arange(both.face_count) >= 1)
    assert drop_specks(speck).all()


def labelled_scan() -> tuple[TriangleMesh, np.ndarray]:
    sleeve = tube()
    shoe = sleeve.with_vertices(sleeve.vertices * 0.5 + [1.0, 0, 0])
    other = sleeve.with_vertices(sleeve.vertices * 0.5 - [1.0, 0, 0])
    scan = concatenate_meshes([sleeve, shoe, other])
    labels = np.full(scan.face_count, SHOE.id)
    labels[: sleeve.face_count] = np.where(sleeve.triangles.mean(1)[:, 1] > 0.2, UPPER.id, LOWER.id)
    return scan, labels


def test_parts_of_a_scan():
    scan, labels = labelled_scan()
    colors = np.arange(scan.vertex_count * 3).reshape(-1, 3).astype(np.uint8)
    parts = clean_parts(scan, labels, config=PartsConfig(face_budgets={"shoe": 3000}), vertex_colors=colors)
    assert list(parts) == ["shoe", "upper", "lower"]
    assert parts["shoe"].report.components == 2
    assert parts["shoe"].mesh.face_count <= 3000
    assert len(parts["shoe"].report.opening_lengths) == 4
    for part in parts.values():
        assert part.report.non_manifold_edges == part.report.flipped_faces == 0
        np.testing.assert_array_equal(part.vertex_colors, colors[part.source_vertex])
        assert np.linalg.norm(scan.vertices[part.source_vertex] - part.mesh.vertices, axis=1).max() < 0.02
    for name, label in (("upper", UPPER), ("lower", LOWER)):
        assert parts[name].mesh.face_count == (labels == label.id).sum()
        np.testing.assert_array_equal(scan.vertices[parts[name].source_vertex], parts[name].mesh.vertices)


def test_a_coarse_garment_is_split_until_its_faces_bend_as_the_skin_does():
    # The jacket of a game character has faces of 13 cm. Its shoulder bent with the weights of their corners alone, and
    # the shoulder blades came through it.
    sleeve = tube(rows=3, columns=9)
    labels = np.full(sleeve.face_count, UPPER.id)
    colors = np.where(sleeve.vertices[:, [1]] > 0.2, 200, 0) * np.ones(3)
    part = clean_parts(sleeve, labels, vertex_colors=colors.astype(np.uint8))["upper"]
    ends = part.mesh.vertices[part.mesh.edges]
    assert np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).max() <= 0.03
    # The surface is the same, whole and the same side out; its two openings are as long as before.
    assert part.mesh.face_areas.sum() == pytest.approx(sleeve.face_areas.sum(), rel=1e-12)
    assert igl.is_edge_manifold(part.mesh.faces) and part.report.components == 1
    lengths = sorted(loop_lengths(sleeve, border_loops(sleeve.faces)), reverse=True)
    np.testing.assert_allclose(part.report.opening_lengths, lengths)
    _, face, _ = igl.point_mesh_squared_distance(part.mesh.face_centers, sleeve.vertices, sleeve.faces)
    assert np.einsum("ij,ij->i", part.mesh.face_normals, sleeve.face_normals[face]).min() > 1 - 1e-9
    # Colours blend along the edges, and only borders stand for borders.
    height = part.mesh.vertices[:, 1]
    assert np.ptp(part.vertex_colors[np.abs(height - 0.125) < 0.02]) > 20
    border = np.zeros(part.mesh.vertex_count, dtype=bool)
    border[part.mesh.border_edges] = True
    stands = np.isin(part.source_vertex, np.unique(sleeve.border_edges))
    assert stands[border].all() and not stands[np.abs(height - 0.25) < 1e-9].any()


def test_edges_are_split_no_finer_than_the_budget_allows():
    sleeve = tube(rows=3, columns=9)
    fine, rounds = split_long_edges(sleeve, longest=0.03, most=200)
    assert sleeve.face_count < fine.face_count <= 200 and rounds
    assert split_long_edges(sleeve, longest=0.03, most=sleeve.face_count)[0] is sleeve


def test_bad_labels_are_refused():
    scan, labels = labelled_scan()
    with pytest.raises(InputError, match="shape"):
        clean_parts(scan, labels[:-1])
    with pytest.raises(InputError, match="only skin"):
        clean_parts(scan, np.full(scan.face_count, SKIN.id))
    with pytest.raises(InputError, match="label ids"):
        clean_parts(scan, np.full(scan.face_count, 9))
    with pytest.raises(InputError, match="trousers"):
        PartsConfig(face_budgets={"trousers": 5})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["woman_casual", "man_casual"])
def test_parts_of_a_capture(captures, name: str):
    from smplxpp.core.mesh_files.mesh_io import read_mesh
    from smplxpp.segment import read_labels, segment_scan

    folder = captures / name / "scans"
    scan = read_mesh(folder / "scan_000000.ply").mesh
    labels = read_labels(
        folder / "scan_000000_labels.npz",
        vertex_count=scan.vertex_count,
        face_count=scan.face_count,
        label_set="capture",
    )
    parts = clean_parts(scan, segment_scan(scan, vertex_labels=labels).face_labels)
    assert set(parts) == {"hair", "shoe", "upper", "lower"}
    for part in parts.values():
        assert part.report.non_manifold_edges == part.report.flipped_faces == 0
        assert part.report.distance_mean < 5e-4 and part.report.distance_p95 < 1.5e-3
        assert (face_components(part.mesh.faces).max() == 1) == (part.label == SHOE.id)


def test_a_flap_that_vanishes_beside_locked_faces_leaves_them_their_vertices():
    """A build of a carved person stopped with "indices in [-1, 8958]": locked faces lost the vertices of a flap."""
    # Faces 0 and 1 bound no volume once the edge of no length (2, 3) is merged; face 3 is locked and uses 0 and 1.
    vertices = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0], [1, 1, 0], [0.5, -1, 0], [5, 0, 0], [6, 0, 0], [5, 1, 0]]
    )
    faces = np.array([[0, 1, 2], [1, 0, 3], [2, 4, 3], [0, 5, 1], [6, 7, 8]])
    mesh = TriangleMesh(vertices.astype(float), faces)
    result, new_from_old = _collapse(mesh, np.array([False, False, False, True, False]), 8)
    np.testing.assert_array_equal(result.vertices[new_from_old[faces[3]]], vertices[faces[3]])
    assert result.face_count == 2
