from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from avatar.rendering.barycentrics import barycentrics_reference
from avatar.rendering.mesh_maps import MapFrame, front_back_maps, mesh_maps, vertex_normal_map, vertex_normals
from smplxpp.core import Camera, InputError


def sphere(subdivisions: int = 2, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.5)
    return torch.tensor(np.asarray(ball.vertices), dtype=dtype), torch.tensor(np.asarray(ball.faces))


PERSPECTIVE = Camera.look_at(eye=(0.3, 0.2, 2.0), target=(0, 0, 0), fov_y_deg=40, width=40, height=30)
SKEWED = Camera(PERSPECTIVE.K + [[0, 3.0, 1.5], [0, 5.0, 0.7], [0, 0, 0]], PERSPECTIVE.cam_from_world, 40, 30)
PARALLEL = Camera.orthographic_view(center=(0, 0, 0), direction=(0.2, 0.3, 1), half_extent=0.7, size=32)
CAMERAS = pytest.mark.parametrize("camera", [PERSPECTIVE, SKEWED, PARALLEL], ids=["perspective", "skewed", "parallel"])


@CAMERAS
def test_barycentrics_and_depth_equal_the_reference(camera):
    v, f = sphere()
    maps = mesh_maps(v, f, camera)
    barycentric, depth = barycentrics_reference(v.double(), f, maps.face_id, camera)
    assert maps.mask.any() and not maps.mask.all()
    torch.testing.assert_close(maps.barycentric.double(), barycentric, atol=1e-5, rtol=0)
    torch.testing.assert_close(maps.depth.double(), depth, atol=1e-6, rtol=1e-6)
    np.testing.assert_allclose(maps.barycentric.sum(-1)[maps.mask], 1, atol=1e-6)


@CAMERAS
def test_positions_project_to_their_pixels(camera):
    v, f = sphere()
    maps = mesh_maps(v, f, camera)
    rows, cols = (k.numpy() for k in maps.mask.nonzero(as_tuple=True))
    screen = camera.screen_from_world(maps.interpolate(v)[maps.mask].double().numpy())
    np.testing.assert_allclose(screen[:, :2], np.stack([cols, rows], 1) + 0.5, atol=1e-4)
    np.testing.assert_allclose(screen[:, 2], maps.depth[maps.mask], rtol=1e-5)


@CAMERAS
def test_faces_are_those_that_rays_hit_first(camera):
    v, f = sphere()
    maps = mesh_maps(v, f, camera)
    rows, cols = np.mgrid[: camera.height, : camera.width] + 0.5
    rays = np.stack([cols, rows, np.ones_like(cols)], -1).reshape(-1, 3) @ np.linalg.inv(camera.K).T
    R, t = camera.cam_from_world[:3, :3], camera.cam_from_world[:3, 3]
    start = (rays * [1, 1, 0] if camera.orthographic else np.zeros_like(rays)) - t
    along = np.broadcast_to([0, 0, 1.0], rays.shape) if camera.orthographic else rays
    first = first_hits(start @ R, along @ R, v.double().numpy()[f]).reshape(camera.height, camera.width)
    assert (first == maps.face_id.numpy()).mean() > 0.998


