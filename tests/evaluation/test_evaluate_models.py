"""A whole evaluation on the doll: views, surfaces, speed, the report and its tables; what it refuses."""

from __future__ import annotations

import json
import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from avatar.data.sequence import AvatarSequence
from avatar.evaluation.evaluate import EvaluationConfig, evaluate_models
from avatar.evaluation.input_protocol import InputProtocol
from avatar.evaluation.protocol import SETS, ProtocolConfig
from avatar.evaluation.report import SKINNING_ALONE, EvalReport, ModelFigures, ViewCounts, view_key
from avatar.evaluation.summary import evaluation_tables, summary_figures
from avatar.losses import perceptual_weights as metric_names
from avatar.losses.perceptual import ShiftTolerantLPIPS
from avatar.losses.perceptual_weights import MissingPackageError, load_metric
from avatar.metrics.speed import bytes_on_disk, fitted, measure_speed, parameter_counts
from avatar.metrics.view_quality import ViewQuality
from avatar.rig.rig import Rig, at_rest
from smplxpp.core import BodyParams, Camera, InputError
from tests.dolls.lpips import lpips_weights
from tests.dolls.standing import OUT, Grown, doll, opened, still

CONFIG = EvaluationConfig(
    protocol=ProtocolConfig(every=4), metric="none", samples=2000, speed_size=(24, 32), speed_pictures=2, shown=1
)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory) -> AvatarSequence:
    return AvatarSequence(opened(tmp_path_factory.mktemp("capture") / "doll"), doll().template)


@pytest.fixture(scope="module")
def found(sequence, tmp_path_factory):
    file = tmp_path_factory.mktemp("models") / "grown.safetensors"
    file.write_bytes(b"x" * 1234)
    models = {"still": still(sequence.rig), "grown": Grown(sequence.rig)}
    return evaluate_models(models, sequence, CONFIG, files={"grown": file})


def test_every_model_is_measured_on_the_same_views(found):
    still, grown = found.report.models.values()
    assert list(still.views) == list(grown.views) == list(SETS)
    for name in SETS:
        assert still.views[name].keys() == grown.views[name].keys()
        assert all(0 < quality.psnr < 60 for quality in still.views[name].values())
    assert set(still.views["novel_pose"]) == {"Held0_000004", "Held1_000004"}
    assert still.mean("novel_pose")["psnr"] == pytest.approx(
        np.mean([quality.psnr for quality in still.views["novel_pose"].values()])
    )
    # The doll stands still, so that a view of it is the same in every frame.
    assert still.views["novel_view"]["Held0_000000"] == still.views["novel_pose"]["Held0_000004"]


def test_surfaces_beside_skinning_alone(found):
    alone = found.report.skinning_alone
    assert {name: list(one.frames) for name, one in alone.items()} == {"training": [1], "held_out": [5]}
    assert alone["training"].mean.p2s == pytest.approx(1e3 * OUT, rel=0.02)
    still, grown = found.report.models.values()
    assert still.surfaces == alone
    assert grown.surfaces["training"].mean.p2s < 1e-3 and grown.surfaces["held_out"].mean.chamfer < 1e-3


def test_pictures_of_each_set_and_meshes_of_a_frame(found):
    assert [(view.set, view.chosen) for view in found.views] == [(k, c) for k in SETS for c in ("evenly", "worst")]
    for view in found.views:
        if view.chosen == "worst":
            quality = found.report.models["grown"].views[view.set]
            assert quality[view_key(view.camera, view.frame)].psnr == min(one.psnr for one in quality.values())
        np.testing.assert_array_equal(view.truth, doll().images[view.camera])
        assert list(view.rendered) == ["still", "grown"]
        assert all(image.shape == view.truth.shape and image.dtype == np.uint8 for image in view.rendered.values())
        assert view.head is not None
    assert [(one.set, one.frame) for one in found.surfaces] == [("training", 1), ("held_out", 5)]
    assert list(found.surfaces[0].posed) == [SKINNING_ALONE, "grown"]  # the other's mesh is skinning alone


