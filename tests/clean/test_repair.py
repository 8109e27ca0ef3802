"""Raw arrays to a mesh that can be trusted."""

from __future__ import annotations

import warnings

import igl
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from smplxpp.clean import check_human_scale, convert_points, sanitize
from smplxpp.core import GeometryWarning, InputError, TriangleMesh
from smplxpp.core.topology import border_loops, half_edges


def sphere(level: int = 3) -> TriangleMesh:
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=level)
    return TriangleMesh(ball.vertices, ball.faces)


def quiet_sanitize(vertices, faces, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)
        return sanitize(vertices, faces, **options)


def oriented_triangles(mesh: TriangleMesh) -> set:
    """Faces as cyclic position triples: independent of the order of vertices and faces."""
    out = set()
    for corners in np.round(mesh.triangles, 9):
        k = min(range(3), key=lambda i: tuple(corners[i]))
        out.add(tuple(map(tuple, np.roll(corners, -k, axis=0))))
    return out


def test_clean_mesh_is_untouched():
    ball = sphere()
    result = sanitize(ball.vertices, ball.faces)
    assert result.report.is_clean
    np.testing.assert_array_equal(result.mesh.faces, ball.faces)
    np.testing.assert_array_equal(result.source_vertex, np.arange(ball.vertex_count))


def test_every_repair_is_counted_and_mapped():
    ball = sphere()
    v, f = ball.vertices, ball.faces
    n = len(v)
    vertices = np.concatenate([v, [[np.nan, 0, 0]], v[:1] + 1e-9, [[9.0, 9, 9]]])
    faces = f.copy()
    faces[5] = faces[5][::-1]
    near = faces[10].copy()
    faces = np.concatenate([faces, [near], [[0, 1, n]], [[3, 3, 4]]])
    first = np.flatnonzero((faces == 0).any(axis=1))[0]
    faces[first] = np.where(faces[first] == 0, n + 1, faces[first])
    with pytest.warns(GeometryWarning, match="flipped"):
        result = sanitize(vertices, faces)
    r = result.report
    assert (r.nonfinite_vertices, r.welded_vertices, r.zero_area_faces, r.duplicate_faces) == (1, 1, 1, 1)
    assert (r.flipped_faces, r.split_vertices, r.unreferenced_vertices) == (1, 0, 1)
    assert oriented_triangles(result.mesh) == oriented_triangles(ball)
    np.testing.assert_array_equal(result.mesh.vertices, vertices[result.source_vertex])
    assert len(result.source_face) == result.mesh.face_count


@pytest.mark.parametrize("place", [1e30, 1e9, -1e150, 1e308, np.inf])
def test_a_vertex_far_from_everything_goes_and_is_said(place: float):
    ball = sphere()
    vertices = ball.vertices.copy()
    vertices[100] = [place, 0, 0]
    with pytest.warns(GeometryWarning, match="nonfinite" if np.isinf(place) else "1 stray vertices"):
        result = sanitize(vertices, ball.faces)
    around = (ball.faces == 100).any(axis=1).sum()
    assert result.mesh.face_count == ball.face_count - around
    np.testing.assert_array_equal(np.delete(np.arange(len(vertices)), 100), result.source_vertex)
    assert result.report.unreferenced_vertices == 0


def test_a_stray_face_goes_and_a_vertex_within_a_hall_stays():
    ball = sphere()
    vertices = np.concatenate([ball.vertices, 1e12 + np.eye(3)])
    count = ball.vertex_count
    faces = np.concatenate([ball.faces, [[count, count + 1, count + 2]]])
    result = quiet_sanitize(vertices, faces)
    assert result.report.stray_vertices == 3 and result.mesh.face_count == ball.face_count
    vertices = ball.vertices.copy()
    vertices[100] *= 100.0
    assert sanitize(vertices, ball.faces).report.is_clean


def test_many_strays_heaps_and_immense_coordinates_are_refused_before_work():
    ball = sphere()
    vertices = ball.vertices.copy()
    vertices[:40] = 1e30
    with pytest.raises(InputError, match="40 of 642 vertices"):
        sanitize(vertices, ball.faces)
    with pytest.raises(InputError, match="most above"):
        sanitize(1e200 * ball.vertices, ball.faces)
    # Ten thousand vertices in one place are fifty million pairs.
    heap = np.concatenate([ball.vertices, np.zeros((10_000, 3))])
    faces = np.concatenate([ball.faces, ball.vertex_count + np.arange(9999).reshape(-1, 3)])
    with pytest.raises(InputError, match="heaps"):
        sanitize(heap, faces)


def test_inward_ball_and_open_bowl_turn_outward():
    ball = sphere()
    result = quiet_sanitize(ball.vertices, ball.faces[:, ::-1])
    assert result.report.flipped_faces == ball.face_count
    assert oriented_triangles(result.mesh) == oriented_triangles(ball)
    bowl, _ = ball.submesh(ball.triangles.mean(1)[:, 1] < 0.3)
    result = quiet_sanitize(bowl.vertices, bowl.faces[:, ::-1])
    assert oriented_triangles(result.mesh) == oriented_triangles(bowl)


