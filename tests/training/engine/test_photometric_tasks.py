"""Teacher, bake and compensation on a scene of a second: they learn, leave alone what they must, and resume exactly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from avatar.data.sequence import camera_centers_of
from avatar.losses.deformation import Coherence
from avatar.losses.reconstruction import ReconstructionWeights
from avatar.models.learned_gaussians import LEARNED
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.student import Student, StudentConfig
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.models.tracked_surface import ControlCage, Track, TrackedAvatar
from avatar.training.engine.adam import pixel_size
from avatar.training.engine.loop import LoopConfig, run_training
from avatar.training.engine.optimization_task import PretrainConfig
from avatar.training.engine.photometric_task import TaskContext
from avatar.training.engine.session import Session
from avatar.training.fit_teacher import FitTeacherConfig, PretrainTeacherTask, TeacherTask, fit_teacher
from avatar.training.student.bake import BakeConfig, BakeTask, bake
from avatar.training.student.compensate import CompensateConfig, CompensateTask, compensate
from avatar.training.student.pretrain import DistillationTargets, PretrainFieldTask
from avatar.training.tracking.config import TrackConfig
from avatar.training.tracking.track import TrackTask
from smplxpp.core.errors import InputError
from tests.data.test_cloth_motion import Told
from tests.dolls.dancing import gaussians, sequence, varied, write_dance
from tests.dolls.tiny import TINY_FIELD, TINY_TEACHER
from tests.dolls.toy import copied, same_state
from tests.losses.test_reconstruction import MeanDifference
from tests.pretended_cuda import CountedWaits, pretended_cuda

WEIGHTS = ReconstructionWeights(perceptual=0.0, alpha=0.1)
STEPS = {"iterations": 6, "views": 2, "weights": WEIGHTS, "evaluations": 2, "evaluated": 1}
TEACHER = FitTeacherConfig(pretrain=None, lr=1e-2, attributes=0.5, **STEPS)
BAKE = BakeConfig(lr=1e-2, null_share=0.3, pose_noise=0.01, **STEPS)
COMPENSATE = CompensateConfig(poses_per_step=2, lr=1e-2, null_share=0.3, attributes=0.2, coherence=100.0, **STEPS)
SHAPES = BlendShapeConfig(expression_size=2, head_shapes=2, body_shapes=3, width=8, jaw=True)
STUDENT = StudentConfig(field=TINY_FIELD)
STAGES = ("teacher", "bake", "bake alone", "compensate")


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return write_dance(tmp_path_factory.mktemp("captures") / "dance")


@pytest.fixture(scope="module")
def frames(root):
    return sequence(root)


def make(stage: str, frames, **changes):
    """The task of a stage, from the same start every time."""
    torch.manual_seed(0)
    if stage == "teacher":
        return TeacherTask(frames, TeacherAvatar(TINY_TEACHER, frames.rig, gaussians()), replace(TEACHER, **changes))
    student = Student(STUDENT, frames.rig, gaussians(), frames.train_frames)
    if stage == "compensate":
        return CompensateTask(frames, student.with_blend_shapes(SHAPES), replace(COMPENSATE, **changes))
    teacher = taught(frames) if stage == "bake" else None
    return BakeTask(frames, student, replace(BAKE, **changes), teacher=teacher)


def taught(frames) -> TeacherAvatar:
    """A teacher that has something to say."""
    torch.manual_seed(0)
    teacher = TeacherAvatar(TINY_TEACHER, frames.rig, varied(gaussians()))
    random = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for value in teacher.networks.parameters():
            value.add_(0.01 * torch.randn(value.shape, generator=random).to(value.device))
    return teacher


def steps(task, count: int, start: int = 0) -> list[dict]:
    return [dict(task.step(k)) for k in range(start, start + count)]


def make_other(stage: str, frames):
    """The task of a stage that precedes those of `make`."""
    if stage == "track":
        return TrackTask(frames, TrackedAvatar(frames.rig, gaussians(), 12), TrackConfig(simulate=False, views=2))
    teacher, pretrain = taught(frames), PretrainConfig(iterations=6, batch=2)
    if stage == "pretrained teacher":
        return PretrainTeacherTask(frames, teacher, pretrain, 0, None)
    student = Student(STUDENT, frames.rig, gaussians(), frames.train_frames)
    return PretrainFieldTask(frames, student, teacher, pretrain, 0, code_lr_factor=1.0, null_share=0.0)


@pytest.mark.parametrize(
    ("stage", "waits", "calls", "sent"),
    # Whether all is finite is asked once a micro-batch; which pixels the teacher's normals cover, once a view.
    [
        ("teacher", 1, 2250, 17),
        ("bake", 1 + 2, 2520, 17),
        ("bake alone", 1, 1150, 17),
        ("compensate", 2, 2130, 40),
        ("track", 1, 1010, 20),
        ("pretrained teacher", 1, 2700, 14),
        ("pretrained field", 1, 1030, 14),
    ],
)
@pytest.mark.long
def test_a_step_that_logs_nothing_seldom_waits_for_the_device(root, stage, waits, calls, sent):
    """Terms of the losses as numbers, and masks as indices, made a step of these wait 14 to 27 times.

    Calls are those of the second step on a tiny scene, a few percent above what they are: each is a launch, or time of
    Python, which decides how fast a GPU steps. Copies from the CPU are photographs, cameras, poses and noise, and ten a
    micro-batch that the pretended gsplat makes.
    """
    with pretended_cuda():
        frames = sequence(root, device="cuda")
        task = make(stage, frames) if stage in STAGES else make_other(stage, frames)
        task.step(0)
        with CountedWaits() as counted:
            task.step(1)
    assert counted.count <= waits
    assert sum(counted.calls.values()) <= calls
    assert counted.sent <= sent


@pytest.mark.parametrize("stage", STAGES)
def test_a_stopped_training_resumes_bit_for_bit(stage, frames, tmp_path):
    config = LoopConfig(iterations=3, evaluate_every=9)
    whole = make(stage, frames)
    run_training(whole, config, tmp_path / "whole", key="k")
    assert (
        run_training(make(stage, frames), replace(config, max_seconds=1e-12), tmp_path / "parts", key="k").iteration
        == 1
    )
    part = make(stage, frames)
    assert run_training(part, config, tmp_path / "parts", key="k").finished
    assert same_state(whole.state(), part.state())


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.long
def test_the_loss_goes_down(stage, frames):
    task = (
        make(stage, frames, iterations=30, null_share=0.0) if stage != "teacher" else make(stage, frames, iterations=30)
    )
    losses = [figures["loss"] for figures in steps(task, 24)]
    assert np.mean(losses[-6:]) < 0.97 * np.mean(losses[:6])


def test_the_bake_takes_over_the_teachers_motion(frames):
    """On maps and labels alone the mesh comes to where the teacher has its Gaussians."""
    only = ReconstructionWeights(dssim=0.0, perceptual=0.0, normal=0.0)
    task = make("bake", frames, iterations=30, weights=only, nonrigid=1.0, null_share=0.0, pose_noise=0.0)
    found = [figures["nonrigid"] for figures in steps(task, 20)]
    assert np.mean(found[-4:]) < 0.9 * np.mean(found[:4])


def test_the_bakes_semantic_term_is_zero_for_equal_geometry(frames):
    teacher = TeacherAvatar(TINY_TEACHER, frames.rig, varied(gaussians()))  # at zero residuals: skinning alone
    student = Student(STUDENT, frames.rig, teacher.gaussians.snapshot(), frames.train_frames)
    task = BakeTask(frames, student, replace(BAKE, null_share=0.0, pose_noise=0.0, attributes=0.5), teacher=teacher)
    _, terms = task.loss(task.micro_batches(0)[0])
    assert terms["semantic"] < 1e-3  # targets are kept in half precision
    assert terms["nonrigid"] < 1e-5 and terms["l1"] < 2e-3


def test_the_semantic_term_of_the_mesh_pulls_the_field_alone(frames):
    """It grows with a mesh that stands elsewhere, and Gaussians cannot make up for the mesh."""
    teacher = TeacherAvatar(TINY_TEACHER, frames.rig, varied(gaussians()))  # at zero residuals: skinning alone
    values = []
    for shift in (0.0, 0.05):
        task = bake_of(frames, teacher, semantic_map="mesh", nonrigid=0.0)
        with torch.no_grad():
            for network in (task.student.field.body, task.student.field.cloth):
                network.last.bias += shift
        item = task.micro_batches(0)[0]
        values.append(task.loss(item)[1]["semantic"])
    assert values[1] > 1.2 * values[0]
    views = task.views(item)
    posed = task.student(frames.pose(item.frame), camera_centers_of(views))
    sum(labels.square().sum() for labels in task._mesh_labels(posed, views)).backward()
    touched = {name for name, value in task.student.named_parameters() if value.grad is not None and value.grad.any()}
    assert "field.body.last.weight" in touched and not any(name.startswith("gaussians") for name in touched)


@pytest.mark.parametrize("stage", ["bake", "compensate"])
def test_new_poses_of_a_training_have_their_clothes_where_the_student_saw_them(stage, frames, monkeypatch):
    """On simulated clothes, which lie elsewhere than on the photographs, Gaussians would learn to be blurred."""
    told = Told()
    task = make(stage, frames.with_cloth(told), null_share=1.0, **({"pose_noise": 0.0} if stage == "bake" else {}))
    with torch.no_grad():
        for network in (task.student.field.body, task.student.field.cloth):
            network.last.bias += 0.05
    posed = []
    forward = Student.forward
    monkeypatch.setattr(
        Student, "forward", lambda self, pose, centers: posed.append(pose) or forward(self, pose, centers)
    )
    item = task.micro_batches(0)[0]
    task.loss(item)
    assert told.asked == []  # nothing is simulated
    (new,) = posed
    assert new.frame is None and new.known == 0.0 and new.time == item.frame / 10.0
    seen = task.student.displacements(frames.pose(item.frame))
    assert seen.norm(dim=-1).max() > 0.01
    torch.testing.assert_close(new.cloth.displacements, seen, rtol=0, atol=0)


STILL = {"null_share": 0.0, "pose_noise": 0.0}
"""A bake without noise."""


def bake_of(frames, teacher, **changes) -> BakeTask:
    """The bake of a student that has the Gaussians of `taught`."""
    bound = taught(frames).gaussians.snapshot()
    student = Student(STUDENT, frames.rig, bound, frames.train_frames)
    return BakeTask(frames, student, replace(BAKE, **STILL, **changes), teacher=teacher)


def test_the_bake_compares_with_the_teachers_images_or_with_photographs(frames):
    """At zero residuals teacher and student are the same: their images agree, and the photographs show another."""
    teacher = TeacherAvatar(TINY_TEACHER, frames.rig, taught(frames).gaussians.snapshot())
    terms = {}
    for name, source, changes in (
        ("by default", teacher, {}),
        ("teacher", teacher, {"images": "teacher"}),
        ("photographs", teacher, {"images": "photographs"}),
        ("alone", None, {}),
    ):
        task = bake_of(frames, source, **changes)
        terms[name] = task.loss(task.micro_batches(0)[0])[1]
    assert terms["by default"] == terms["teacher"] and terms["teacher"]["l1"] < 2e-3
    assert terms["photographs"]["l1"] > 0.02
    # Maps and labels are the teacher's still.
    assert {"semantic", "nonrigid"} <= terms["photographs"].keys()
    shared = ("l1", "dssim", "alpha", "psnr_crop")
    assert [terms["photographs"][name] for name in shared] == [terms["alone"][name] for name in shared]


def test_a_bake_on_photographs_without_labels_has_nothing_rendered_by_the_teacher(frames, monkeypatch):
    monkeypatch.setattr(DistillationTargets, "_draw", None)
    task = bake_of(frames, taught(frames), images="photographs", semantic=0.0)
    _, terms = task.loss(task.micro_batches(0)[0])
    assert "semantic" not in terms and terms["nonrigid"] > 0
    for changes in ({"images": "photographs"}, {"semantic": 0.0}):
        asking = bake_of(frames, taught(frames), **changes)
        with pytest.raises(TypeError):
            asking.loss(asking.micro_batches(0)[0])


def test_the_bakes_maps_are_the_surface_that_its_teacher_remembers(frames):
    """The same everywhere, so that its difference from a field at zero is known; the networks say something else."""
    teacher = taught(frames)
    swing = torch.tensor([[0.03, 0.0, 0.0], [0.03, -0.01, 0.0], [0.04, 0.0, 0.0], [0.03, 0.0, 0.02]])
    row = {frame: number for number, frame in enumerate(frames.train_frames)}
    teacher.remember(Track(row, swing[:, None].expand(-1, 24, -1), ControlCage(frames.rig, 24)))
    task = bake_of(frames, teacher, images="photographs", semantic=0.0)
    for number in range(4):
        (item,) = task.micro_batches(number)
        expected = float(swing[row[item.frame]].abs().sum()) / TINY_TEACHER.position_scale
        assert task.loss(item)[1]["nonrigid"] == pytest.approx(expected, rel=1e-3)


def test_the_bake_does_not_change_its_teacher(frames):
    teacher = taught(frames)
    before = copied(teacher.state_dict())
    student = Student(STUDENT, frames.rig, gaussians(), frames.train_frames)
    steps(BakeTask(frames, student, BAKE, teacher=teacher), 2)
    assert same_state(before, teacher.state_dict())


def test_the_bake_moves_field_codes_and_attributes(frames):
    task = make("bake", frames)
    before = copied(task.student.state_dict())
    steps(task, 6)
    after = task.student.state_dict()
    moved = {name for name, value in after.items() if not torch.equal(value, before[name])}
    assert {"codes.codes", "field.body.last.weight", "gaussians.dc", "gaussians.offset"} <= moved
    assert not {"gaussians.face_index", "gaussians.barycentric"} & moved


def test_the_compensation_leaves_field_and_codes(frames):
    task = make("compensate", frames)
    before = copied(task.student.state_dict())
    steps(task, 3)
    moved = {name for name, value in task.student.state_dict().items() if not torch.equal(value, before[name])}
    assert {"blend_shapes.U", "blend_shapes.C"} <= moved
    assert not any(name.startswith(("field", "codes")) for name in moved)


@pytest.mark.parametrize("stage", STAGES)
def test_attributes_without_a_rate_stay(stage, frames):
    task = make(stage, frames, attributes=0.0)
    names = {name: getattr(task.model.gaussians, name).detach().clone() for name in LEARNED}
    steps(task, 2)
    assert all(torch.equal(getattr(task.model.gaussians, name), value) for name, value in names.items())
    assert not any(key.startswith("gaussians.") for key in task.learned)


@pytest.mark.parametrize("stage", STAGES)
@pytest.mark.long
def test_what_hides_does_not_grow_nor_leave_its_triangle(stage, frames):
    """The torso is under the dress: large Gaussians there shrink, and such far inside come nearer."""
    sizes, ways = {}, {}
    for weight in (0.0, 0.1):
        task = make(stage, frames, iterations=40, attributes=1.0, scale_penalty=weight, offset_penalty=100.0 * weight)
        learned, rig = task.model.gaussians, frames.rig
        hidden = rig.template.vertices[rig.template.faces[learned.face_index.numpy(), 0], 1] < 0.6
        hidden &= rig.template.vertex_part[rig.template.faces[learned.face_index.numpy(), 0]] == 0
        with torch.no_grad():
            learned.log_scales[hidden], learned.normal_offset[hidden] = 0.5, -0.1
        steps(task, 20)
        sizes[weight], ways[weight] = (
            float(value[hidden].detach().abs().mean()) for value in (learned.log_scales, learned.normal_offset)
        )
    assert sizes[0.1] < min(0.5, sizes[0.0]) and ways[0.1] < min(0.1, ways[0.0])


def test_steps_at_half_the_size_come_first(frames):
    task = make("teacher", frames, coarse=0.5)
    sizes = []
    for k in range(6):
        item = task.micro_batches(k)[0]
        whole = frames.view(item.cameras[0], item.frame)
        sizes.append(task.views(item)[0].camera.height / whole.camera.height)
    assert all(size < 0.52 for size in sizes[:3]) and sizes[3:] == [1.0] * 3


def test_a_perceptual_term_of_every_second_step_counts_twice(frames):
    weights = replace(WEIGHTS, dssim=0.0, alpha=0.0, normal=0.0, perceptual=0.25)
    torch.manual_seed(0)
    teacher = TeacherAvatar(TINY_TEACHER, frames.rig, gaussians())
    alone = {"scale_penalty": 0.0, "offset_penalty": 0.0}
    config = replace(TEACHER, weights=weights, perceptual_every=2, view_jitter=0.0, **alone)
    task = TeacherTask(frames, teacher, config, TaskContext(perceptual=MeanDifference()))
    for k, weight in ((0, 0.5), (1, 0.0)):
        total, terms = task.loss(task.micro_batches(k)[0])
        assert ("perceptual" in terms) == bool(weight)
        assert float(total.detach()) == pytest.approx(
            float(terms["l1"] + weight * terms.get("perceptual", 0.0)), rel=1e-5
        )


def test_held_out_views_and_poses_are_measured_and_shown(frames):
    shown = {}
    task = CompensateTask(frames, make("compensate", frames).student, COMPENSATE, TaskContext(preview=shown.update))
    figures = task.evaluate(0)
    assert set(figures) == {"mean", "novel_view", "novel_pose"} and figures["mean"] == figures["novel_view"]
    assert set(shown) == {"Held0 2", "Held0 5"}
    assert all(image.dtype == np.uint8 and image.shape == (64, 48, 3) for image in shown.values())
    quality, image = task.measure(task.sequence.whole_view("Held0", 5), 5)
    assert quality.psnr == pytest.approx(figures["novel_pose"]["psnr"])
    np.testing.assert_array_equal(image, shown["Held0 5"])


def test_noise_follows_from_seed_step_and_frame(frames):
    task = make("bake alone", frames)
    task.micro_batches(3)
    draws = [task.generator(frame).random() for frame in (0, 1, 0)]
    assert draws[0] == draws[2] != draws[1]
    task.micro_batches(4)
    assert task.generator(0).random() != draws[0]


def test_what_cannot_be_trained_is_refused(frames):
    with pytest.raises(InputError, match="blend shapes"):
        CompensateTask(frames, Student(STUDENT, frames.rig, gaussians(), (0,)), COMPENSATE)
    for change in (
        {"iterations": 0},
        {"poses_per_step": 0},
        {"coarse": -0.1},
        {"seed": -1},
        {"attributes": float("nan")},
    ):
        with pytest.raises(InputError, match=next(iter(change))):
            replace(TEACHER, **change)
    for change in ({"null_share": 1.5}, {"semantic": -1.0}, {"pose_noise": float("nan")}, {"images": "drawings"}):
        with pytest.raises(InputError, match=next(iter(change))):
            replace(BAKE, **change)
    with pytest.raises(InputError, match="null_share"):
        replace(COMPENSATE, null_share=-0.1)


def test_a_pixel_is_what_one_covers_at_the_person(frames):
    camera = frames.capture.cameras["Ring0"]
    assert pixel_size(frames) == pytest.approx(2.2 / camera.K[0, 0], rel=0.05)


@pytest.mark.long
def test_the_functions_train_from_the_seed_and_hand_the_avatar_on(frames, tmp_path):
    """Whatever torch's random numbers were before, and they stay as they were."""
    found = []
    for number in range(2):
        torch.manual_seed(number)
        before = torch.random.get_rng_state()
        folder = tmp_path / str(number)
        config = replace(TEACHER, iterations=2)
        random = replace(TINY_TEACHER, noise=True, zero_output=False)
        teacher, done = fit_teacher(frames, gaussians(), random, config, Session(folder / "t"))
        baked, _ = bake(
            frames,
            teacher.gaussians.snapshot(),
            STUDENT,
            replace(BAKE, iterations=2),
            Session(folder / "b"),
            teacher=teacher,
        )
        student, _ = compensate(frames, baked, SHAPES, replace(COMPENSATE, iterations=2), Session(folder / "c"))
        assert done.finished and torch.equal(before, torch.random.get_rng_state())
        found.append({**teacher.state_dict(), **{f"s.{n}": v for n, v in student.state_dict().items()}})
    assert same_state(*found) and not student.training