def test_size_and_speed(found):
    still, grown = found.report.models.values()
    assert still.bytes is None and grown.bytes == 1234
    assert still.parameters["total"] == still.parameters["gaussians"] == 800 * (1 + 3 + 2 + 4 + 1 + 3 + 9)
    assert grown.parameters["field"] > 0 and grown.parameters["codes"] > 0
    speed = grown.speed
    assert (speed.width, speed.height, speed.gaussians, speed.pictures) == (24, 32, 800, 2)
    assert speed.threads == torch.get_num_threads() and speed.device == "CPU"
    assert min(speed.pose_ms, speed.deform_ms, speed.render_ms) > 0 and speed.fps < 1e3 / speed.deform_ms * 1.5


def test_the_report_survives_its_file(found, tmp_path):
    found.report.save(tmp_path / "report.json")
    assert EvalReport.load(tmp_path / "report.json") == found.report
    content = json.loads((tmp_path / "report.json").read_text())
    assert (
        content["models"]["still"]["mean"]["novel_view"]["psnr"]
        == found.report.models["still"].mean("novel_view")["psnr"]
    )
    (tmp_path / "other.json").write_text("[]")
    (tmp_path / "newer.json").write_text('{"schema": 99}')
    for name in ("other.json", "newer.json", "none.json"):
        with pytest.raises(InputError, match="report"):
            EvalReport.load(tmp_path / name)


def test_reports_from_before_counts_and_inputs_are_read(found):
    values = json.loads(json.dumps(found.report.as_dict()))
    del values["inputs"]
    for model in values["models"].values():
        del model["counts"], model["spread"]
    for surfaces in (values["skinning_alone"], *(model["surfaces"] for model in values["models"].values())):
        for one in surfaces.values():
            del one["spread"]
    report = EvalReport.from_dict(values)
    assert report == found.report and report.inputs == InputProtocol()
    del values["models"]["still"]["parameters"]
    with pytest.raises(InputError, match=r"evaluation report.*parameters.*Evaluate again"):
        EvalReport.from_dict(values)


def leaves(value: object, path: tuple = ()) -> list[tuple]:
    """The paths to everything in nested mappings."""
    inner = (
        [leaf for key, one in value.items() for leaf in leaves(one, (*path, key))] if isinstance(value, dict) else []
    )
    return [path, *inner] if path else inner


def changed_at(values: dict, path: tuple, wrong: object) -> dict:
    """Nested mappings with one value changed: the mappings on the path are copies, because all would take seconds."""
    first, *rest = path
    return values | {first: changed_at(values[first], tuple(rest), wrong) if rest else wrong}


@pytest.mark.parametrize("wrong", ["words", [1], {"a": 1}, {"a": {"b": []}}, True, 1e400, None])
@pytest.mark.long
def test_reports_with_values_of_another_kind_are_refused_or_can_be_used(wrong, found):
    values = json.loads(json.dumps(found.report.as_dict()))
    refused = 0
    for path in leaves(values):
        try:
            report = EvalReport.from_dict(changed_at(values, path, wrong))
        except InputError:
            refused += 1
            continue
        json.dumps(report.as_dict())
    assert refused > (10 if wrong is None else 40)


def test_counts_and_spread_over_frames():
    views = {
        view_key("A", 1): ViewQuality(20.0, 30.0, 0.90),
        view_key("B_x", 1): ViewQuality(22.0, 30.0, 0.92, psnr_head=25.0),
        view_key("A", 7): ViewQuality(26.0, math.inf, 0.97),
    }
    model = ModelFigures(views={"novel_pose": views})
    assert model.counts("novel_pose") == ViewCounts(images=3, frames=2, cameras=2)
    assert model.counts("training") == ViewCounts(0, 0, 0)
    # The frames' means are 21 and 26 dB, .91 and .97; the head is in one frame alone, the image is infinite in one.
    spread = model.spread("novel_pose")
    assert spread == {"psnr": pytest.approx(np.std([21, 26], ddof=1)), "ssim": pytest.approx(0.06 / math.sqrt(2))}
    figures = summary_figures(model)
    assert figures["novel_pose.images"] == 3 and figures["novel_pose.frames"] == 2
    assert figures["novel_pose.psnr"] == pytest.approx(68 / 3)
    assert figures["novel_pose.psnr.spread"] == spread["psnr"]


