"""Faces that other engines moved: their files, curves at other times, and a network from sound to a face."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from avatar.speech import Face, talking_motion
from avatar.speech.curves import Curves, FaceModel, read_curves
from avatar.speech.face import JAW_ANGLE
from pipelines.commands.talk import Talk
from smplxpp.body import load_body
from smplxpp.body.blendshapes import ARKIT
from smplxpp.core import BodyParams, InputError
from smplxpp.core.files.sound_file import Sound

BODY = load_body()
FACE = Face.of(BODY.expression_names, BODY.joint_names)
STILL = BodyParams.rest(betas=0, expressions=52)
LIVE = [name[0].upper() + name[1:] for name in ARKIT[::-1]]
JAW, SMILE, BLINK = (ARKIT.index(name) for name in ("jawOpen", "mouthSmileLeft", "eyeBlinkLeft"))


def waving(frames: int = 61) -> np.ndarray:
    """Values (T, 52): the mouth opens three times in two seconds, a smile comes up."""
    values = np.zeros((frames, 52))
    t = np.linspace(0.0, 2.0, frames)
    values[:, JAW] = 0.25 - 0.25 * np.cos(2 * np.pi * 1.5 * t)
    values[:, SMILE] = 0.3 * t
    return values


def live_link(values: np.ndarray, fps: float = 30.0, count: int = 60) -> str:
    """As Live Link Face writes: a timecode at 60 a second, a count, names with capitals, angles of head and eyes."""
    order = [ARKIT.index(name[0].lower() + name[1:]) for name in LIVE]
    rows = [",".join(["Timecode", "BlendshapeCount", *LIVE, "HeadYaw", "LeftEyeYaw"])]
    for k, row in enumerate(values):
        ticks = 59.0 * count + k * count / fps
        code = f"10:59:{int(ticks // count):02d}:{ticks % count:06.3f}"
        rows.append(",".join([code, "61", *(f"{one:.8f}" for one in row[order]), "0.1", "0.2"]))
    return "\n".join(rows) + "\n"


def test_live_link_face_is_read_over_the_minute(tmp_path):
    (tmp_path / "a.csv").write_text(live_link(waving()).replace("10:59:60", "11:00:00").replace("10:59:61", "11:00:01"))
    curves = read_curves(tmp_path / "a.csv")
    np.testing.assert_allclose(curves.values, waving(), atol=1e-8)
    np.testing.assert_allclose(curves.times, np.arange(61) / 30.0, atol=1e-3)


@pytest.mark.parametrize("count", [24, 25, 30, 50])
def test_timecodes_count_what_they_show(tmp_path, count):
    """Frames of 24, 25 or 30 were taken for sixtieths, so that each second jumped."""
    text = live_link(waving(), fps=count, count=count)
    for late in (2, 1, 0):
        text = text.replace(f"10:59:{60 + late}", f"11:00:{late:02d}")
    (tmp_path / "a.csv").write_text(text)
    np.testing.assert_allclose(read_curves(tmp_path / "a.csv").times, np.arange(61) / count, atol=1e-3)


def test_audio2face_is_read_as_rows_and_as_json(tmp_path):
    values = waving()
    rows = [",".join(["timeCode", *(f"blendShapes.{name}" for name in LIVE)])]
    order = [ARKIT.index(name[0].lower() + name[1:]) for name in LIVE]
    rows += [",".join(f"{one:.8f}" for one in (k / 60.0, *row[order])) for k, row in enumerate(values)]
    (tmp_path / "a.csv").write_text("\r\n".join(rows))
    stored = {"exportFps": 60.0, "numPoses": 52, "facsNames": LIVE, "weightMat": values[:, order].tolist()}
    (tmp_path / "a.json").write_text(json.dumps(stored))
    for name in ("a.csv", "a.json"):
        curves = read_curves(tmp_path / name)
        np.testing.assert_allclose(curves.values, values, atol=1e-8)
        np.testing.assert_allclose(curves.times, np.arange(61) / 60.0, atol=1e-6)


def test_arrays_of_52_and_of_flame_are_read(tmp_path):
    np.savez(tmp_path / "a.npz", blendshapes=waving().astype(np.float32), fps=25)
    curves = read_curves(tmp_path / "a.npz")
    assert curves.seconds == pytest.approx(61 / 25) and curves.jaw is None
    np.savez(tmp_path / "b.npz", expression=np.ones((7, 80)), jaw_pose=np.zeros((7, 3)))
    assert read_curves(tmp_path / "b.npz", fps=50).values.shape == (7, 50)
    mixed = np.random.default_rng(0).permutation(52)
    np.savez(tmp_path / "c.npz", arkit=waving()[:, mixed], names=np.array(ARKIT)[mixed])
    np.testing.assert_allclose(read_curves(tmp_path / "c.npz").values, waving())


@pytest.mark.parametrize(
    ("name", "text", "word"),
    [
        ("a.txt", "x", "csv"),
        ("a.csv", "a,b\n1,2\n", "ARKit"),
        ("a.csv", "", "rows"),
        ("a.csv", live_link(waving(3)) + "1,2\n", "row 5"),
        ("a.csv", live_link(waving(3)).replace("0.10000000,", "x,").replace("10:59:59:00.000", "noon"), "frames"),
        ("a.csv", live_link(waving(3)).replace("JawLeft", "JawOpen"), "twice"),
        ("a.csv", live_link(np.full((3, 52), np.nan)), "NaN"),
        ("a.json", "[1]", "curves"),
        ("a.json", json.dumps({"facsNames": LIVE, "weightMat": [[0.0] * 51]}), "weightMat"),
        ("a.json", json.dumps({"facsNames": LIVE, "weightMat": [[0.0] * 52], "exportFps": 0}), "frames a second"),
    ],
)
def test_files_that_are_none_are_refused(tmp_path, name, text, word):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=word):
        read_curves(tmp_path / name)


def test_curves_move_the_face_in_the_place_of_phonemes():
    curves = Curves.evenly(waving(), 30.0)
    motion = talking_motion(curves.speech(), FACE, STILL, curves=curves)
    smile = BODY.expression_names.index("mouthSmileLeft")
    np.testing.assert_allclose(motion.expression[:61, smile], waving()[:, SMILE], atol=1e-9)
    jaw = np.minimum(JAW_ANGLE * waving()[:, JAW] / 0.5, JAW_ANGLE)
    np.testing.assert_allclose(motion.jaw_pose[:61, 0], jaw, atol=1e-9)
    assert abs(motion.expression[-1, smile]) < 1e-9  # the curves are over
    assert [round(one.start + 0.06, 1) for one in curves.speech().phonemes] == [0.3, 1.0, 1.7]


def test_eyes_blink_by_themselves_unless_the_curves_do():
    still = np.zeros((600, 52))
    lids = BODY.expression_names.index("eyeBlinkLeft")
    quiet = Curves.evenly(still, 30.0)
    motion = talking_motion(quiet.speech(), FACE, STILL, curves=quiet)
    assert motion.expression[:, lids].max() > 0.7
    still[100:104, BLINK] = 0.6
    blinking = Curves.evenly(still, 30.0)
    motion = talking_motion(blinking.speech(), FACE, STILL, curves=blinking)
    assert np.flatnonzero(motion.expression[:, lids] > 0.1).tolist() == [100, 101, 102, 103]


def test_flame_moves_numbered_expressions_and_no_named_ones():
    curves = Curves.evenly(np.full((10, 50), 0.3), 30.0, np.tile([0.1, 0.0, 0.0], (10, 1)))
    numbered = replace(BODY, expression_names=tuple(f"expression_{k:02d}" for k in range(52)))
    face = Face.of(numbered.expression_names, numbered.joint_names, body=numbered)
    motion = talking_motion(curves.speech(), face, STILL, curves=curves)
    np.testing.assert_allclose(motion.expression[:10, :50].min(axis=1), 0.3)
    np.testing.assert_allclose(motion.jaw_pose[:10, 0], 0.1)
    with pytest.raises(InputError, match="numbered"):
        talking_motion(curves.speech(), FACE, STILL, curves=curves)


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    """A network that opens the jaw by the mean size of 160 samples at a time; its expressions stand in reverse."""
    onnx = pytest.importorskip("onnx", reason="makes a model to test with")
    pytest.importorskip("onnxruntime", reason="the extra talk runs models")
    from onnx import TensorProto, helper

    weights = np.zeros((52, 1, 160), np.float32)
    weights[51 - JAW] = 1.0 / 160
    nodes = [
        helper.make_node("Abs", ["samples"], ["size"]),
        helper.make_node("Unsqueeze", ["size", "axis"], ["one"]),
        helper.make_node("Conv", ["one", "weights"], ["wide"], strides=[160]),
        helper.make_node("Transpose", ["wide"], ["curves"], perm=[0, 2, 1]),
    ]
    graph = helper.make_graph(
        nodes,
        "face",
        [helper.make_tensor_value_info("samples", TensorProto.FLOAT, [1, None])],
        [helper.make_tensor_value_info("curves", TensorProto.FLOAT, [1, None, 52])],
        [
            helper.make_tensor("axis", TensorProto.INT64, [1], [1]),
            helper.make_tensor("weights", TensorProto.FLOAT, weights.shape, weights.ravel()),
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    helper.set_model_props(model, {"names": ",".join(ARKIT[::-1]), "sample_rate": "16000"})
    path = tmp_path_factory.mktemp("model") / "face.onnx"
    onnx.save(model, str(path))
    return path


def test_a_network_hears_a_sound_at_its_own_rate(model_file):
    t = np.arange(48_000) / 48_000
    curves = FaceModel(model_file)(Sound((0.4 * np.sign(np.sin(600 * t)) * (t > 0.5)).astype(np.float32), 48_000))
    assert len(curves.times) == 100 and curves.values[:, JAW].argmax() > 45
    assert curves.values[60:95, JAW].min() > 0.35 and np.abs(curves.values[:45]).max() < 1e-3
    assert not np.delete(curves.values, JAW, axis=1).any()


def test_a_model_with_another_signature_is_refused(model_file, tmp_path):
    onnx = pytest.importorskip("onnx")
    model = onnx.load(str(model_file))
    model.metadata_props[0].value = "a,b"
    onnx.save(model, str(tmp_path / "names.onnx"))
    with pytest.raises(InputError, match="names"):
        FaceModel(tmp_path / "names.onnx")
    model = onnx.load(str(model_file))
    model.graph.input[0].type.tensor_type.shape.dim.add().dim_value = 3
    onnx.save(model, str(tmp_path / "shape.onnx"))
    with pytest.raises(InputError, match=r"ONNX|one input"):
        FaceModel(tmp_path / "shape.onnx")


@pytest.mark.parametrize("other", [{"text": "hello"}, {"face_model": "m.onnx"}])
def test_the_command_takes_curves_alone(tmp_path, other):
    with pytest.raises(InputError, match="curves"):
        Talk(tmp_path, tmp_path / "a.npz", curves=tmp_path / "a.csv", **other).run()
