"""Presets: the paper's numbers, and what seeds and shares change."""

from __future__ import annotations

from dataclasses import replace

import pytest

from avatar.training.presets import TRAINING_PRESETS, training_preset, with_iterations
from avatar.training.recipe import TrainConfig, with_batch, with_processes
from smplxpp.core.errors import InputError

STAGES = ("fit", "teacher", "bake", "compensate")


def test_the_papers_numbers():
    paper = training_preset("paper")
    iterations = (paper.teacher.iterations, paper.bake.iterations, paper.compensate.iterations)
    assert iterations == (600_000, 30_000, 100_000)
    assert paper.fit.sampling.count == 270_000 and paper.compensate.poses_per_step == 4
    assert (paper.blend_shapes.head_shapes, paper.blend_shapes.body_shapes) == (8, 20)
    assert paper.teacher.lr == paper.bake.lr == paper.compensate.lr == 5e-4
    for stage in (paper.teacher, paper.bake, paper.compensate):
        weights = stage.weights
        assert (weights.dssim, weights.perceptual, weights.normal, weights.alpha) == (0.2, 0.01, 0.02, 0.0)
    assert (paper.bake.nonrigid, paper.bake.semantic, paper.bake.semantic_map) == (0.1, 1.0, "mesh")


def test_the_small_recipe_is_the_papers():
    """Sizes, rates and cameras a step are those of cpu; what is learned from what is published."""
    small, paper, cpu = (training_preset(name) for name in ("paper-small", "paper", "cpu"))
    assert small.teacher.track is None and small.teacher.pretrain is None and small.networks.teacher.zero_output
    assert set(small.networks.teacher.network_configs()) == {"position", "colour", "other"}
    assert small.networks.field == paper.networks.field and small.blend_shapes == paper.blend_shapes
    shared = ("images", "pretrain", "regression", "nonrigid", "semantic", "semantic_map", "null_share", "attributes")
    for name in shared:
        assert getattr(small.bake, name) == getattr(paper.bake, name), name
    for name in ("poses_per_step", "views", "attributes", "null_share", "init_from_track"):
        assert getattr(small.compensate, name) == getattr(paper.compensate, name), name
    assert small.fit == cpu.fit and small.control_points == cpu.control_points
    for stage in ("teacher", "bake", "compensate"):
        assert getattr(small, stage).weights == getattr(cpu, stage).weights


def test_a_gpu_has_the_recipe_of_two_cores():
    """What gains decibels on two cores is not left out where there is more time; sizes, rates and steps differ."""
    gpu, cpu = (training_preset(name) for name in ("gpu", "cpu"))
    assert (
        gpu.still_body and gpu.control_points == gpu.teacher.track.control_points and gpu.fit.detail == cpu.fit.detail
    )
    assert gpu.teacher.track == cpu.teacher.track and gpu.blend_shapes == cpu.blend_shapes
    for name in ("images", "regression", "semantic", "null_share", "averaged", "code_lr_factor"):
        assert getattr(gpu.bake, name) == getattr(cpu.bake, name), name
    for name in ("init_from_track", "coherence", "null_share", "averaged", "scale_penalty", "offset_penalty", "rates"):
        assert getattr(gpu.compensate, name) == getattr(cpu.compensate, name), name
    for stage in ("teacher", "bake", "compensate"):
        own, small = getattr(gpu, stage), getattr(cpu, stage)
        assert replace(own.weights, perceptual=0.0) == small.weights and own.weights.perceptual == 0.01
        assert own.iterations >= 8 * small.iterations and own.poses_per_step > small.poses_per_step


@pytest.mark.parametrize("name", TRAINING_PRESETS)
def test_a_seed_reaches_every_stage_and_nothing_else(name):
    preset = training_preset(name)
    reseeded = preset.with_seed(7)
    assert {getattr(reseeded, stage).seed for stage in STAGES} == {7} and reseeded.fit.sampling.seed == 7
    assert reseeded.with_seed(0) == preset.with_seed(0)
    assert {one.seed for one in (reseeded.teacher.track, reseeded.teacher.joint) if one is not None} <= {7}


@pytest.mark.parametrize("name", TRAINING_PRESETS)
def test_a_share_is_one_of_the_iterations_alone(name):
    preset, tenth = training_preset(name), training_preset(name).shortened(0.1)
    for stage in STAGES:
        own, short = getattr(preset, stage), getattr(tenth, stage)
        assert short.iterations == round(0.1 * own.iterations)
        same = {"iterations": own.iterations}
        same |= {name: getattr(own, name) for name in ("pretrain", "track", "joint") if hasattr(own, name)}
        assert replace(short, **same) == own
    if preset.teacher.joint is not None and tenth.teacher.joint is not None:
        assert tenth.teacher.joint.steps(10) == 0.1 * preset.teacher.joint.steps(10)
        assert tenth.teacher.joint.steps(1000) == 0.1 * preset.teacher.joint.steps(1000)
    for stage in ("teacher", "bake"):
        own, short = getattr(preset, stage), getattr(tenth, stage)
        share = short.iterations / own.iterations
        assert short.pretrain == (None if own.pretrain is None else own.pretrain.shortened(share))
    track, short = preset.teacher.track, tenth.teacher.track
    assert short == (None if track is None else track.shortened(0.1))
    assert track is None or [level.steps for level in short.levels] == [round(0.1 * x.steps) for x in track.levels]
    assert all(getattr(preset.shortened(1e-9), stage).iterations == 1 for stage in STAGES)