def test_tables_print_counts_spreads_and_inputs(found):
    inputs = InputProtocol("tracked", "true", "none", 36, 12)
    views = {key: replace(q, psnr=q.psnr + k) for k, (key, q) in enumerate(_two_frames(found).items())}
    report = replace(found.report, models={"one": ModelFigures(views={"novel_view": views})}, inputs=inputs)
    tables = evaluation_tables(report)
    text = tables["novel_view"].text()
    assert "2 images, 2 frames of 1 camera;" in text and " SD" in text
    assert "parameters tracked, labels true, normals none, trained on 36 frames of 12 cameras" in text
    assert "not known" in evaluation_tables(replace(report, inputs=InputProtocol()))["summary"].text()
    assert tables["novel_view"].rows["one"]["psnr.spread"] == pytest.approx(1 / math.sqrt(2))
    assert EvalReport.from_dict(json.loads(json.dumps(report.as_dict()))).inputs == inputs
    with pytest.raises(InputError, match="parameters"):
        InputProtocol(parameters="fine")


def _two_frames(found) -> dict[str, ViewQuality]:
    quality = found.report.models["still"].views["novel_view"]["Held0_000000"]
    return {view_key("Held0", frame): quality for frame in (0, 1)}


def test_tables_hold_what_was_measured(found):
    tables = evaluation_tables(found.report)
    assert list(tables) == ["summary", *SETS, "surface", "cost"]
    assert list(tables["surface"].rows) == [SKINNING_ALONE, "still", "grown"]
    figures = summary_figures(found.report.models["grown"])
    assert figures["megabytes"] == pytest.approx(1.234e-3) and figures["surface.training.skin.p2s"] < 1e-3
    assert tables["summary"].rows["grown"]["novel_pose.psnr"] == figures["novel_pose.psnr"]
    assert (
        "perceptual" not in tables["novel_view"].csv() and "1 thread" in tables["cost"].caption
    ) or torch.get_num_threads() > 1
    assert all(table.text() and table.latex() for table in tables.values())


def test_the_same_again_also_alone(found, sequence):
    config = replace(CONFIG, protocol=ProtocolConfig(every=4, sets=("novel_pose",)), speed_pictures=0)
    again = evaluate_models({"grown": Grown(sequence.rig)}, sequence, config).report.models["grown"]
    before = found.report.models["grown"]
    assert again.views["novel_pose"] == before.views["novel_pose"]
    assert again.surfaces == {"held_out": before.surfaces["held_out"]}


def test_what_is_not_asked_for_is_not_measured(sequence):
    config = EvaluationConfig(
        protocol=ProtocolConfig(sets=("novel_pose",), every=2), metric="none", samples=0, speed_pictures=0, shown=0
    )
    seen = []
    only = evaluate_models({"still": still(sequence.rig)}, sequence, config, progress=lambda *at: seen.append(at))
    model = only.report.models["still"]
    assert list(model.views) == ["novel_pose"] and model.surfaces == {} and model.speed is None
    assert only.views == only.surfaces == () and seen == [("frames", 0.0), ("frames", 1.0)]
    assert list(evaluation_tables(only.report)) == ["summary", "novel_pose", "cost"]


def test_a_model_with_its_own_template_is_posed_by_it(sequence):
    """A model that brings its own rig: same figures as with the sequence's."""
    config = EvaluationConfig(protocol=ProtocolConfig(every=4), metric="none", samples=0, speed_pictures=0)
    found = evaluate_models({"own": still(Rig(doll().template)), "shared": still(sequence.rig)}, sequence, config)
    own, shared = found.report.models.values()
    assert own.views == shared.views


def test_models_are_needed_and_on_the_sequences_device(sequence):
    far = nn.Module()
    far.rig = Rig(doll().template, "meta")
    with pytest.raises(InputError, match="smplxpp train"):
        evaluate_models({}, sequence)
    with pytest.raises(InputError, match="on cpu"):
        evaluate_models({"far": far}, sequence)


def test_a_model_trains_on_as_before():
    model = still()
    model.train()
    with at_rest(model):
        assert not model.training and not torch.is_grad_enabled()
    assert model.training and torch.is_grad_enabled()


def test_a_metric_that_is_not_installed_is_logged_once(monkeypatch, caplog):
    def missing(weights):
        raise MissingPackageError("lpips", command="pip install lpips", purpose="LPIPS")

    monkeypatch.setattr(metric_names, "load_lpips", missing)
    with caplog.at_level(logging.WARNING):
        assert load_metric("lpips") is None
    assert len(caplog.records) == 1 and "pip install lpips" in caplog.text
    assert load_metric("none") is None
    with pytest.raises(InputError, match="st-lpips"):
        load_metric("mse")


