"""Gaussians from their triangles to the world."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from avatar.gaussians.binding import THICKNESS, BoundGaussians, topology_digest, world_from_frames, world_from_local
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.tensor_operations import matrix_from_quat
from smplxpp.core.errors import InputError
from tests.gaussians.bound_scenes import random_bound, rotation, sphere


def covariances(world):
    axes = matrix_from_quat(world.quats) * world.scales[..., None, :]
    return axes @ axes.mT


def test_the_equations_written_out():
    vertices, faces = sphere()
    bound = random_bound(faces)
    world = world_from_local(bound, vertices, faces)
    frames = triangle_frames(vertices, faces)
    for i in range(0, len(bound), 7):
        face = bound.face_index[i]
        v1, v2, v3 = vertices[faces[face]]
        R, (u, v) = frames.rotations[face], bound.barycentric[i]
        x = torch.tensor([1.0, 0, 0], dtype=torch.float64)
        r = matrix_from_quat(bound.quats[i])
        mean = u * v1 + v * v2 + (1 - u - v) * v3 + R @ (bound.normal_offset[i] * x + bound.offset[i])
        torch.testing.assert_close(world.means[i], mean)
        torch.testing.assert_close(matrix_from_quat(world.quats[i]), R @ r)
        torch.testing.assert_close(world.normals[i], R @ r @ x)
        torch.testing.assert_close(world.scales[i, 0], THICKNESS * frames.lengths[face])
        torch.testing.assert_close(world.scales[i, 1:], bound.log_scales[i].exp() * frames.lengths[face])
        torch.testing.assert_close(world.opacities[i], torch.sigmoid(bound.opacity_logits[i]))


def test_rigid_motion_carries_everything_along():
    vertices, faces = sphere()
    bound = random_bound(faces)
    turn, shift = rotation(2.0, -0.4, 1.1), torch.tensor([0.3, -2.0, 5.0], dtype=torch.float64)
    here = world_from_local(bound, vertices, faces)
    there = world_from_local(bound, vertices @ turn.T + shift, faces)
    torch.testing.assert_close(there.means, here.means @ turn.T + shift)
    torch.testing.assert_close(there.normals, here.normals @ turn.T)
    torch.testing.assert_close(there.scales, here.scales)
    torch.testing.assert_close(covariances(there), turn @ covariances(here) @ turn.T)


def test_a_larger_mesh_has_larger_gaussians():
    vertices, faces = sphere()
    bound = replace(random_bound(faces), offset=torch.zeros(40, 3, dtype=torch.float64))
    bound = replace(bound, normal_offset=torch.zeros(40, dtype=torch.float64))
    here, there = (world_from_local(bound, k * vertices, faces) for k in (1.0, 3.0))
    torch.testing.assert_close(there.means, 3.0 * here.means)
    torch.testing.assert_close(there.scales, 3.0 * here.scales)
    torch.testing.assert_close(there.normals, here.normals)


def test_order_does_not_matter():
    vertices, faces = sphere()
    bound = random_bound(faces)
    order = torch.randperm(len(bound), generator=torch.Generator().manual_seed(1))
    world, shuffled = (world_from_local(b, vertices, faces) for b in (bound, bound.select(order)))
    for name in ("means", "quats", "scales", "opacities", "normals"):
        torch.testing.assert_close(getattr(shuffled, name), getattr(world, name)[order])


def test_renumbered_faces_give_the_same_world():
    vertices, faces = sphere()
    bound = random_bound(faces)
    order = torch.randperm(len(faces), generator=torch.Generator().manual_seed(1))
    place = torch.argsort(order)
    again = replace(bound, face_index=place[bound.face_index], topology=topology_digest(faces[order]))
    torch.testing.assert_close(
        world_from_local(again, vertices, faces[order]).means, world_from_local(bound, vertices, faces).means
    )


def test_batches_of_poses():
    vertices, faces = sphere()
    bound = random_bound(faces)
    batch = torch.stack([vertices, vertices @ rotation(1, 0.2, 0).T])
    world = world_from_local(bound, batch, faces)
    assert world.means.shape == (2, len(bound), 3) and world.opacities.shape == (len(bound),)
    single = world_from_local(bound, batch[1], faces)
    for name in ("means", "quats", "scales", "normals"):
        torch.testing.assert_close(getattr(world, name)[1], getattr(single, name))


def test_gradients_to_attributes_and_vertices():
    vertices, faces = sphere(splits=1)
    bound = random_bound(faces, count=6)
    names = ("barycentric", "normal_offset", "offset", "log_scales", "quats", "opacity_logits")

    def values(vertices, *attributes):
        world = world_from_local(replace(bound, **dict(zip(names, attributes, strict=True))), vertices, faces)
        return world.means, world.quats, world.scales, world.opacities, world.normals

    inputs = [vertices, *(getattr(bound, name) for name in names)]
    assert torch.autograd.gradcheck(values, [x.clone().requires_grad_(True) for x in inputs])


def test_single_precision_agrees_with_double():
    vertices, faces = sphere()
    bound = random_bound(faces)
    world = world_from_local(bound, vertices, faces)
    single = world_from_local(bound.to(dtype=torch.float32), vertices.float(), faces)
    assert single.means.dtype == torch.float32
    torch.testing.assert_close(single.means.double(), world.means, atol=1e-6, rtol=0)
    torch.testing.assert_close(single.normals.double(), world.normals, atol=1e-5, rtol=0)


def test_frames_of_another_mesh_are_refused():
    vertices, faces = sphere()
    with pytest.raises(InputError, match="128 triangles"):
        world_from_frames(random_bound(faces), triangle_frames(vertices, faces[:-1]))


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("barycentric", lambda x: x[:, :1]),
        ("offset", lambda x: x[1:]),
        ("quats", lambda x: x.float()),
        ("face_index", lambda x: x.int()),
        ("sh", lambda x: x[:, :2]),
        ("sh", lambda x: x[..., 0]),
    ],
)
def test_tensors_that_do_not_fit_are_refused(name, change):
    _, faces = sphere()
    bound = random_bound(faces)
    with pytest.raises(InputError, match=name):
        replace(bound, **{name: change(getattr(bound, name))})


def test_topology_tells_meshes_apart():
    _, faces = sphere()
    bound = random_bound(faces)
    assert isinstance(bound, BoundGaussians)
    bound.check_topology(faces)
    bound.check_topology(faces.numpy().astype("int32"))
    for other in (faces[1:], faces.flip(0)):
        with pytest.raises(InputError, match="sample again"):
            bound.check_topology(other)
