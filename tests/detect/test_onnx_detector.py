"""Keypoint models in ONNX: points come back where they are in the image, and what cannot be used is said."""

from __future__ import annotations

import json
import os
import signal
import threading

import numpy as np
import pytest

from smplxpp.body.layout import COCO_17, HALPE_26, WHOLE_BODY_133
from smplxpp.core.errors import InputError
from smplxpp.core.files.onnx_file import OnnxModel
from smplxpp.detect import load_detector, mask_box
from smplxpp.detect.detector import grown
from smplxpp.detect.model_card import ModelCard, load_card
from smplxpp.detect.onnx_detector import points_of
from tests.detect.keypoint_models import NAMES, spotted, write_card, write_model

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
POINTS = np.array([[41.3, 30.8], [55.0, 80.5], [25.7, 71.2]])


@pytest.mark.parametrize("kind", ["simcc", "heatmap"])
@pytest.mark.parametrize("box", [None, (15.0, 20.0, 70.0, 95.0), (10.0, 25.0, 90.0, 85.0)])
def test_spots_are_found_where_they_are(tmp_path, kind, box):
    detector = load_detector(write_card(write_model(tmp_path / "m.onnx", kind)))
    assert detector.names == NAMES
    image = spotted(POINTS, (90, 120), radius=4.0)
    (person,) = detector(image, box)
    # A pixel of the model is up to 2.3 of the image wide; its parabola tells a quarter of that.
    np.testing.assert_allclose(person.points, POINTS, atol=0.6)
    assert person.confidence.min() > 0.8


def test_a_point_moves_with_its_image_and_scales_with_it(tmp_path):
    detector = load_detector(write_card(write_model(tmp_path / "m.onnx", "simcc")))
    (here,) = detector(spotted(POINTS, (90, 120), radius=4.0))
    (there,) = detector(spotted(POINTS + [7, 0], (90, 120), radius=4.0))
    np.testing.assert_allclose(there.points - here.points, np.tile([7.0, 0.0], (3, 1)), atol=0.4)
    (twice,) = detector(spotted(2 * POINTS, (180, 240), radius=8.0))
    np.testing.assert_allclose(twice.points, 2 * here.points, atol=0.6)


def test_colours_are_exchanged_where_the_card_says_so(tmp_path):
    detector = load_detector(write_card(write_model(tmp_path / "m.onnx", "heatmap"), channels="bgr"))
    (person,) = detector(spotted(POINTS, (90, 120), radius=4.0))
    np.testing.assert_allclose(person.points, POINTS[::-1], atol=0.5)


def test_nobody_is_found_in_an_empty_image_or_an_empty_box(tmp_path):
    detector = load_detector(write_card(write_model(tmp_path / "m.onnx", "heatmap")))
    assert detector(np.zeros((120, 90, 3), np.uint8)) == []
    assert detector(spotted(POINTS, (90, 120)), (0.0, 0.0, 20.0, 20.0)) == []


def test_points_outside_of_the_image_do_not_count(tmp_path):
    detector = load_detector(write_card(write_model(tmp_path / "m.onnx", "heatmap"), least_confidence=0.01))
    # The box reaches beyond the image; what is drawn there is black, and the brightest of nothing is its corner.
    (person,) = detector(spotted(POINTS, (90, 120)), (30.0, 10.0, 200.0, 240.0))
    outside = (person.points < 0).any(axis=1) | (person.points > [90, 120]).any(axis=1)
    assert not (person.confidence[outside] > 0).any()


def test_identities_tell_models_and_cards_apart(tmp_path):
    one = load_detector(write_card(write_model(tmp_path / "a.onnx", "simcc"))).identity
    again = load_detector(write_card(write_model(tmp_path / "b.onnx", "simcc"))).identity
    other = load_detector(write_card(write_model(tmp_path / "c.onnx", "simcc"), padding=1.5)).identity
    assert (
        one == again
        and len({one, other, load_detector(write_card(write_model(tmp_path / "d.onnx", "heatmap"))).identity}) == 3
    )


@pytest.mark.parametrize("names", [COCO_17, HALPE_26, WHOLE_BODY_133])
def test_the_number_of_points_names_the_layouts_that_everybody_uses(names):
    rng = np.random.default_rng(0)
    truth = rng.uniform(20, 100, (len(names), 2))
    x, y = (np.exp(-((np.arange(2 * n) / 2 - truth[:, k, None]) ** 2) / 18) for k, n in ((0, 192), (1, 256)))
    found = points_of([x[None].astype(np.float32), y[None].astype(np.float32)], (192, 256))
    np.testing.assert_allclose(found[:, :2], truth, atol=1e-3)