@pytest.mark.long
def test_coherent_blend_shapes_learn_to_move_neighbours_alike(frames):
    left = []
    for weight in (0.0, 1e4):
        task = make("compensate", frames, coherence=weight, iterations=40)
        measure = Coherence(frames.rig, task.student.gaussians(), task.shapes.U)
        figures = [task.step(k) for k in range(40)]
        assert ("coherence" in figures[-1]) == bool(weight)
        left.append(float(measure(task.shapes.U.detach(), np.random.default_rng(0))))
    assert 0 < left[1] < 0.5 * left[0]
    with pytest.raises(InputError, match="compensation: coherence"):
        replace(COMPENSATE, coherence=-1.0)


def test_a_held_out_view_of_nobody_measures_nothing(frames, monkeypatch):
    task = CompensateTask(frames, make("compensate", frames).student, COMPENSATE)
    whole_view = type(frames).whole_view

    def empty_in_the_last_pose(self, camera, frame):
        view = whole_view(self, camera, frame)
        return replace(view, alpha=torch.zeros_like(view.alpha)) if frame == 5 else view

    monkeypatch.setattr(type(frames), "whole_view", empty_in_the_last_pose)
    assert set(task.evaluate(0)) == {"mean", "novel_view"}


def test_half_precision_is_the_networks_alone(frames):
    teacher, pose = taught(frames), frames.pose(1)
    camera_centers = torch.tensor([[0.3, 0.7, 2.2]])
    exact, centre = teacher.inputs(pose, camera_centers), teacher.position_input(pose)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        half, half_centre = teacher.inputs(pose, camera_centers), teacher.position_input(pose)
    assert torch.equal(half.positions, exact.positions) and torch.equal(half_centre, centre)
    assert (half.cosines is None) == (exact.cosines is None)
    assert exact.cosines is None or torch.equal(half.cosines, exact.cosines)


def test_a_normal_loss_with_normal_maps_tells_nothing(frames, caplog, monkeypatch):
    caplog.set_level("INFO")
    view = type(frames).view

    def with_normals(self, camera, frame):
        seen = view(self, camera, frame)
        return replace(seen, normals=torch.ones((*seen.alpha.shape, 3), dtype=torch.float16))

    monkeypatch.setattr(type(frames), "view", with_normals)
    assert steps(make("compensate", frames), 1)[0]["normal"] > 0
    assert not caplog.records


def test_a_training_is_not_measured_twice_at_its_end():
    """500 steps were measured after 498 and after 500, because a sixth of them was rounded down."""
    every = BakeConfig(iterations=500, evaluations=6).evaluate_every
    assert [step for step in range(1, 501) if step % every == 0 or step == 500] == [84, 168, 252, 336, 420, 500]