def test_fin_and_bow_tie_are_cut():
    # Three sheets at the edge 0-1; two triangles that meet in one vertex.
    v = np.array([[0, 0, 0], [0, 0, 1], [1, 0, 0], [-1, 0.3, 0], [0, 1, 0], [0.5, -3, 0], [1, -3, 1.0]])
    f = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4], [2, 5, 6]])
    result = quiet_sanitize(v, f)
    assert igl.is_edge_manifold(result.mesh.faces)
    assert igl.is_vertex_manifold(result.mesh.faces).all()
    assert result.report.split_vertices == 5
    np.testing.assert_array_equal(result.mesh.vertices, v[result.source_vertex])


def test_moebius_strip_is_left_and_kept_manifold():
    n = 12
    t = 2 * np.pi * np.arange(n) / n
    sides = [(s, 1 + s * np.cos(t / 2)) for s in (-0.3, 0.3)]
    v = np.concatenate([np.stack([r * np.cos(t), r * np.sin(t), s * np.sin(t / 2)], 1) for s, r in sides])
    f = []
    for i in range(n):
        a, b = i, i + n
        c, d = (i + 1, i + 1 + n) if i < n - 1 else (n, 0)
        f += [[a, c, b], [b, c, d]]
    result = quiet_sanitize(v, np.array(f))
    assert igl.is_edge_manifold(result.mesh.faces)
    directed = half_edges(result.mesh.faces)
    assert len(np.unique(directed, axis=0)) == len(directed)


@pytest.mark.parametrize("scale", [1.0, 100.0, 1e-3])
def test_the_answer_moves_with_the_mesh(scale: float):
    ball = sphere(2)
    faces = ball.faces.copy()
    faces[::7] = faces[::7, ::-1]
    reference = quiet_sanitize(ball.vertices, faces)
    c, s = np.cos(0.3), np.sin(0.3)
    rotation = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    moved = quiet_sanitize(scale * ball.vertices @ rotation.T + 5.0 * scale, faces)
    np.testing.assert_array_equal(moved.mesh.faces, reference.mesh.faces)
    assert moved.report == reference.report


def test_permutation_gives_the_same_surface():
    ball = sphere(2)
    rng = np.random.default_rng(0)
    faces = ball.faces.copy()
    faces[::5] = faces[::5, ::-1]
    order, shuffle = rng.permutation(ball.vertex_count), rng.permutation(ball.face_count)
    back = np.argsort(order)
    permuted = quiet_sanitize(ball.vertices[order], back[faces][shuffle])
    assert oriented_triangles(permuted.mesh) == oriented_triangles(quiet_sanitize(ball.vertices, faces).mesh)


@settings(max_examples=60, deadline=None)
@given(
    arrays(np.float64, (8, 3), elements=st.sampled_from([0.0, 1.0, 2.0, np.nan, -1.0, np.inf])),
    arrays(np.int64, (14, 3), elements=st.integers(-1, 8)),
)
def test_garbage_is_repaired_or_refused(vertices, faces):
    try:
        result = quiet_sanitize(vertices, faces)
    except InputError:
        return
    mesh = result.mesh
    assert igl.is_edge_manifold(mesh.faces) and igl.is_vertex_manifold(mesh.faces).all()
    assert (mesh.face_areas > 0).all()
    assert len(np.unique(mesh.faces)) == mesh.vertex_count
    np.testing.assert_array_equal(mesh.vertices, vertices[result.source_vertex])
    again = quiet_sanitize(mesh.vertices, mesh.faces)
    np.testing.assert_array_equal(again.mesh.faces, mesh.faces)
    np.testing.assert_array_equal(again.mesh.vertices, mesh.vertices)


def test_border_loops_agree_with_igl():
    ball = sphere()
    y = ball.triangles.mean(1)[:, 1]
    band, _ = ball.submesh((y < 0.6) & (y > -0.4))
    loops = border_loops(band.faces)
    assert sorted(map(len, loops)) == sorted(len(loop) for loop in igl.boundary_loop_all(band.faces))
    edges = {tuple(e) for e in half_edges(band.faces)}
    for loop in loops:
        assert all((a, b) in edges for a, b in zip(loop, np.roll(loop, -1), strict=True))


@pytest.mark.parametrize(("units", "up"), [("cm", "y"), ("mm", "z"), ("m", "x"), ("m", "-z"), ("inch", "-y")])
def test_units_and_axes_are_detected_and_converted(units: str, up: str):
    rng = np.random.default_rng(0)
    person = rng.uniform([-0.4, 0, -0.15], [0.4, 1.7, 0.15], (500, 3))
    check_human_scale(person)
    forward = convert_points(np.eye(3), up=up)  # rows: images of the source axes
    assert np.linalg.det(forward) == pytest.approx(1.0)
    scale = convert_points(np.eye(3), units=units)[0, 0]
    foreign = person @ forward.T / scale
    np.testing.assert_allclose(convert_points(foreign, units=units, up=up), person, atol=1e-12)
    axis = up.strip("-")
    remedy = f"--units {units}" if units != "m" else f"--up {axis}"
    with pytest.raises(InputError, match=remedy):
        check_human_scale(foreign)


def test_half_a_person_is_not_only_asked_for_another_axis():
    wide = np.random.default_rng(0).uniform([-0.63, 0, -0.15], [0.63, 0.9, 0.15], (500, 3))
    with pytest.raises(InputError, match=r"if it is \+Y, the scan is of half a person"):
        check_human_scale(wide)


def test_unknown_units_are_refused():
    with pytest.raises(InputError, match="'m' or 'cm' or 'mm' or 'inch'"):
        convert_points(np.zeros((1, 3)), units="feet")
