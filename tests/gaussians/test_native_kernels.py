"""The native kernels against their formulas in torch float64."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from avatar.gaussians import native_kernels
from avatar.gaussians.binding import world_from_frames, world_from_frames_reference
from avatar.gaussians.colors import view_colors, view_colors_reference
from avatar.gaussians.frames import TriangleFrames, triangle_frames, triangle_frames_reference
from smplxpp.core.errors import GeometryWarning
from smplxpp.native import _FEATURES, LEVELS, _cpu_features, native_library
from tests.gaussians.bound_scenes import random_bound, rotation, sphere

FRAMES = ("corners", "rotations", "quats", "lengths")
LOCAL = ("barycentric", "normal_offset", "offset", "log_scales", "quats")
WORLD = ("means", "quats", "scales", "normals")


@pytest.fixture(params=LEVELS)
def level(request, monkeypatch):
    """Every build of the library that this machine can run."""
    if not _FEATURES[request.param] <= _cpu_features():
        pytest.skip(f"this CPU has no {request.param}")
    monkeypatch.setattr(native_kernels, "native_library", lambda: native_library(request.param))
    return request.param


def grown(tensors: list[torch.Tensor], dtype: torch.dtype) -> list[torch.Tensor]:
    return [t.detach().to(dtype).requires_grad_(True) for t in tensors]


def close(ours: torch.Tensor, truth: torch.Tensor, tolerance: float = 1e-5) -> None:
    """Differences against the largest value of the truth."""
    assert ours.dtype == torch.float32 and ours.shape == truth.shape
    assert (ours.double() - truth).abs().max() <= tolerance * truth.abs().max()


def pulled_back(outputs: list[torch.Tensor], inputs: list[torch.Tensor], skip: int = -1) -> list[torch.Tensor]:
    """Gradients of a fixed random weighting of the outputs, but for one of them."""
    g = torch.Generator().manual_seed(0)
    weights = [torch.randn(o.shape, generator=g, dtype=torch.float64) for o in outputs]
    loss = sum((o * w).sum() for k, (o, w) in enumerate(zip(outputs, weights, strict=True)) if k != skip)
    return torch.autograd.grad(loss, inputs, allow_unused=True)


def poses(batch: int) -> tuple[torch.Tensor, torch.Tensor]:
    vertices, faces = sphere(dtype=torch.float32)
    turned = [vertices.double(), 1.3 * vertices.double() @ rotation(0.4, 3.0, 1.0).T]
    return (torch.stack(turned) if batch else turned[0]), faces


@pytest.mark.parametrize("batch", [0, 2])
def test_frames(level, batch):
    vertices, faces = poses(batch)
    (ours,), (truth,) = grown([vertices], torch.float32), grown([vertices], torch.float64)
    frames = triangle_frames(ours, faces)
    outputs = [getattr(frames, name) for name in FRAMES]
    expected = triangle_frames_reference(truth, faces)[:4]
    # A row of nearly equal entries may be chosen differently: the sign of a quaternion is free.
    sign = (outputs[2].detach().double() * expected[2].detach()).sum(-1, keepdim=True).sign()
    expected = [*expected[:2], expected[2] * sign, expected[3]]
    for a, b in zip(outputs, expected, strict=True):
        close(a, b)
    for skip in (-1, 0, 1, 2, 3):
        close(pulled_back(outputs, [ours], skip)[0], pulled_back(expected, [truth], skip)[0])
        outputs = [getattr(triangle_frames(ours, faces), name) for name in FRAMES]
        expected = triangle_frames_reference(truth, faces)[:4]
        expected = [*expected[:2], expected[2] * sign, expected[3]]


@pytest.mark.parametrize("batch", [0, 2])
@pytest.mark.parametrize("skip", [-1, 0, 1, 2, 3])
def test_world(level, batch, skip):
    vertices, faces = poses(batch)
    bound = random_bound(faces, count=500, dtype=torch.float32)
    frames = triangle_frames(vertices.float(), faces)

    def run(dtype, function):
        inputs = grown([*(getattr(bound, n) for n in LOCAL), *(getattr(frames, n) for n in FRAMES)], dtype)
        local = replace(bound.to(dtype=dtype), **dict(zip(LOCAL, inputs, strict=False)))
        world = function(local, TriangleFrames(*inputs[len(LOCAL) :]))
        outputs = [getattr(world, name) for name in WORLD]
        return outputs, pulled_back(outputs, inputs, skip)

    outputs, gradients = run(torch.float32, world_from_frames)
    expected, expected_gradients = run(torch.float64, world_from_frames_reference)
    for a, b in zip([*outputs, *gradients], [*expected, *expected_gradients], strict=True):
        if b is None:  # the kernel answers 0 for what does not depend on an input
            assert a is None or not a.any()
        else:
            close(a, b)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colors(level, degree):
    vertices, faces = poses(0)
    bound = random_bound(faces, count=500, degree=degree, dtype=torch.float32)
    bound = replace(bound, dc=bound.dc - 0.3, sh=3 * bound.sh)
    frames = triangle_frames(vertices.float(), faces)
    means = world_from_frames(bound, frames).means
    cameras = torch.tensor([[0.0, 1.0, 3.0], [2.0, 0.0, -1.0], [0.3, 5.0, 0.0]])

    def run(dtype, function):
        inputs = grown([frames.rotations, bound.dc, bound.sh, means, cameras], dtype)
        R, dc, sh, m, c = inputs
        colors = function(replace(bound.to(dtype=dtype), dc=dc, sh=sh), replace(frames, rotations=R), m, c)
        return [colors], pulled_back([colors], inputs)

    outputs, gradients = run(torch.float32, view_colors)
    expected, expected_gradients = run(torch.float64, view_colors_reference)
    assert (outputs[0] == 0).any() and (outputs[0] > 0).any()
    for a, b in zip([*outputs, *gradients], [*expected, *expected_gradients], strict=True):
        if b is None or not b.numel():
            assert a is None or not a.any()
        else:
            close(a, b, 2e-5)


def test_black_can_brighten():
    vertices, faces = sphere(dtype=torch.float32)
    bound = random_bound(faces, dtype=torch.float32)
    dc = torch.zeros_like(bound.dc, requires_grad=True)
    frames = triangle_frames(vertices, faces)
    bound = replace(bound, dc=dc, sh=torch.zeros_like(bound.sh))
    view_colors(bound, frames, frames.corners[bound.face_index, 0], torch.zeros(1, 3)).sum().backward()
    torch.testing.assert_close(dc.grad, torch.ones_like(dc))


def test_the_same_bits_at_any_number_of_threads():
    vertices, faces = sphere(dtype=torch.float32)
    bound = random_bound(faces, count=3000, degree=2, dtype=torch.float32)

    def gradients():
        inputs = grown([vertices, *(getattr(bound, n) for n in LOCAL), bound.dc, bound.sh], torch.float32)
        local = replace(bound, **dict(zip((*LOCAL, "dc", "sh"), inputs[1:], strict=True)))
        frames = triangle_frames(inputs[0], faces)
        world = world_from_frames(local, frames)
        colors = view_colors(local, frames, world.means, torch.tensor([[0.0, 0, 3]]))
        return pulled_back([*(getattr(world, name) for name in WORLD), colors], inputs)

    before = torch.get_num_threads()
    try:
        results = []
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            results.append(gradients())
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_triangles_without_area_are_clamped_as_in_torch():
    triangles = [
        [(0, 0, 0), (0, 0, 0), (0, 0, 0)],
        [(1, 1, 1), (1, 1, 1), (1, 1, 1.001)],
        [(0, 0, 0), (1, 0, 0), (3, 0, 0)],
        [(1, 0, 0), (0, 0, 0), (2, 0, 0)],
        [(0, 0, 0), (0, 1e-14, 0), (0, 0, 1e-14)],
        [(0, 0, 0), (1, 0, 0), (0, 1, 0)],
    ]
    vertices = torch.tensor(triangles).reshape(-1, 3)
    faces = torch.arange(len(vertices)).reshape(-1, 3)
    with pytest.warns(GeometryWarning, match="5 triangles"):
        frames = triangle_frames(vertices, faces)
    *expected, count = triangle_frames_reference(vertices, faces)
    assert count == 5
    for name, b in zip(FRAMES, expected, strict=True):
        torch.testing.assert_close(getattr(frames, name), b)


def test_no_gaussians_and_no_faces():
    vertices, faces = sphere(dtype=torch.float32)
    none = random_bound(faces, count=0, dtype=torch.float32)
    frames = triangle_frames(vertices, faces)
    assert world_from_frames(none, frames).means.shape == (0, 3)
    assert view_colors(none, frames, torch.zeros(0, 3), torch.zeros(2, 3)).shape == (2, 0, 3)
    assert triangle_frames(vertices, faces[:0]).rotations.shape == (0, 3, 3)
