"""Avatars of other kinds: they learn from photographs, repeat bit for bit, and stay what they claim to be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.baselines.avatar_base import PhotographConfig, PhotographTask
from avatar.baselines.build import make_baseline, outer_template
from avatar.baselines.point_mlp import PointMLPConfig
from avatar.baselines.textured_mesh import TexturedMeshConfig
from avatar.baselines.uv_unet import UVUNetConfig
from avatar.data.sequence import AvatarSequence
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from avatar.training.engine.resources import fixed_seed
from smplxpp.core import SKIN, InputError
from tests.dolls.swaying import TORSO, open_moving, params, template

SAMPLING = SamplingConfig(count=500)
KINDS = {
    "mlp": PointMLPConfig(width=16, hidden_layers=2, code_size=4),
    "uv": UVUNetConfig(size=32, channels=(8, 8, 8), features=4, code_size=4),
    "mesh": TexturedMeshConfig(FieldConfig(width=16, hidden_layers=2, code_size=4), SAMPLING),
}
STEPS = 8


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return open_moving(tmp_path_factory.mktemp("doll") / "capture")


@pytest.fixture(scope="module")
def sequence(capture):
    return AvatarSequence(capture, template())


def config(kind: str) -> PhotographConfig:
    attributes = 0.0 if kind == "mesh" else 0.5
    return PhotographConfig(iterations=STEPS, views=4, lr=2e-3, attributes=attributes, null_share=0.2)


def made(kind: str, rig: Rig):
    with fixed_seed(0):
        return make_baseline(KINDS[kind], rig, sample_on_mesh(rig.template, SAMPLING), (0, 1, 2, 3))


def trained(kind: str, sequence: AvatarSequence):
    """The model after `STEPS` steps, and the loss over the training frames before and after."""
    model = made(kind, sequence.rig)
    task = PhotographTask(sequence, model, config(kind))
    items = sequence.items(0, count=4, views=4, seed=0)

    def loss() -> float:
        with torch.no_grad():
            return sum(float(task.loss(item)[0]) for item in items)

    before = loss()
    for k in range(STEPS):
        task.step(k)
    task.iteration = 0
    return model, before, loss()


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_an_avatar(kind, sequence):
    model, camera_centers = made(kind, sequence.rig), torch.tensor([[0.0, 0.5, 2.0], [2.0, 0.5, 0.0]])
    for pose in (sequence.pose(1), sequence.pose(4)):  # a frame with a code, and one without
        posed = model(pose, camera_centers)
        assert posed.vertices.shape == (template().vertex_count, 3)
        assert posed.colors.shape == (2, len(posed.gaussians.means), 3)
        assert torch.isfinite(posed.colors).all() and torch.isfinite(posed.gaussians.means).all()
    assert model.rig is sequence.rig


@pytest.mark.parametrize("kind", ["mlp", "uv"])
def test_residuals_start_at_zero(kind, sequence):
    gaussians = sample_on_mesh(template(), SAMPLING)
    plain = Student(StudentConfig(field=None), sequence.rig, gaussians, ())
    pose, camera_centers = sequence.pose(2), torch.tensor([[0.0, 0.5, 2.0]])
    a, b = made(kind, sequence.rig)(pose, camera_centers), plain(pose, camera_centers)
    torch.testing.assert_close(a.gaussians.means, b.gaussians.means)
    torch.testing.assert_close(a.colors, b.colors)


@pytest.mark.parametrize("kind", KINDS)
def test_it_learns_and_repeats_bit_for_bit(kind, sequence):
    model, before, after = trained(kind, sequence)
    assert after < 0.9 * before
    again, _, _ = trained(kind, sequence)
    mine, other = model.state_dict(), again.state_dict()
    assert all(torch.equal(value, other[name]) for name, value in mine.items())


def test_a_networks_residuals_depend_on_pose_and_code(sequence):
    for kind in ("mlp", "uv"):
        model, _, _ = trained(kind, sequence)
        pose = sequence.pose(1)
        code = model.codes([1])[0]
        assert not torch.equal(model.residuals(pose, code), model.residuals(sequence.pose(2), code))
        assert not torch.equal(model.residuals(pose, code), model.residuals(pose, code + 1.0))


def test_texels_stay_on_the_surface_while_the_mesh_moves(sequence):
    model, _, _ = trained("mesh", sequence)
    start = made("mesh", sequence.rig).gaussians
    for name in ("offset", "normal_offset", "log_scales", "quats", "opacity_logits"):
        assert torch.equal(getattr(model.gaussians, name), getattr(start, name)), name
    assert not torch.equal(model.gaussians.dc, start.dc)
    posed = model(sequence.pose(1), torch.tensor([[0.0, 0.5, 2.0]]))
    assert posed.displacements.abs().max() > 0
    corners = posed.vertices[sequence.rig.faces[posed.bound.face_index]]
    u, v = posed.bound.barycentric.unbind(-1)
    on_face = (torch.stack([u, v, 1 - u - v], -1)[..., None] * corners).sum(1)
    torch.testing.assert_close(posed.gaussians.means, on_face, atol=1e-6, rtol=0.0)


def test_the_naked_body_carries_them_too(capture):
    naked = AvatarSequence(capture, template().naked())
    for kind in KINDS:
        posed = made(kind, naked.rig)(naked.pose(1), torch.tensor([[0.0, 0.5, 2.0]]))
        assert len(posed.vertices) == template().body.vertex_count


def test_an_outer_surface_has_no_layers():
    head = np.arange(TORSO, TORSO + 162)
    vertices = template().vertices.copy()
    vertices[head] = 0.5 * (vertices[head] - vertices[head].mean(axis=0)) + vertices[:TORSO].mean(axis=0)
    layered = replace(template(), vertices=vertices)  # the head is in the torso: no view sees it
    outer = outer_template(layered)
    assert not np.isin(outer.faces, head).any() and len(outer.faces) < len(layered.faces)
    assert set(outer.vertex_labels) == {SKIN.id} and not outer.cloth_mask.any()
    assert (outer.pose(params(1)) == layered.pose(params(1))).all()


@pytest.mark.parametrize(
    "make",
    [
        lambda: PointMLPConfig(width=0),
        lambda: PointMLPConfig(frequencies=-1),
        lambda: UVUNetConfig(size=8),
        lambda: UVUNetConfig(channels=()),
        lambda: PhotographConfig(iterations=1, null_share=2.0),
    ],
)
def test_sizes_that_cannot_be_are_refused(make):
    with pytest.raises(InputError):
        make()
