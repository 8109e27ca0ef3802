"""The ablation takes what a training of the same choices has made, and nothing of another."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from avatar.training.engine.processes import Distributed
from pipelines.ablation.adopt import adopt_trained
from pipelines.ablation.pieces import Workshop
from pipelines.ablation.rows import ablation_pieces
from pipelines.ablation.run import Ablation, Observer
from pipelines.stages.train import TrainConfig, TrainOptions, train
from pipelines.stages.train_inputs import TrainInputs, open_scene
from tests.dolls.swaying import write_moving_capture, write_moving_run
from tests.dolls.tiny import tiny_preset


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run with all stages of the tiny preset, and its scene."""
    root = tmp_path_factory.mktemp("trained")
    inputs, run = TrainInputs(write_moving_capture(root / "capture")), write_moving_run(root / "run")
    scene = open_scene(run, inputs)
    train(run, inputs, scene, TrainConfig(preset=tiny_preset(2)), TrainOptions(), Distributed())
    return run, scene


def ablation_of(scene, folder, preset, *, digests=None) -> Ablation:
    shop = Workshop(scene.capture, scene.template)
    return Ablation(
        shop,
        ablation_pieces(preset, frame=scene.frame, training_frames=1, built_frame=scene.built_frame),
        folder,
        inputs=digests or scene.digests,
    )


def test_the_same_choices_are_taken_over_and_equal_what_would_be_trained(trained, tmp_path):
    run, scene = trained
    ablation = ablation_of(scene, tmp_path / "taken", tiny_preset(2))
    assert adopt_trained(run, ablation, scene, scale=1.0, perceptual=None) == ["gaussians", "teacher", "bake", "full"]
    assert all(ablation.record(name)["seconds"] > 0 for name in ("gaussians", "teacher", "bake", "full"))
    assert adopt_trained(run, ablation, scene, scale=1.0, perceptual=None) == []  # they stand
    own = ablation_of(scene, tmp_path / "own", tiny_preset(2))
    for name in own.closure("full"):
        assert own._make(name, float("inf"), Observer())
    taken, made = ablation.piece("full").state_dict(), own.piece("full").state_dict()
    assert all(torch.equal(value, taken[name]) for name, value in made.items())


def test_nothing_of_other_choices_is_taken(trained, tmp_path):
    run, scene = trained
    preset = tiny_preset(2)

    def taken(name: str, preset, *, scene=scene, scale: float = 1.0) -> list[str]:
        return adopt_trained(run, ablation_of(scene, tmp_path / name, preset), scene, scale=scale, perceptual=None)

    assert taken("bake", replace(preset, bake=replace(preset.bake, lr=1e-3))) == ["gaussians", "teacher"]
    fewer = replace(preset.fit, sampling=replace(preset.fit.sampling, count=400))
    assert taken("fit", replace(preset, fit=fewer)) == []
    shapes = replace(preset.blend_shapes, body_shapes=4)
    assert taken("shapes", replace(preset, blend_shapes=shapes)) == ["gaussians", "teacher", "bake"]
    assert taken("scale", preset, scale=0.5) == []
    changed = replace(scene, digests={**scene.digests, "capture/parameters": "others"})
    assert taken("capture", preset, scene=changed) == ["gaussians"]
    fewer_cameras = replace(scene.capture.splits, train_cameras=("Ring0",))
    smaller = replace(scene, capture=replace(scene.capture, splits=fewer_cameras))
    assert taken("cameras", preset, scene=smaller) == []
    image = scene.capture.file("Ring0", scene.frame)
    before = image.read_bytes()
    image.write_bytes(before + b"other")
    assert taken("image", preset) == []
    image.write_bytes(before)
