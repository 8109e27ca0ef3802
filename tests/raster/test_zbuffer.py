from __future__ import annotations

import numpy as np
import pytest
import trimesh

from smplxpp.core import Camera, InputError, TriangleMesh, concatenate_meshes
from smplxpp.raster import outer_visible_faces, outer_visible_points, rasterize_mesh


@pytest.fixture(scope="module")
def sphere() -> TriangleMesh:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    return TriangleMesh(ball.vertices, ball.faces)


@pytest.fixture(scope="module")
def camera() -> Camera:
    return Camera.look_at(eye=(0.3, 0.2, 2.0), target=(0, 0, 0), fov_y_deg=40, width=120, height=90)


def test_barycentrics_give_the_point_on_the_pixels_ray(sphere, camera):
    maps = rasterize_mesh(sphere, camera)
    points = maps.interpolate(sphere.faces, sphere.vertices)[maps.mask]
    rows, cols = np.nonzero(maps.mask)
    screen = camera.screen_from_world(points)
    np.testing.assert_allclose(screen[:, 0], cols + 0.5, atol=2e-4)
    np.testing.assert_allclose(screen[:, 1], rows + 0.5, atol=2e-4)
    np.testing.assert_allclose(screen[:, 2], maps.depth[maps.mask], rtol=1e-5)


def test_the_silhouette_is_the_spheres(sphere, camera):
    """A pixel's ray hits an exact sphere if and only if it hits the mesh, but for the rim of the facets."""
    maps = rasterize_mesh(sphere, camera)
    cols, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack([cols, rows, np.ones_like(cols)], -1) @ np.linalg.inv(camera.K).T @ camera.cam_from_world[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    closest = camera.position + (rays @ -camera.position)[..., None] * rays
    distance = np.linalg.norm(closest, axis=-1)
    assert maps.mask[distance < 0.495].all()
    assert not maps.mask[distance > 0.5].any()


@pytest.mark.parametrize("parallel", [False, True])
def test_every_pixel_has_the_bits_of_the_formula_for_it_alone(parallel):
    """Pixels are computed several at once: none may differ at the ends of rows, on edges, or on slivers."""
    rng = np.random.default_rng(5)
    points = np.round(rng.normal(0.0, 0.4, (60, 3)), 1)  # many share a plane, an edge or a pixel's centre
    mesh = TriangleMesh(points, rng.integers(0, 60, (80, 3)))
    if parallel:
        view = Camera.orthographic_view(center=np.zeros(3), direction=(0, 0, 1), half_extent=1.0, size=21)
    else:
        view = Camera.look_at(eye=(0, 0, 3.0), target=(0, 0, 0), fov_y_deg=35, width=31, height=22)
    face_id, depth = np.full((view.height, view.width), -1), np.full((view.height, view.width), np.inf, np.float32)
    barycentric = np.zeros((view.height, view.width, 3), np.float32)
    y, x = np.mgrid[: view.height, : view.width]
    for f, (a, b, c) in enumerate(view.screen_from_world(points)[mesh.faces]):
        area = (b[0] - a[0]) * (c[1] - a[1]) - (c[0] - a[0]) * (b[1] - a[1])
        if area == 0.0:
            continue
        inv, px, py = 1.0 / area, x + 0.5 - c[0], y + 0.5 - c[1]
        wa = (b[1] - c[1]) * inv * px + (c[0] - b[0]) * inv * py
        wb = (c[1] - a[1]) * inv * px + (a[0] - c[0]) * inv * py
        wc = 1.0 - wa - wb
        qa, qb, qc = wa * a[3], wb * b[3], wc * c[3]
        inside = (wa >= 0) & (wb >= 0) & (wc >= 0)
        q = np.divide(1.0, qa + qb + qc, out=np.ones_like(qa), where=inside)
        z = ((qa * a[2] + qb * b[2] + qc * c[2]) * q).astype(np.float32)
        won = inside & (z < depth)
        face_id[won], depth[won] = f, z[won]
        barycentric[won] = np.stack([qa * q, qb * q, qc * q], axis=2)[won]
    maps = rasterize_mesh(mesh, view)
    np.testing.assert_array_equal(maps.face_id, face_id)
    np.testing.assert_array_equal(maps.depth, depth)
    np.testing.assert_array_equal(maps.barycentric, barycentric)
    assert (face_id >= 0).mean() > 0.2


def test_every_thread_count_gives_the_same_bits(sphere, camera):
    one, three = (rasterize_mesh(sphere, camera, threads=n) for n in (1, 3))
    for name in ("face_id", "barycentric", "depth"):
        np.testing.assert_array_equal(getattr(one, name), getattr(three, name))


def test_a_camera_moved_with_the_mesh_sees_the_same(sphere, camera):
    world = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3], [0.1, 0, 0])
    world[:3, 3] += [3, -2, 1]
    moved = sphere.with_vertices(sphere.vertices @ world[:3, :3].T + world[:3, 3])
    there = Camera(camera.K, camera.cam_from_world @ np.linalg.inv(world), camera.width, camera.height)
    a, b = rasterize_mesh(sphere, camera), rasterize_mesh(moved, there)
    assert (a.face_id == b.face_id).mean() > 0.9995


def test_the_nearer_of_two_faces_wins_and_equal_depth_takes_the_lower_index():
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    near, far = TriangleMesh(square + [0, 0, 0.1], faces), TriangleMesh(square, faces)
    camera = Camera.orthographic_view(center=(0, 0, 0), direction=(0, 0, 1), half_extent=0.5, size=16)
    assert (rasterize_mesh(concatenate_meshes([far, near]), camera).face_id >= 2).all()
    assert (rasterize_mesh(concatenate_meshes([far, far]), camera).face_id < 2).all()


def test_a_closed_surface_leaves_no_crack_between_faces():
    rng = np.random.default_rng(0)
    plane = trimesh.creation.box(extents=(2, 2, 0.1)).subdivide_loop(4)
    mesh = TriangleMesh(plane.vertices + rng.normal(0, 1e-3, plane.vertices.shape), plane.faces)
    camera = Camera.orthographic_view(center=(0, 0, 0), direction=(0, 0, 1), half_extent=0.5, size=200)
    assert rasterize_mesh(mesh, camera).mask.all()


def test_faces_behind_the_camera_and_empty_views_are_empty(sphere):
    away = Camera.look_at(eye=(0, 0, 2), target=(0, 0, 4), fov_y_deg=40, width=20, height=20)
    assert not rasterize_mesh(sphere, away).mask.any()
    empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), int))
    assert not rasterize_mesh(empty, away).mask.any()


def test_a_hidden_inner_sphere_is_not_outer_visible(sphere):
    inner = sphere.with_vertices(sphere.vertices * 0.9)
    seen = outer_visible_faces(concatenate_meshes([sphere, inner]), views=24, resolution=512)
    assert seen[: sphere.face_count].mean() > 0.99
    assert not seen[sphere.face_count :].any()


def test_visible_points_stand_within_the_tolerance(sphere):
    points = sphere.vertices[::7]
    assert outer_visible_points(sphere, points, tolerance=2e-3).all()
    assert not outer_visible_points(sphere, 0.9 * points, tolerance=2e-3).any()


@pytest.mark.parametrize(
    ("change", "words"), [({"K": np.eye(2)}, r"K: expected.*\(3, 3\)"), ({"width": 0}, "at least 1 x 1")]
)
def test_bad_cameras_are_refused(change, words):
    values = {"K": np.eye(3), "cam_from_world": np.eye(4), "width": 4, "height": 4} | change
    with pytest.raises(InputError, match=words):
        Camera(**values)