@pytest.mark.parametrize("name", TRAINING_PRESETS)
def test_other_iterations_have_as_large_a_share_of_pretraining(name):
    for config in (training_preset(name).teacher, training_preset(name).bake):
        double = with_iterations(config, 2 * config.iterations)
        assert double.iterations == 2 * config.iterations
        assert with_iterations(double, config.iterations) == config
        assert config.pretrain is None or double.pretrain.iterations == 2 * config.pretrain.iterations


@pytest.mark.parametrize("name", TRAINING_PRESETS)
def test_the_bakes_student_has_no_blend_shapes(name):
    student = training_preset(name).student()
    assert student.blend_shapes is None and student.field == training_preset(name).networks.field


def test_the_precision_of_networks_is_an_option_of_any_preset():
    presets = {name: TrainConfig(precision=name).recipe("gpu").preset for name in ("preset", "bfloat16", "float32")}
    amp = {name: {preset.teacher.amp, preset.bake.amp, preset.compensate.amp} for name, preset in presets.items()}
    assert amp == {"preset": {False}, "bfloat16": {True}, "float32": {False}}
    for wrong in ({"precision": "half"}, {"compile": "jit"}, {"readers": 0}, {"cache_gib": -1.0}):
        with pytest.raises(InputError, match="option"):
            TrainConfig(**wrong)


def test_normals_of_followed_clothes_are_an_option_of_any_preset():
    for name, usual in (("cpu", False), ("demo", True), ("paper", False)):
        for asked, found in ((None, usual), (True, True), (False, False)):
            preset = TrainConfig(surface_normals=asked).recipe(name).preset
            assert {preset.teacher.surface_normals, preset.bake.surface_normals} == {found}


def test_an_unknown_name_is_refused():
    with pytest.raises(InputError, match="'paper' or 'gpu' or 'paper-small' or 'cpu' or 'demo'"):
        training_preset("tpu")


def test_of_a_turn_a_student_is_fitted_without_a_teacher_and_options_still_count():
    recipe = TrainConfig(iterations_share=0.5, iterations={"bake": 7}).recipe("cpu", turn_views=8)
    assert not recipe.teacher and recipe.cloth is None
    preset, own = recipe.preset, training_preset("cpu")
    assert preset.fit.iterations == 100 and preset.fit.sampling.sh_degree == 0
    assert preset.fit.sampling.count == own.fit.sampling.count
    assert (
        preset.bake.iterations == 7
        and preset.bake.attributes == preset.compensate.attributes == 0.0
        and preset.bake.lr < 1e-6
    )
    assert TrainConfig().recipe("cpu").preset == own


def test_several_processes_see_no_more_poses_than_one():
    """A batch of 1 grew to 4 for four processes at the same number of steps: four times the work in the same hours."""
    one = training_preset("paper")
    four = with_processes(one, 4)
    for before, after in zip(
        (one.teacher, one.bake, one.compensate), (four.teacher, four.bake, four.compensate), strict=True
    ):
        grown = max(1, 4 // before.poses_per_step)
        assert after.poses_per_step == max(4, before.poses_per_step)
        assert after.iterations * grown == before.iterations
        assert after.lr == pytest.approx(before.lr * grown**0.5)
        assert after.attributes == pytest.approx(before.attributes * grown**0.5)
    assert four.teacher.lr == 2.0 * one.teacher.lr and four.fit == one.fit
    shapes = with_processes(replace(one, compensate=replace(one.compensate, poses_per_step=1)), 4).compensate
    assert (shapes.position_lr, shapes.color_lr) == (2.0 * one.compensate.position_lr, 2.0 * one.compensate.color_lr)
    joint = training_preset("gpu").teacher.joint
    shared = with_processes(training_preset("gpu"), 4).teacher.joint
    assert joint is not None and shared is not None
    # 6,000 frames: a quarter of the steps, each of four frames, at twice the rates.
    assert (shared.steps(6000), joint.steps(6000)) == (30_000, 120_000)
    assert shared.photometric(6000).poses_per_step == 4
    assert shared.photometric(6000).attributes == pytest.approx(2.0 * joint.photometric(6000).attributes)
    assert with_processes(one, 1) == one and with_processes(with_batch(one, 4), 4) == with_batch(one, 4)


def test_fewer_gaussians_of_a_refinement_leave_the_head_its_own():
    usual = TrainConfig().refinement(wanted=True).sampling
    fewer, more = (TrainConfig(refine_gaussians=count).refinement(wanted=True).sampling for count in (15_000, 60_000))
    assert fewer.count == 15_000 and fewer.head_share * fewer.count == pytest.approx(usual.head_share * usual.count)
    assert more == replace(usual, count=60_000)
    assert TrainConfig(refine_gaussians=3000).refinement(wanted=True).sampling.head_share == 0.5
    with pytest.raises(InputError, match="refine-gaussians"):
        TrainConfig(refine_gaussians=0)
