"""Teacher and student as avatars: what they are before they learn, what each part of them moves, and gradients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from avatar.gaussians.binding import world_from_local
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models import fused_kernels
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.pose_dependence import PoseRegression
from avatar.models.student import Student, StudentConfig
from avatar.models.teacher_avatar import HALF_EXTENT, TeacherAvatar, map_frame
from avatar.rig.rig import Rig
from smplxpp.core.errors import InputError
from tests.dolls.dancing import dance, gaussians, template, varied
from tests.dolls.tiny import TINY_FIELD, TINY_TEACHER
from tests.pretended_cuda import CountedWaits, pretended_cuda

EYES = torch.tensor([[0.0, 0.8, 2.0], [1.5, 0.2, -1.0]])
SHAPES = BlendShapeConfig(expression_size=2, head_shapes=2, body_shapes=3, width=8, jaw=True)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig(template())


@pytest.fixture
def pose(rig):
    return rig.pose(dance().frame(3), frame=3)


def student(rig, **config) -> Student:
    torch.manual_seed(0)
    return Student(StudentConfig(**{"field": TINY_FIELD, **config}), rig, varied(gaussians()), (0, 1, 2, 3))


def disturb(module) -> None:
    """Give every parameter of a part another value."""
    random = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for value in module.parameters():
            value.add_(0.05 * torch.randn(value.shape, generator=random).to(value.device))


def test_a_teacher_without_residuals_is_skinning(rig, pose):
    teacher = TeacherAvatar(TINY_TEACHER, rig, varied(gaussians()))
    posed = teacher(pose, EYES)
    bound = varied(gaussians())
    expected = world_from_local(bound, rig.skin(pose), rig.faces)
    for name in ("means", "scales", "opacities"):
        torch.testing.assert_close(getattr(posed.gaussians, name), getattr(expected, name), rtol=0, atol=1e-6)
    quats = expected.quats / expected.quats.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(posed.gaussians.quats, quats, rtol=0, atol=1e-6)
    torch.testing.assert_close(posed.vertices, rig.skin(pose))
    assert posed.displacements is None and posed.colors.shape == (2, len(bound), 3)


def test_a_student_is_skinning_before_it_learns(rig, pose):
    for model in (student(rig), student(rig, blend_shapes=SHAPES), student(rig, field=None)):
        posed = model(pose, EYES)
        expected = world_from_local(varied(gaussians()), rig.skin(pose), rig.faces)
        torch.testing.assert_close(posed.gaussians.means, expected.means, rtol=0, atol=1e-6)
        torch.testing.assert_close(posed.vertices, rig.skin(pose), rtol=0, atol=1e-6)


def test_teacher_and_student_agree_where_neither_has_learned(rig, pose):
    teacher = TeacherAvatar(TINY_TEACHER, rig, varied(gaussians()))
    own = Student(StudentConfig(field=TINY_FIELD), rig, teacher.gaussians.snapshot(), (3,))
    a, b = teacher(pose, EYES), own(pose, EYES)
    torch.testing.assert_close(a.colors, b.colors, rtol=0, atol=1e-5)
    torch.testing.assert_close(a.gaussians.means, b.gaussians.means, rtol=0, atol=1e-6)


def test_a_position_residual_moves_gaussians_along_the_axes_of_the_t_pose(rig):
    """At rest a map that is constant moves every Gaussian it reaches by the same vector, whatever its triangle."""
    teacher = TeacherAvatar(TINY_TEACHER, rig, gaussians())
    pose = rig.pose(replace(dance().frame(0), **_rest(dance().frame(0))))
    maps = teacher.residual_maps(pose, EYES)
    moved = maps.shape.clone()
    moved[..., 0] += 0.02 / maps.position_scale
    before = teacher.posed(pose, EYES, maps).gaussians.means
    after = teacher.posed(pose, EYES, replace(maps, shape=moved)).gaussians.means
    root = pose.world_from_rest[0, :, :3]
    torch.testing.assert_close(
        after - before, (root @ torch.tensor([0.02, 0.0, 0.0])).expand_as(before), rtol=0, atol=2e-5
    )


def _rest(params) -> dict:
    names = ("global_orient", "body_pose", "jaw_pose", "leye_pose", "reye_pose", "left_hand_pose", "right_hand_pose")
    return {name: 0.0 * getattr(params, name) for name in (*names, "expression", "transl")}


def test_the_teachers_inputs_do_not_know_where_the_person_stands(rig):
    teacher = TeacherAvatar(TINY_TEACHER, rig, gaussians())
    params = dance().frame(2)
    away = replace(params, transl=params.transl + [[0.7, -0.2, 1.3]])
    shift = torch.tensor([0.7, -0.2, 1.3])
    one = teacher.inputs(rig.pose(params), EYES)
    two = teacher.inputs(rig.pose(away), EYES + shift)
    torch.testing.assert_close(one.positions, two.positions, rtol=0, atol=1e-5)
    assert one.positions.shape == (1, 2, 16, 16, 3)
    if one.cosines is not None:
        torch.testing.assert_close(one.cosines, two.cosines, rtol=0, atol=1e-4)


CENTRED = replace(TINY_TEACHER, centred=True)


def test_centred_inputs_have_mean_zero_and_deviation_one(rig):
    teacher, plain = (TeacherAvatar(config, rig, gaussians()) for config in (CENTRED, TINY_TEACHER))
    poses = [rig.pose(dance().frame(frame)) for frame in range(6)]
    teacher.centre(poses)
    shown = torch.cat([teacher.inputs(pose, EYES).positions for pose in poses])[:, teacher.maps.mask]
    torch.testing.assert_close(shown.mean(0), torch.zeros(shown.shape[1:]), rtol=0, atol=1e-4)
    assert float(shown.square().mean().sqrt()) == pytest.approx(1.0, rel=1e-3)
    assert torch.equal(teacher.inputs(poses[2], EYES).positions, teacher.position_input(poses[2]))
    # Only the position is shown otherwise, and a teacher that is not centred has nothing to learn.
    plain.centre(poses)
    assert not list(set(plain.state_dict()) & {"mean_positions", "deviation"})
    one, two = teacher.inputs(poses[1], EYES), plain.inputs(poses[1], EYES)
    back = one.positions * teacher.deviation + teacher.mean_positions
    torch.testing.assert_close(back, two.positions, rtol=0, atol=1e-5)
    assert (one.cosines is None and two.cosines is None) or torch.equal(one.cosines, two.cosines)


def test_poses_that_do_not_differ_are_not_told_apart(rig):
    teacher = TeacherAvatar(CENTRED, rig, gaussians())
    pose = rig.pose(dance().frame(1))
    teacher.centre([pose, pose])
    assert teacher.position_input(pose).abs().max() < 1e-2 and teacher.deviation > 0


@pytest.mark.parametrize("config", [TINY_TEACHER, CENTRED, replace(CENTRED, bottleneck=2, position_size=16)])
def test_displacement_maps_of_poses_are_those_of_all_residuals(rig, config):
    torch.manual_seed(0)
    teacher = TeacherAvatar(replace(config, zero_output=False), rig, gaussians())
    poses = [rig.pose(dance().frame(frame)) for frame in (1, 3)]
    teacher.centre(poses)
    with torch.no_grad():
        together = teacher.displacement_maps(poses)
        one_by_one = torch.cat([teacher.residual_maps(pose, EYES).position for pose in poses])
    assert together.abs().max() > 0
    torch.testing.assert_close(together, one_by_one, rtol=1e-4, atol=1e-6)


def test_the_maps_frame_holds_a_tall_body():
    assert map_frame(Rig(template())).half_extent == HALF_EXTENT
    tall = replace(template(), vertices=3.0 * template().vertices)
    frame = map_frame(Rig(tall))
    inside = abs(tall.vertices[:, :2] - torch.tensor(frame.center).numpy()[:2]) < frame.half_extent
    assert inside.all() and frame.half_extent > HALF_EXTENT


def test_codes_and_pose_move_the_mesh_of_a_disturbed_field(rig, pose):
    model = student(rig)
    disturb(model.field)
    with torch.no_grad():
        model.codes.codes[3] = 1.0
    known, null = model.displacements(pose), model.displacements(pose.without_code())
    other = model.displacements(rig.pose(dance().frame(1)))
    assert known.shape == (template().vertex_count, 3)
    for different in (null, other):
        assert (known - different).abs().max() > 1e-4
    unknown = model.displacements(rig.pose(dance().frame(3), frame=99))
    torch.testing.assert_close(unknown, null)
    posed = model(pose, EYES)
    torch.testing.assert_close(posed.vertices, rig.skin(pose, known))
    frames = triangle_frames(posed.vertices, rig.faces)
    assert posed.gaussians.means.shape[0] == len(model.gaussians) and torch.isfinite(frames.rotations).all()


@pytest.mark.parametrize("change", [{}, {"gated": True}, {"parts": 5}, {"gated": True, "parts": 3}])
def test_blend_shapes_of_every_kind_add_to_offset_and_colour(rig, pose, change):
    model = student(rig, blend_shapes=replace(SHAPES, **change))
    disturb(model.blend_shapes)
    moved, plain = model.compensated(pose), model.gaussians()
    jaw, expression, body_pose = pose.jaw[None], pose.expression[None], pose.body_pose[None]
    du, dc = model.blend_shapes(model.blend_shapes.coefficients(expression, body_pose, jaw))
    torch.testing.assert_close(moved.offset - plain.offset, du[0], rtol=0, atol=1e-6)
    torch.testing.assert_close(moved.dc - plain.dc, dc[0], rtol=0, atol=1e-6)
    assert du.abs().min(dim=-1).values.max() > 0 and torch.equal(moved.log_scales, plain.log_scales)
    if change.get("gated"):
        head = model.blend_shapes.head_weight > 0
        assert 0 < head.sum() < len(head)


def test_gated_head_shapes_answer_to_expression_on_the_head_alone(rig):
    model = student(rig, blend_shapes=replace(SHAPES, gated=True))
    disturb(model.blend_shapes)
    params = dance().frame(3)
    calm, smiling = (rig.pose(replace(params, expression=params.expression + e)) for e in (0.0, 1.0))
    moved = (model.compensated(smiling).offset - model.compensated(calm).offset).norm(dim=-1)
    head = model.blend_shapes.head_weight > 0
    assert moved[head].min() > 0 and moved[~head].max() == 0


def test_pruned_blend_shapes_leave_the_others_as_they_are(rig, pose):
    model = student(rig, blend_shapes=SHAPES)
    disturb(model.blend_shapes)
    small = model.with_blend_shapes(model.blend_shapes.pruned(torch.ones(1, 5), keep=0.25))
    active = small.blend_shapes.active
    assert len(active) == len(model.gaussians) // 4
    a, b, plain = model.compensated(pose).offset, small.compensated(pose).offset, model.gaussians().offset
    torch.testing.assert_close(a[active], b[active])
    rest = torch.ones(len(plain), dtype=torch.bool)
    rest[active] = False
    assert torch.equal(b[rest], plain[rest])


def test_new_blend_shapes_keep_field_codes_and_gaussians(rig, pose):
    model = student(rig)
    disturb(model)
    other = model.with_blend_shapes(SHAPES)
    torch.testing.assert_close(model(pose, EYES).gaussians.means, other(pose, EYES).gaussians.means)
    torch.testing.assert_close(model(pose, EYES).colors, other(pose, EYES).colors)
    with torch.no_grad():
        other.gaussians.dc.add_(1.0)
        next(other.field.parameters()).add_(1.0)
    assert not torch.equal(model.gaussians.dc, other.gaussians.dc)  # no memory is shared
    assert other.with_blend_shapes(None).blend_shapes is None


def test_gradients_reach_every_part_and_colours_do_not_pull_positions(rig, pose):
    model = student(rig, blend_shapes=SHAPES)
    disturb(model)
    model(pose, EYES).gaussians.means.square().sum().backward()
    parts = (model.field, model.codes, model.blend_shapes.head, model.blend_shapes.body)
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in model.codes.parameters())
    assert all(any(p.grad is not None and p.grad.abs().sum() > 0 for p in part.parameters()) for part in parts)
    model.zero_grad()
    model(pose, EYES).colors.sum().backward()
    assert model.gaussians.offset.grad is None or not model.gaussians.offset.grad.any()
    assert model.gaussians.sh.grad.abs().sum() > 0


def test_a_fields_gradient_is_that_of_finite_differences(rig, pose):
    model = student(rig)
    disturb(model)
    last = model.field.body.last.bias
    weight = torch.randn(len(model.gaussians), 3, generator=torch.Generator().manual_seed(2))

    def loss() -> torch.Tensor:
        return (model(pose, EYES).gaussians.means * weight).sum()

    loss().backward()
    gradient, step = last.grad.clone(), 1e-2
    for axis in range(3):
        values = []
        for sign in (1.0, -1.0):
            with torch.no_grad():
                last[axis] += sign * step
                values.append(float(loss()))
                last[axis] -= sign * step
        assert (values[0] - values[1]) / (2 * step) == pytest.approx(float(gradient[axis]), rel=2e-2, abs=0.05)


def test_a_field_on_control_points_and_a_template_without_clothes(pose):
    naked = replace(template(), vertex_labels=0 * template().vertex_labels)
    rig = Rig(naked)
    model = student(rig, control_points=40)
    disturb(model)
    assert not rig.cloth_mask.any()
    posed = model(rig.pose(dance().frame(3), frame=3), EYES)
    posed.gaussians.means.sum().backward()
    assert torch.isfinite(posed.gaussians.means).all() and posed.displacements.abs().max() > 0


def test_a_still_body_follows_its_joints_alone(rig, pose):
    model = student(rig, still_body=True, control_points=40)
    disturb(model)
    moved = model.displacements(pose)
    assert not moved[rig.body_mask].any() and moved[~rig.body_mask].abs().max() > 0
    naked = Rig(template().naked())
    bound = sample_on_mesh(naked.template, SamplingConfig(count=300, sh_degree=1))
    alone = Student(StudentConfig(field=TINY_FIELD, still_body=True), naked, bound, (0,))
    disturb(alone)
    assert alone.displacements(naked.pose(dance().frame(3))).abs().max() > 0


def whole_student(rig) -> Student:
    """A student with everything that moves it in new poses: regression, gate, gated blend shapes."""
    random = torch.Generator().manual_seed(2)
    made = student(rig, blend_shapes=replace(SHAPES, gated=True))
    points = len(made.field.points)
    tensors = [0.01 * torch.randn(shape, generator=random) for shape in PoseRegression.shapes(points, 2).values()]
    tensors[4:] = tensors[4] - 1.0, tensors[5] + 1.0
    known = torch.stack([rig.pose(dance().frame(k)).body_pose for k in range(3)])
    shapes = made.blend_shapes
    made = Student(
        made.config, rig, varied(gaussians()), (0, 1), blend_shapes=shapes, known_poses=known,
        regression=PoseRegression(*(one.to(rig.device) for one in tensors)),
    )  # fmt: skip
    disturb(made.blend_shapes)
    return made.eval()


@pytest.mark.parametrize("regression", [True, False])
def test_a_compiled_student_is_the_student_with_its_pose_computed_in_torch(rig, regression):
    made = whole_student(rig)
    if not regression:
        made.regression = None
        disturb(made.field)
    fast = made.compiled()
    for k in (4, 1):
        params = dance().frame(k)
        with torch.no_grad():
            truth = made(rig.pose(params), EYES[:1])
        found = fast(params, EYES[0].numpy())
        torch.testing.assert_close(found.gaussians.means, truth.gaussians.means, rtol=0, atol=2e-6)
        torch.testing.assert_close(found.colors, truth.colors, rtol=0, atol=2e-5)
    assert not fast.recorded


def test_half_precision_moves_a_compiled_student_by_less_than_a_tenth_of_a_millimetre(rig):
    made, params = whole_student(rig), dance().frame(4)
    whole, half = (made.compiled(dtype=dtype)(params, EYES[0].numpy()) for dtype in (torch.float32, torch.float16))
    apart = (whole.gaussians.means - half.gaussians.means).norm(dim=1).max()
    assert 0.0 < apart < 1e-4 and (whole.colors - half.colors).abs().max() < 2e-3
    assert made.blend_shapes.U.dtype == torch.float32 and half.gaussians.means.dtype == torch.float32


def test_a_compiled_student_on_a_gpu_waits_for_nothing_and_says_when_it_has_no_graph(caplog):
    with pretended_cuda():
        rig = Rig(template(), "cuda")
        fast = whole_student(rig).compiled()
        first = fast(dance().frame(0), EYES[0].numpy()).gaussians.means.cpu()
        with CountedWaits() as counted:
            second = fast(dance().frame(4), EYES[0].numpy())
        assert (second.gaussians.means.cpu() - first).abs().max() > 1e-3
    assert (counted.count, counted.sent) == (0, 1)  # the parameters
    assert caplog.text.count("not recorded as a CUDA graph") == 1 and not fast.recorded


def test_fused_kernels_are_refused_without_triton(rig, monkeypatch):
    monkeypatch.setattr(fused_kernels, "triton", None)
    with pytest.raises(InputError, match="Leave fused out"):
        whole_student(rig).compiled(fused=True)


def test_a_compiled_student_refuses_other_parameters(rig):
    fast = whole_student(rig).compiled()
    with pytest.raises(InputError, match="one frame"):
        fast(dance(), EYES[0].numpy())
    fast(dance().frame(0), EYES[0].numpy())
    with pytest.raises(InputError, match="as before"):
        fast(replace(dance().frame(0), left_hand_pose=[[0.0] * 6]), EYES[0].numpy())


def test_gaussians_of_another_mesh_are_refused(rig):
    other = Rig(replace(template(), faces=template().faces[::-1]))
    for make in (
        lambda: TeacherAvatar(TINY_TEACHER, other, gaussians()),
        lambda: Student(StudentConfig(field=TINY_FIELD), other, gaussians(), (0,)),
    ):
        with pytest.raises(InputError, match="faces that the Gaussians are bound to"):
            make()


def test_a_snapshot_does_not_follow_the_training(rig):
    model = student(rig)
    before = model.gaussians.snapshot()
    with torch.no_grad():
        model.gaussians.dc.add_(1.0)
    assert not torch.equal(before.dc, model.gaussians.dc) and not before.dc.requires_grad
    model.gaussians.normalise_quats()
    torch.testing.assert_close(model.gaussians.quats.norm(dim=-1), torch.ones(len(model.gaussians)))