def test_perceptual_distance_goes_by_its_own_name(sequence):
    pytest.importorskip("stlpips_pytorch")
    config = EvaluationConfig(protocol=ProtocolConfig(sets=("novel_pose",)), samples=0, speed_pictures=0)
    report = evaluate_models({"still": still(sequence.rig)}, sequence, config).report
    assert report.metric == "ST-LPIPS" and "ST-LPIPS" in report.conventions
    assert report.models["still"].mean("novel_pose")["perceptual"] > 0
    assert "ST-LPIPS" in evaluation_tables(report)["novel_pose"].text()


def test_lpips_has_columns_of_its_own_beside_another_distance(sequence, tmp_path, monkeypatch):
    of_torchvision, own = lpips_weights("alex")
    torch.save({**of_torchvision, **own}, tmp_path / "weights.pth")
    torch.manual_seed(1)
    monkeypatch.setattr(metric_names, "load_st_lpips", ShiftTolerantLPIPS)
    protocol = ProtocolConfig(sets=("novel_pose",), every=4)
    config = EvaluationConfig(protocol=protocol, samples=0, speed_pictures=0, lpips_weights=(tmp_path / "weights.pth",))
    models = {"still": still(sequence.rig)}
    both, alone = (evaluate_models(models, sequence, replace(config, metric=name)).report for name in ("both", "lpips"))
    assert (both.metric, both.lpips, alone.metric, alone.lpips) == ("ST-LPIPS", "LPIPS (alex)", "LPIPS (alex)", None)
    found, wanted = both.models["still"].mean("novel_pose"), alone.models["still"].mean("novel_pose")
    assert found["lpips"] == wanted["perceptual"] > 0 and found["perceptual"] != found["lpips"]
    text = evaluation_tables(both)["novel_pose"].text()
    assert "ST-LPIPS" in text and "LPIPS (alex)" in text and f"{found['lpips']:.4f}" in text
    assert {"ST-LPIPS", "LPIPS (alex)"} <= both.conventions.keys()
    both.save(tmp_path / "report.json")
    assert EvalReport.load(tmp_path / "report.json") == both


@pytest.mark.parametrize("size", [(64, 80), (128, 160), (100, 80), (64, 200)])
def test_a_camera_fits_whole_into_another_size(size):
    camera = doll().cameras["Ring0"]
    other = fitted(camera, *size)
    scale = min(size[0] / camera.width, size[1] / camera.height)
    corners = np.array([[0.1, 0.2, 0.0], [-0.1, 0.7, 0.1], [0.0, 0.4, -0.1]])
    before, after = (c.screen_from_world(corners)[:, :2] for c in (camera, other))
    middle, new_middle = np.array([camera.width, camera.height]) / 2, np.array(size) / 2
    np.testing.assert_allclose(after - new_middle, scale * (before - middle), atol=1e-9)
    assert (other.width, other.height) == size


def test_speed_needs_poses_and_pixels():
    camera: Camera = doll().cameras["Ring0"]
    with pytest.raises(InputError, match="one pose"):
        measure_speed(still(), [], camera)
    with pytest.raises(InputError, match="1 x 1"):
        measure_speed(still(), [BodyParams.rest(betas=2, expressions=0)], camera, size=(0, 10))


def test_parameters_that_parts_share_count_once(tmp_path):
    model = nn.Module()
    model.one = nn.Linear(3, 2)
    model.other = nn.Module()
    model.other.weight = model.one.weight
    assert parameter_counts(model) == {"one": 8, "total": 8}
    (tmp_path / "sub").mkdir()
    (tmp_path / "a").write_bytes(b"123")
    (tmp_path / "sub" / "b").write_bytes(b"4567")
    assert bytes_on_disk(tmp_path / "a") == 3 and bytes_on_disk(tmp_path) == 7


def test_infinite_figures_stay_infinite(found):
    values = json.loads(json.dumps(found.report.as_dict()))
    view = values["models"]["still"]["views"]["novel_view"]["Held0_000000"]
    view["psnr"] = view["psnr_image"] = None
    again = EvalReport.from_dict(values).models["still"].views["novel_view"]["Held0_000000"]
    assert again.psnr == again.psnr_image == math.inf
