"""Frames of triangles."""

from __future__ import annotations

import pytest
import torch

from avatar.gaussians.frames import MIN_EDGE, triangle_frames
from avatar.gaussians.tensor_operations import matrix_from_quat
from smplxpp.core.errors import GeometryWarning, InputError
from tests.gaussians.bound_scenes import rotation, sphere


def test_a_known_triangle():
    vertices = torch.tensor([[0.0, 0, 0], [2, 0, 0], [0, 2, 0]], dtype=torch.float64)
    frames = triangle_frames(vertices, torch.tensor([[0, 1, 2]]))
    half = 0.5**0.5
    expected = torch.tensor([[0, half, -half], [0, half, half], [1, 0, 0]], dtype=torch.float64)
    torch.testing.assert_close(frames.rotations[0], expected)
    torch.testing.assert_close(frames.lengths, torch.tensor([(4 + 8**0.5) / 3], dtype=torch.float64))


def test_frames_are_rotations_with_outward_normals():
    vertices, faces = sphere()
    frames = triangle_frames(vertices, faces)
    R = frames.rotations
    eye = torch.eye(3, dtype=R.dtype).expand_as(R)
    torch.testing.assert_close(R.mT @ R, eye, atol=1e-14, rtol=0)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(faces), dtype=R.dtype))
    torch.testing.assert_close(matrix_from_quat(frames.quats), R, atol=1e-14, rtol=0)
    outward = frames.corners.mean(-2) - vertices.mean(0)
    assert (R[..., 0] * outward).sum(-1).min() > 0


def test_frames_turn_with_the_mesh_and_grow_with_it():
    vertices, faces = sphere()
    turn = rotation(0.3, -2.0, 0.7)
    frames = triangle_frames(vertices, faces)
    moved = triangle_frames(2.5 * vertices @ turn.T + 3.0, faces)
    torch.testing.assert_close(moved.rotations, turn @ frames.rotations)
    torch.testing.assert_close(moved.lengths, 2.5 * frames.lengths)


def test_batches_are_single_frames_side_by_side():
    vertices, faces = sphere()
    batch = torch.stack([vertices, vertices @ rotation(1, 0, 0).T, 2 * vertices]).reshape(3, 1, -1, 3)
    frames = triangle_frames(batch, faces)
    assert frames.rotations.shape == (3, 1, len(faces), 3, 3) and frames.face_count == len(faces)
    single = triangle_frames(batch[1, 0], faces)
    for name in ("corners", "rotations", "quats", "lengths"):
        torch.testing.assert_close(getattr(frames, name)[1, 0], getattr(single, name), atol=0, rtol=0)


def test_gradients():
    vertices, faces = sphere(splits=1)

    def values(vertices):
        frames = triangle_frames(vertices, faces[::5])
        return frames.rotations, frames.quats, frames.lengths

    assert torch.autograd.gradcheck(values, vertices.requires_grad_(True))


@pytest.mark.parametrize(
    "triangle",
    [
        [(0, 0, 0), (0, 0, 0), (0, 0, 0)],
        [(1, 1, 1), (1, 1, 1), (1, 1, 1.001)],
        [(0, 0, 0), (1, 0, 0), (3, 0, 0)],
        [(1, 0, 0), (0, 0, 0), (2, 0, 0)],  # the first corner is the middle of the opposite edge
        [(0, 0, 0), (0, 1e-14, 0), (0, 0, 1e-14)],  # smaller than rounding
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_triangles_without_area_still_get_a_rotation(triangle, dtype):
    vertices = torch.tensor([*triangle, (0, 1, 0), (1, 1, 0), (0, 1, 1)], dtype=dtype, requires_grad=True)
    with pytest.warns(GeometryWarning, match="1 triangles without area"):
        frames = triangle_frames(vertices, torch.tensor([[0, 1, 2], [3, 4, 5]]))
    R = frames.rotations.detach()
    torch.testing.assert_close(R.mT @ R, torch.eye(3, dtype=dtype).expand(2, 3, 3))
    assert (torch.linalg.det(R) > 0).all() and frames.lengths.min() >= MIN_EDGE
    (frames.rotations.sum() + frames.quats.sum() + frames.lengths.sum()).backward()
    assert torch.isfinite(vertices.grad).all()
    assert vertices.grad[3:].abs().max() > 0


def test_a_thin_but_sound_triangle_is_left_alone():
    vertices = torch.tensor([[0, 0, 0], [1, 0, 0], [0.5, 1e-3, 0]])
    frames = triangle_frames(vertices, torch.tensor([[0, 1, 2]]))  # a warning would be an error
    torch.testing.assert_close(frames.rotations[0, :, 0], torch.tensor([0.0, 0.0, 1.0]))


@pytest.mark.parametrize(
    ("vertices", "faces", "subject"),
    [
        (torch.zeros(4, 2), torch.zeros(1, 3, dtype=torch.int64), "vertices"),
        (torch.zeros(4, 3, dtype=torch.int64), torch.zeros(1, 3, dtype=torch.int64), "vertices"),
        (torch.zeros(4, 3), torch.zeros(3, dtype=torch.int64), "faces"),
        (torch.zeros(4, 3), torch.zeros(1, 3, dtype=torch.int32), "faces"),
    ],
)
def test_bad_input(vertices, faces, subject):
    with pytest.raises(InputError, match=subject):
        triangle_frames(vertices, faces)