def first_hits(start: np.ndarray, along: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Index of the triangle that each ray meets first, or -1 (Moeller and Trumbore 1997), each against each."""
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    p = np.cross(along[:, None], ac)
    det = (ab * p).sum(-1)
    from_a = start[:, None] - a
    q = np.cross(from_a, ab)
    u, w, t = (from_a * p).sum(-1) / det, (along[:, None] * q).sum(-1) / det, (ac * q).sum(-1) / det
    t[(u < 0) | (w < 0) | (u + w > 1)] = np.inf
    return np.where(np.isfinite(t).any(1), t.argmin(1), -1)


@CAMERAS
def test_gradcheck(camera):
    """float64 goes through the reference: its derivatives against differences of itself."""
    v, f = sphere(0, torch.float64)
    values = torch.rand(len(v), 2, dtype=torch.float64)

    def render(vertices, values):
        maps = mesh_maps(vertices, f, camera, values)
        return maps.attributes, maps.depth[maps.mask], maps.barycentric

    small = Camera(camera.K * [[0.2], [0.2], [1]], camera.cam_from_world, 8, 6, camera.orthographic)
    camera = small
    assert torch.autograd.gradcheck(render, (v.requires_grad_(), values.requires_grad_()), eps=1e-7, atol=1e-5)


@CAMERAS
def test_native_gradients_equal_the_reference(camera):
    v, f = sphere()
    values = torch.rand(len(v), 9)
    rng = torch.Generator().manual_seed(0)
    weights = None
    gradients = []
    for dtype in (torch.float32, torch.float64):
        vertices, attributes = (x.detach().to(dtype).clone().requires_grad_() for x in (v, values))
        maps = mesh_maps(vertices, f, camera, attributes)
        outputs = (maps.attributes, maps.depth[maps.mask], maps.barycentric, vertex_normal_map(maps, vertices))
        if weights is None:
            weights = [torch.randn(o.shape, generator=rng) for o in outputs]
        sum((o * w.to(dtype)).sum() for o, w in zip(outputs, weights, strict=True)).backward()
        gradients.append((vertices.grad.double(), attributes.grad.double()))
    for native, truth in zip(*gradients, strict=True):
        assert (native - truth).abs().max() <= 1e-5 * truth.abs().max()


def test_gradient_of_depth_alone_and_of_values_alone():
    v, f = sphere()
    v.requires_grad_()
    maps = mesh_maps(v, f, PERSPECTIVE)
    (depth,) = torch.autograd.grad(maps.depth[maps.mask].sum(), v, retain_graph=True)
    assert depth.abs().max() > 0
    values = torch.rand(len(v), 3, requires_grad=True)
    (by_values,) = torch.autograd.grad(mesh_maps(v.detach(), f, PERSPECTIVE).interpolate(values).sum(), values)
    # Every covered pixel hands out weight 1 a channel.
    np.testing.assert_allclose(by_values.sum(0), float(maps.mask.sum()), rtol=1e-5)


def test_nan_gradients_of_the_background_are_ignored():
    v, f = sphere()
    v.requires_grad_()
    maps = mesh_maps(v, f, PERSPECTIVE)
    (torch.where(maps.mask, maps.depth, torch.zeros(())) * maps.depth.detach().sqrt()).sum().backward()
    assert torch.isfinite(v.grad).all()


@CAMERAS
def test_renaming_faces_and_vertices_changes_no_value(camera):
    v, f = sphere()
    values = torch.rand(len(v), 4)
    rng = torch.Generator().manual_seed(0)
    faces, vertices = torch.randperm(len(f), generator=rng), torch.randperm(len(v), generator=rng)
    there = torch.argsort(vertices)[f][faces]
    a, b = mesh_maps(v, f, camera, values), mesh_maps(v[vertices], there, camera, values[vertices])
    torch.testing.assert_close(a.attributes, b.attributes, atol=1e-6, rtol=0)


def test_a_camera_moved_with_the_mesh_sees_the_same_and_normals_turn_along():
    v, f = sphere(dtype=torch.float64)
    world = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    world[:3, 3] = [3, -2, 1]
    there = Camera(PERSPECTIVE.K, PERSPECTIVE.cam_from_world @ np.linalg.inv(world), 40, 30)
    pose = torch.tensor(world)
    moved = v @ pose[:3, :3].T + pose[:3, 3]
    a, b = mesh_maps(v, f, PERSPECTIVE), mesh_maps(moved, f, there)
    same = a.face_id == b.face_id
    assert same.double().mean() > 0.99
    turned = vertex_normal_map(a, v) @ pose[:3, :3].T
    torch.testing.assert_close(turned[same], vertex_normal_map(b, moved)[same], atol=1e-9, rtol=0)


def test_normals_of_a_sphere_point_outwards():
    v, f = sphere(4)
    maps = mesh_maps(v, f, PERSPECTIVE)
    assert ((vertex_normals(v, f) * v).sum(-1) > 0.499).all()
    outwards = torch.nn.functional.normalize(maps.interpolate(v), dim=-1)
    assert ((vertex_normal_map(maps, v) * outwards).sum(-1)[maps.mask] > 0.999).all()
    assert (vertex_normal_map(maps, v)[~maps.mask] == 0).all()


def test_front_and_back_share_their_pixels():
    v, f = sphere(3)
    v = v * torch.tensor([1.0, 0.7, 0.4]) + torch.tensor([0.1, 1.0, 0.2])
    maps = front_back_maps(v, f, MapFrame.of(v.numpy()), size=64, attributes=v)
    assert maps.attributes.shape == (2, 64, 64, 3)
    both = maps.mask.all(0)
    assert both.any() and (maps.mask[0] == maps.mask[1]).float().mean() > 0.999
    front, back = maps.attributes[:, both].unbind(0)
    torch.testing.assert_close(front[:, :2], back[:, :2], atol=1e-5, rtol=0)
    assert (front[:, 2] > back[:, 2]).float().mean() > 0.99
    # Row 0 is the top, column 0 is -x.
    rows, cols = both.nonzero(as_tuple=True)
    torch.testing.assert_close(front[:, 0], 0.1 + (cols + 0.5) / 32 - 1, atol=1e-5, rtol=0)
    torch.testing.assert_close(front[:, 1], 1.0 + 1 - (rows + 0.5) / 32, atol=1e-5, rtol=0)


def test_the_same_bits_at_one_number_of_threads():
    v, f = sphere(3)
    grads = []
    for _ in range(2):
        vertices = v.clone().requires_grad_()
        mesh_maps(vertices, f, PERSPECTIVE, vertices).attributes.square().sum().backward()
        grads.append(vertices.grad)
    assert torch.equal(*grads)


@CAMERAS
@pytest.mark.parametrize("vertex_count", [0, 3])
def test_nothing_to_see_is_background(camera, vertex_count):
    v, f = torch.zeros(vertex_count, 3, requires_grad=True), torch.zeros(0, 3, dtype=torch.int64)
    maps = mesh_maps(v, f, camera, v)
    assert not maps.mask.any() and (maps.depth == torch.inf).all()
    assert (maps.attributes == 0).all() and (vertex_normal_map(maps, v) == 0).all()
    maps.attributes.sum().backward()
    assert (v.grad == 0).all()


def test_behind_the_camera_is_background():
    v, f = sphere()
    assert not mesh_maps(v + torch.tensor([0, 0, 5.0]), f, PERSPECTIVE).mask.any()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"vertices": torch.rand(4, 2)}, r"vertices.*\(N, 3\)"),
        ({"vertices": torch.zeros(4, 3, dtype=torch.int64)}, "floating-point"),
        ({"vertices": torch.full((4, 3), torch.nan)}, "finite"),
        ({"faces": torch.rand(2, 3)}, "integer"),
        ({"faces": torch.zeros(2, 4, dtype=torch.int64)}, r"faces.*\(N, 3\)"),
        ({"faces": torch.tensor([[0, 1, 4]])}, r"\[0, 4\)"),
        ({"faces": torch.tensor([[0, 1, -1]])}, r"indices in \[-1, 1\]"),
        ({"camera": []}, "one image size"),
        ({"camera": [PERSPECTIVE, PARALLEL]}, "one image size"),
        ({"attributes": torch.rand(3, 2)}, r"\(4, D\)"),
        ({"attributes": torch.rand(4)}, r"\(4, D\)"),
        ({"attributes": torch.zeros(4, 2, dtype=torch.int64)}, "floating-point"),
    ],
)
def test_bad_input_is_refused(change, words):
    good = {"vertices": torch.rand(4, 3), "faces": torch.tensor([[0, 1, 2]]), "camera": PERSPECTIVE}
    with pytest.raises(InputError, match=words):
        mesh_maps(**good | change)
