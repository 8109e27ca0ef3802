"""Triton's kernels of a student against torch, by Triton's interpreter, which needs no GPU."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

pytest.importorskip("triton")

from avatar.gaussians.binding import world_from_frames
from avatar.gaussians.frames import triangle_frames
from avatar.models.fused_kernels import FusedGaussians
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.deformation_field import FieldConfig
from avatar.rig.rig import Rig
from tests.dolls.dancing import dance, gaussians, template, varied
from tests.models.test_avatars import EYES, SHAPES, disturb, student, whole_student

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig(template())


def assert_same(found, truth) -> None:
    for name in ("means", "scales", "opacities"):
        torch.testing.assert_close(getattr(found.gaussians, name), getattr(truth.gaussians, name), rtol=0, atol=2e-6)
    torch.testing.assert_close(found.vertices, truth.vertices, rtol=0, atol=1e-6)
    for name in ("offset", "dc"):
        torch.testing.assert_close(getattr(found.bound, name), getattr(truth.bound, name), rtol=0, atol=2e-6)
    # A micrometre of the vertices turns a triangle of centimetres by 1e-4 at most. A quaternion and its negative are
    # one rotation.
    a, b = found.gaussians.quats, truth.gaussians.quats
    torch.testing.assert_close(a * torch.sign((a * b).sum(-1, keepdim=True)), b, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.gaussians.normals, truth.gaussians.normals, rtol=0, atol=1e-4)
    torch.testing.assert_close(found.colors, truth.colors, rtol=0, atol=2e-5)


@pytest.mark.parametrize("shapes", [None, SHAPES, replace(SHAPES, gated=True), replace(SHAPES, parts=3)])
@pytest.mark.parametrize("field", [None, FieldConfig(frequencies=2, width=16, hidden_layers=1), FieldConfig(width=24)])
def test_a_fused_student_is_that_of_torch(rig, shapes: BlendShapeConfig | None, field):
    made = student(rig, blend_shapes=shapes, field=field).eval()
    for part in (made.field, made.blend_shapes):
        if part is not None:
            disturb(part)
    fast, params = made.compiled(fused=True), dance().frame(4)
    assert_same(fast(params, EYES[0].numpy()), made.compiled()(params, EYES[0].numpy()))
    assert fast.fused


def test_a_student_with_control_points_local_poses_and_pruned_shapes(rig):
    config = FieldConfig(width=20, local_pose=1)
    made = student(
        rig, blend_shapes=replace(SHAPES, gated=True), field=config, control_points=30, still_body=True
    ).eval()
    disturb(made.field)
    disturb(made.blend_shapes)
    made.blend_shapes = made.blend_shapes.pruned(torch.ones(1, SHAPES.shapes), keep=0.4)
    params = dance().frame(2)
    fast = made.compiled(fused=True)
    assert_same(fast(params, EYES[1].numpy()), made.compiled()(params, EYES[1].numpy()))
    assert fast.fused


def test_a_regression_stands_for_the_field(rig):
    made, params = whole_student(rig), dance().frame(4)
    fast = made.compiled(fused=True)
    assert_same(fast(params, EYES[0].numpy()), made.compiled()(params, EYES[0].numpy()))
    assert fast.fused


def test_triangles_without_area_and_without_length_have_the_frames_of_torch():
    corners = torch.tensor([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [3, 1e-9, 0]], dtype=torch.float32)
    faces = torch.tensor([[0, 1, 2], [0, 1, 3], [1, 1, 1], [0, 3, 1], [2, 2, 0], [0, 1, 4]])
    bound = varied(gaussians(60))
    bound = replace(bound, face_index=torch.arange(60) % len(faces), face_count=len(faces))
    with pytest.warns(match="without area"):
        truth = world_from_frames(bound, triangle_frames(corners, faces))
    found, _, _ = FusedGaussians(bound, faces, None)(corners, None, EYES[0])
    assert found.quats.isfinite().all()
    whole = bound.face_index == 0
    torch.testing.assert_close(found.means[whole], truth.means[whole], rtol=0, atol=1e-6)
    torch.testing.assert_close(found.scales, truth.scales, rtol=1e-5, atol=1e-9)
    # Any normal across the longest direction is right where a triangle has no area.
    torch.testing.assert_close(found.normals.norm(dim=-1), torch.ones(60))


@pytest.mark.parametrize("regression", [True, False])
def test_half_precision_moves_gaussians_no_more_than_that_of_torch(rig, regression):
    """Weights and activations are rounded, but not the sums."""
    made, params = whole_student(rig), dance().frame(4)
    if not regression:
        made.regression = None
    truth = made.compiled()(params, EYES[0].numpy()).gaussians.means
    apart = {}
    for fused in (True, False):
        fast = made.compiled(fused=fused, dtype=torch.float16)
        found = fast(params, EYES[0].numpy())
        assert fast.fused == fused and found.gaussians.means.dtype == torch.float32
        apart[fused] = float((found.gaussians.means - truth).norm(dim=1).max())
    assert 0.0 < apart[True] <= 1.1 * apart[False] and apart[True] < 1e-4


def test_kernels_that_fail_or_differ_are_left_out_with_a_warning(rig, monkeypatch, caplog):
    made, params = whole_student(rig), dance().frame(4)
    truth = made.compiled()(params, EYES[0].numpy())

    def fail(*args):
        raise RuntimeError("no compiler\nand more")

    wrong = lambda self, vertices, z, center: right(self, vertices + 0.01, z, center)  # noqa: E731
    right = FusedGaussians.__call__
    for call, why in ((fail, "no compiler"), (wrong, "differ by")):
        monkeypatch.setattr(FusedGaussians, "__call__", call)
        fast = made.compiled(fused=True)
        assert torch.equal(fast(params, EYES[0].numpy()).gaussians.means, truth.gaussians.means) and not fast.fused
        assert why in caplog.text and "and more" not in caplog.text