@pytest.mark.parametrize("alignment", ["stride", "corners"])
def test_heatmaps_of_both_alignments_are_exact_for_gaussians(alignment):
    truth, size, cells = np.array([[50.25, 97.5], [130.0, 21.3]]), (192, 256), (48, 64)
    step = [(s - 1) / (c - 1) if alignment == "corners" else s / c for s, c in zip(size, cells, strict=True)]
    x, y = (np.arange(cells[k]) * step[k] for k in (0, 1))
    maps = np.exp(
        -((x[None, None] - truth[:, 0, None, None]) ** 2 + (y[None, :, None] - truth[:, 1, None, None]) ** 2) / 72
    )
    found = points_of([maps[None].astype(np.float32)], size, alignment=alignment)
    np.testing.assert_allclose(found[:, :2], truth, atol=1e-3)


@pytest.mark.parametrize(
    ("outputs", "words"),
    [
        ([np.zeros((1, 17, 3), np.float32)], "two outputs"),
        ([np.zeros((1, 17, 384), np.float32), np.zeros((1, 17, 384), np.float32)], "two outputs"),
        ([np.full((1, 17, 64, 48), np.nan, np.float32)], "NaN"),
        ([], "two outputs"),
    ],
)
def test_outputs_of_another_kind_are_refused(outputs, words):
    with pytest.raises(InputError, match=words):
        points_of(outputs, (192, 256))


def test_models_that_cannot_be_used_are_refused_in_words(tmp_path):
    with pytest.raises(InputError, match=r"mediapipe, or the path of a model\.onnx"):
        load_detector("openpose")
    with pytest.raises(InputError, match="existing"):
        load_detector(tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("no model")
    with pytest.raises(InputError, match="an ONNX model"):
        load_detector(tmp_path / "text.onnx")
    with pytest.raises(InputError, match="two outputs"):
        load_detector(write_model(tmp_path / "points.onnx", "points"))
    with pytest.raises(InputError, match=r"shape \(1, 3, H, W\)"):
        load_detector(write_model(tmp_path / "grey.onnx", "points", channels=1))
    with pytest.raises(InputError, match=r"17, 25, 26.*docs/detectors"):
        load_detector(write_model(tmp_path / "bare.onnx", "simcc"))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"names": ["nose", "left_horn", None]}, "left_horn"),
        ({"names": ["nose", "nose", None]}, "twice"),
        ({"layout": "coco"}, "coco-17"),
        ({"size": [192]}, "size"),
        ({"std": [0, 1, 1]}, "std"),
        ({"channels": "grb"}, "channels"),
        ({"padding": "wide"}, "padding"),
        ({"sizes": [1, 2]}, "sizes"),
        ([1, 2], "model card"),
    ],
)
def test_cards_that_say_something_else_are_refused(tmp_path, content, words):
    (tmp_path / "m.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=words):
        load_card(tmp_path / "m.onnx")


def test_a_card_says_only_what_differs(tmp_path):
    assert load_card(tmp_path / "none.onnx") == ModelCard()
    (tmp_path / "m.json").write_text(json.dumps({"layout": "halpe-26", "size": [288, 384]}))
    assert load_card(tmp_path / "m.onnx") == ModelCard(names=HALPE_26, size=(288, 384))


def test_boxes_are_those_of_masks_and_stay_in_the_image():
    mask = np.zeros((40, 30), np.uint8)
    assert mask_box(mask) is None
    mask[10:20, 5:9] = 255
    assert mask_box(mask) == (5.0, 10.0, 9.0, 20.0)
    assert grown((5.0, 10.0, 9.0, 20.0), 0.6, (30, 40)) == (0.0, 4.0, 15.0, 26.0)


def test_an_interrupt_ends_a_model_that_never_does(tmp_path):
    """Python sees no Ctrl-C before native code returns; a loop in a model did not."""
    import onnx
    from onnx import TensorProto, helper

    def value(name: str, kind: int, *shape: int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, kind, shape)

    nodes = [helper.make_node("Identity", ["go"], ["on"]), helper.make_node("Add", ["x", "x"], ["more"])]
    inside = [value("k", TensorProto.INT64), value("go", TensorProto.BOOL), value("x", TensorProto.FLOAT, 1)]
    body = helper.make_graph(
        nodes, "body", inside, [value("on", TensorProto.BOOL), value("more", TensorProto.FLOAT, 1)]
    )
    loop = helper.make_node("Loop", ["", "yes", "start"], ["end"], body=body)
    true = helper.make_tensor("yes", TensorProto.BOOL, [], [True])
    ends = [value("start", TensorProto.FLOAT, 1)], [value("end", TensorProto.FLOAT, 1)]
    graph = helper.make_graph([loop], "endless", *ends, initializer=[true])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), tmp_path / "m.onnx")
    model = OnnxModel(tmp_path / "m.onnx", kind="model", extra="matting")
    interrupt = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
    interrupt.start()
    with pytest.raises(KeyboardInterrupt):
        model.run({"start": np.ones(1, np.float32)})
    interrupt.join()
