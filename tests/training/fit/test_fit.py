"""The fit of a doll: it learns, it repeats, it goes on, it stops at nonsense."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from avatar.data.one_frame import PosedViews
from avatar.data.views import View
from avatar.export.posed import posed_splats
from avatar.gaussians.sampling import SamplingConfig
from avatar.metrics.view_quality import head_box
from avatar.rig.rig import Rig
from avatar.training.engine.adam import LearningRates
from avatar.training.engine.metrics_log import read_metrics
from avatar.training.engine.optimization_task import DivergedError
from avatar.training.engine.resources import choose_device
from avatar.training.fit.fit import FitConfig, FitScene, FitTask, fit_gaussians
from avatar.training.fit.initial_gaussians import initial_gaussians
from avatar.training.presets import TRAINING_PRESETS
from smplxpp.core import Camera, InputError, matrix_from_rotvec
from tests.dolls.standing import HELD_OUT, TRAIN, doll

CONFIG = FitConfig(sampling=SamplingConfig(count=2500), iterations=60, evaluations=3, margin=4)


def turned(name: str, number: int) -> PosedViews:
    """Return the doll turned so that the photograph of a camera is taken by one that stands elsewhere."""
    turn = np.eye(4)
    turn[:3, :3] = matrix_from_rotvec(np.array([0.0, 0.7 * number, 0.0]))
    seen = view(name)
    camera = replace(seen.camera, cam_from_world=seen.camera.cam_from_world @ turn.T, name=f"cam {number}")
    return PosedViews(doll().template.vertices @ turn[:3, :3].T, [replace(seen, camera=camera)])


def view(name: str) -> View:
    return View(doll().cameras[name], torch.tensor(doll().images[name]), torch.tensor(doll().masks[name]))


def scene(**changes) -> FitScene:
    parts = {
        "template": doll().template,
        "vertices": doll().template.vertices,
        "train": [view(name) for name in TRAIN],
        "held_out": [view(name) for name in HELD_OUT],
    }
    return FitScene(**{**parts, **changes})


def scene_of(front: FitScene, others: list[PosedViews]) -> FitScene:
    return replace(front, others=others)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fit")
    seen = []
    return fit_gaussians(scene(), CONFIG, folder, preview=seen.append), read_metrics(folder / "metrics.jsonl"), seen


def test_held_out_views_get_better_and_good(fitted):
    result, entries, _ = fitted
    evaluations = [e for e in entries if e["kind"] == "evaluation"]
    before, after = evaluations[0]["mean"], evaluations[-1]["mean"]
    assert [e["iteration"] for e in evaluations] == [0, 20, 40, 60]
    assert after["psnr"] > before["psnr"] + 4.0
    assert after["psnr"] > 23.0 and after["ssim"] > 0.95
    assert set(evaluations[0]["views"]) == set(HELD_OUT) and evaluations[0]["held_out"]
    assert result.progress.finished and set(result.quality) == {*TRAIN, *HELD_OUT}
    assert result.quality["Held0"].psnr == pytest.approx(evaluations[-1]["views"]["Held0"]["psnr"])


def test_images_are_whole_and_previews_show_the_held_out_views(fitted):
    result, _, previews = fitted
    assert len(previews) == 4 and all(set(images) == set(HELD_OUT) for images in previews)
    assert all(image.shape == (80, 64, 3) and image.dtype == np.uint8 for image in result.images.values())
    np.testing.assert_array_equal(previews[-1]["Held1"], result.images["Held1"])
    error = np.abs(result.images["Held0"].astype(int) - doll().images["Held0"])
    assert error.mean() < 4


@pytest.mark.long
def test_a_fit_of_one_view_knows_one_side_and_the_frames_of_a_turn_know_all(tmp_path, fitted):
    # The photographs of a rig are those of a turn, if the doll turns and the camera stands still.
    others = [turned(name, number) for number, name in enumerate(TRAIN[1:], start=1)]
    config = TRAINING_PRESETS["cpu"].for_turn(len(TRAIN)).fit
    config = replace(config, sampling=replace(config.sampling, count=2500, head_share=None), iterations=60, margin=4)
    front = scene(train=[view(TRAIN[0])])
    one, turn = (fit_gaussians(it, config, tmp_path / str(k)) for k, it in enumerate((front, scene_of(front, others))))
    assert set(turn.quality) == {TRAIN[0], *HELD_OUT, *(f"cam {k}" for k in range(1, len(TRAIN)))}

    def held_out(result):
        return np.mean([result.quality[name].psnr for name in HELD_OUT])

    rig = held_out(fitted[0])
    assert held_out(turn) > rig - 1.5 and held_out(turn) > held_out(one) + 3.0
    # An item of a turn has one view, with the pose of its frame.
    task = FitTask(scene_of(front, others), config)
    shown = {task.micro_batches(k)[0] for k in range(len(TRAIN))}
    assert {item.frame for item in shown} == set(range(len(TRAIN)))
    assert {item.cameras for item in shown} == {(name,) for name in task.sequence.train_cameras}


def test_what_no_view_of_a_turn_shows_has_the_colour_beside_it():
    # Of the doll's skin under its clothes nothing is seen: the template's red must not shine through.
    template = doll().template
    red = replace(template, vertex_colors=np.full((len(template.vertices), 3), [255, 0, 0], np.uint8))
    others = [turned(name, number) for number, name in enumerate(TRAIN[1:], start=1)]
    start = initial_gaussians(Rig(red), red.vertices, [view(TRAIN[0])], CONFIG.sampling, others=others)
    alone = initial_gaussians(Rig(red), red.vertices, [view(TRAIN[0])], CONFIG.sampling)
    pure = torch.tensor([1.0, 0.0, 0.0])
    assert (alone.dc - pure).abs().amax(1).lt(1e-3).float().mean() > 0.3
    assert not (start.dc - pure).abs().amax(1).lt(1e-3).any()


def test_what_comes_out_is_bound_posed_and_free_of_gradients(fitted):
    gaussians, splats = fitted[0].gaussians, fitted[0].splats
    gaussians.check_topology(doll().template.faces)
    assert not any(value.requires_grad for value in gaussians.tensors.values())
    assert len(splats) == len(gaussians) == 2500
    again = posed_splats(gaussians, torch.tensor(doll().template.vertices), torch.tensor(doll().template.faces))
    np.testing.assert_array_equal(again.means, splats.means)


@pytest.mark.parametrize("threads", [1, 2])
def test_the_same_seed_gives_the_same_bits(tmp_path, threads):
    config = replace(CONFIG, iterations=3, sampling=SamplingConfig(count=600))
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        one, two = (fit_gaussians(scene(), config, tmp_path / name).gaussians for name in ("one", "two"))
        other = fit_gaussians(scene(), replace(config, seed=1), tmp_path / "other").gaussians
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(value, two.tensors[name]) for name, value in one.tensors.items())
    assert not torch.equal(one.dc, other.dc)


def test_an_interrupted_fit_is_the_uninterrupted_one(tmp_path):
    config = replace(CONFIG, iterations=6, evaluations=1)
    whole = fit_gaussians(scene(), config, tmp_path / "whole", key="k").gaussians
    sessions, done = 0, False
    while not done:
        part = fit_gaussians(scene(), config, tmp_path / "parts", key="k", max_seconds=1e-9 if sessions < 3 else 1e9)
        sessions, done = sessions + 1, part.progress.finished
    assert sessions == 4
    assert all(torch.equal(value, part.gaussians.tensors[name]) for name, value in whole.tensors.items())


def test_every_view_has_its_turn_once_an_epoch():
    task = FitTask(scene(), CONFIG)
    epochs = [[task.micro_batches(k)[0].cameras for k in range(7 * e, 7 * e + 7)] for e in range(3)]
    assert all(sorted(epoch) == sorted((name,) for name in TRAIN) for epoch in epochs)
    assert epochs[0] != epochs[1] or epochs[1] != epochs[2]


def test_the_silhouette_is_met_with_a_coloured_background(tmp_path):
    result = fit_gaussians(scene(background=(0.9, 0.2, 0.4)), replace(CONFIG, iterations=30), tmp_path)
    corner = result.images["Held0"][0, 0]
    np.testing.assert_array_equal(corner, np.round(255 * np.array([0.9, 0.2, 0.4])))
    assert result.quality["Held0"].psnr_image > 25


def test_without_held_out_views_training_views_are_measured(tmp_path):
    fit_gaussians(scene(held_out=[]), replace(CONFIG, iterations=2), tmp_path)
    last = read_metrics(tmp_path / "metrics.jsonl")[-1]
    assert not last["held_out"] and set(last["views"]) == set(TRAIN)


def test_a_loss_that_is_not_finite_stops_with_the_views_name(tmp_path):
    config = replace(CONFIG, rates=LearningRates(log_scales=1e30))
    with pytest.raises(DivergedError, match=r"step \d+, view (Ring|Face)"):
        fit_gaussians(scene(), config, tmp_path)


def test_scenes_that_cannot_be_fitted_are_refused():
    with pytest.raises(InputError, match="at least one training view"):
        scene(train=[])
    with pytest.raises(InputError, match="unique name"):
        FitTask(scene(held_out=[view(TRAIN[0])]), CONFIG)
    with pytest.raises(InputError, match="posed vertices"):
        scene(vertices=doll().template.vertices[:-1])


@pytest.mark.parametrize(
    "change", [{"iterations": 0}, {"dssim": 1.5}, {"alpha": -1.0}, {"alpha": float("nan")}, {"evaluations": 0}]
)
def test_choices_out_of_range_are_refused(change):
    with pytest.raises(InputError, match=f"fit: {next(iter(change))}"):
        FitConfig(**change)


def test_learning_rates_are_positive():
    with pytest.raises(InputError, match="learning rate dc"):
        LearningRates(dc=0.0)


@pytest.mark.skipif(torch.cuda.is_available(), reason="CUDA is there")
def test_cuda_is_refused_where_there_is_none():
    assert choose_device("auto") == choose_device("cpu") == "cpu"
    with pytest.raises(InputError, match="CUDA device"):
        choose_device("cuda")


def test_the_heads_box_is_around_its_projection():
    points = np.array([[-0.1, 1.5, 0.0], [0.1, 1.7, 0.0]])
    camera = Camera.look_at(
        eye=np.array([0, 1.6, 2.0]), target=np.array([0, 1.6, 0.0]), fov_y_deg=30, width=80, height=90
    )
    x0, y0, x1, y1 = head_box(points, camera)
    at = camera.screen_from_world(points)[:, :2]
    assert x0 < at[:, 0].min() < at[:, 0].max() < x1 and y0 < at[:, 1].min() < at[:, 1].max() < y1
    assert (x1 - x0) * (y1 - y0) < 2 * np.ptp(at[:, 0]) * np.ptp(at[:, 1])
    away = Camera.look_at(
        eye=np.array([0, 1.6, -2.0]), target=np.array([0, 1.6, -4.0]), fov_y_deg=30, width=80, height=90
    )
    assert head_box(points, away) is None
    beside = Camera.look_at(
        eye=np.array([0, 0.2, 2.0]), target=np.array([0, 0.2, 0.0]), fov_y_deg=10, width=80, height=90
    )
    assert head_box(points, beside) is None
