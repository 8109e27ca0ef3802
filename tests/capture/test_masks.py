"""Masks made by other tools, and by the user's own matting model."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from pipelines.cli import main
from smplxpp.capture import open_capture
from smplxpp.capture.views import check_size, read_alpha, read_color
from smplxpp.core import GeometryWarning
from smplxpp.core.errors import InputError
from smplxpp.core.files.image_file import image_orientation
from tests.capture.scene import make_scene
from tests.capture.writers import write_simple


@pytest.fixture
def rig(tmp_path):
    return write_simple(make_scene(), tmp_path / "rig")


@pytest.mark.parametrize(
    ("pattern", "cut_out"),
    [
        ("{c}/{c}_rgb{f:06d}.png", False),
        ("{c}/{c}_rgb{f:06d}_alpha.png", True),
        ("{c}/{c}_rgb{f:06d}.birefnet.webp", False),
        ("{c}/{f:06d}.png", True),
        ("{c}/{c}_mask{f:06d}.png", False),
        ("{c}_rgb{f:06d}.png", False),
        ("{c}-{f:04d}-matte.png", False),
    ],
)
def test_mattes_are_matched_to_images_by_name(rig, tmp_path, pattern, cut_out):
    scene = make_scene()
    for (camera, frame), mask in scene.masks.items():
        path = tmp_path / "mattes" / pattern.format(c=camera, f=frame)
        path.parent.mkdir(parents=True, exist_ok=True)
        rgba = np.dstack([scene.photographs[camera, frame], mask])
        Image.fromarray(rgba if cut_out else mask).save(path, lossless=True)
    capture = open_capture(rig, masks=tmp_path / "mattes")
    assert capture.presence("mask").all()
    for (camera, frame), mask in scene.masks.items():
        np.testing.assert_array_equal(capture.mask(camera, frame), mask)


def _stored(kind: str, mask: np.ndarray) -> Image.Image:
    """A matte of 0 and 255 as other programs store it."""
    inside = mask > 127
    ids = inside * (1 + np.arange(mask.shape[1]) % 19)
    if kind == "16 bits":
        return Image.fromarray(mask.astype(np.uint16) * 257)
    if kind == "8 bits in 16":
        return Image.fromarray(mask.astype(np.uint16))
    if kind == "floats":
        return Image.fromarray(mask.astype(np.float32) / 255)
    if kind == "one bit":
        return Image.fromarray(inside)
    if kind == "opaque channel":
        return Image.fromarray(np.dstack([mask, mask, mask, np.full_like(mask, 255)]))
    if kind == "transparent palette":
        image = Image.fromarray(inside.astype(np.uint8)).convert("P")
        image.putpalette([200, 10, 10] * 256)
        image.info["transparency"] = bytes([0, 255])
        return image
    if kind == "zero and one":
        return Image.fromarray(inside.astype(np.uint8))
    if kind == "ids of parts":
        return Image.fromarray(ids.astype(np.uint8))
    if kind == "ids in 16 bits":
        return Image.fromarray(ids.astype(np.uint16))
    palette = np.random.default_rng(0).integers(40, 255, (256, 3), dtype=np.uint8)
    palette[0] = 0
    if kind == "parts in a palette":
        image = Image.fromarray(ids.astype(np.uint8), mode="P")
        image.putpalette(palette.tobytes())
        return image
    assert kind == "parts in colours"
    return Image.fromarray(palette[ids])


PLAIN = ("16 bits", "8 bits in 16", "floats", "one bit", "opaque channel", "transparent palette")
IDS = ("zero and one", "ids of parts", "ids in 16 bits", "parts in a palette", "parts in colours")


@pytest.mark.parametrize("kind", [*PLAIN, *IDS])
def test_masks_are_read_by_the_meaning_of_their_values(tmp_path, kind):
    rng = np.random.default_rng(1)
    mask = np.where(rng.random((24, 32)) > 0.6, 255, 0).astype(np.uint8)
    path = tmp_path / ("mask.tif" if kind == "floats" else "mask.png")
    image = _stored(kind, mask)
    image.save(path, **({"transparency": image.info["transparency"]} if "transparency" in image.info else {}))
    if kind in IDS:
        with pytest.warns(GeometryWarning, match=r"no opacities; all that is not black is taken for the person"):
            found = read_alpha(path)
    else:
        found = read_alpha(path)
    assert found.mode == "L"
    np.testing.assert_array_equal(np.asarray(found), mask)


@pytest.mark.parametrize("orientation", [3, 6, 8])
def test_a_quarter_turn_is_made_where_the_calibration_asks_for_it(tmp_path, orientation):
    """Half a turn keeps the size, so that nothing tells what the calibration was made on: pixels stay as stored."""
    pixels = np.random.default_rng(2).integers(0, 255, (20, 30, 3), dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "a.png"
    Image.fromarray(pixels).save(path, exif=exif)
    assert image_orientation(path) == orientation
    stored = check_size(read_color(path), path, (30, 20), of="the size")
    np.testing.assert_array_equal(np.asarray(stored), pixels)
    turned = {6: -1, 8: 1}.get(orientation)
    if turned is None:
        with pytest.raises(InputError, match="expected 20 x 30 pixels"):
            check_size(read_color(path), path, (20, 30), of="the size")
    else:
        found = check_size(read_color(path), path, (20, 30), of="the size")
        np.testing.assert_array_equal(np.asarray(found), np.rot90(pixels, turned))


def test_a_camera_whose_name_begins_another_keeps_its_own_mattes(tmp_path):
    scene = make_scene(names=("Cam1", "Cam10", "Cam2"))
    rig = write_simple(scene, tmp_path / "rig")
    (tmp_path / "mattes").mkdir()
    for (camera, frame), mask in scene.masks.items():
        Image.fromarray(mask).save(tmp_path / "mattes" / f"{camera}_{frame}.png")
    capture = open_capture(rig, masks=tmp_path / "mattes")
    for (camera, frame), mask in scene.masks.items():
        np.testing.assert_array_equal(capture.mask(camera, frame), mask)


def test_masks_given_replace_those_of_the_capture(rig, tmp_path):
    (tmp_path / "mattes/A").mkdir(parents=True)
    Image.new("L", (192, 256), 207).save(tmp_path / "mattes/A/000000.png")
    capture = open_capture(rig, masks=tmp_path / "mattes")
    assert (capture.mask("A", 0) == 207).all()
    assert capture.mask("A", 1) is None and capture.mask("B", 0) is None


def test_folders_without_a_matching_matte_are_refused(rig, tmp_path):
    with pytest.raises(InputError, match="existing folder"):
        open_capture(rig, masks=tmp_path / "nowhere")
    (tmp_path / "mattes").mkdir()
    Image.new("L", (192, 256)).save(tmp_path / "mattes/other.png")
    with pytest.raises(InputError, match=r"A/A_rgb000000\.png.*other\.png"):
        open_capture(rig, masks=tmp_path / "mattes")


def test_sixteen_bit_masks_keep_their_range(rig):
    path = rig / "masks/A/A_mask000000.png"
    ramp = np.linspace(0, 65535, 192 * 256).reshape(256, 192).astype(np.uint16)
    Image.fromarray(ramp).save(path)
    mask = open_capture(rig).mask("A", 0)
    np.testing.assert_allclose(mask, ramp / 257.0, atol=0.51)


def model_file(path, *, side: int | str, logits: bool) -> None:
    """A model that calls red things the person: the first channel, undone its normalisation, as matte or as logits."""
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    def constant(name, value):
        return helper.make_node(
            "Constant", [], [name], value=numpy_helper.from_array(np.array(value, dtype=np.float32), name)
        )

    nodes = [
        constant("std", 0.229),
        constant("mean", 0.485),
        helper.make_node("Split", ["image"], ["r", "g", "b"], axis=1, num_outputs=3),
        helper.make_node("Mul", ["r", "std"], ["scaled"]),
        helper.make_node("Add", ["scaled", "mean"], ["red"]),
    ]
    if logits:
        nodes += [
            constant("steep", 40.0),
            constant("half", 0.5),
            helper.make_node("Sub", ["red", "half"], ["centred"]),
            helper.make_node("Mul", ["centred", "steep"], ["matte"]),
        ]
    else:
        nodes += [helper.make_node("Identity", ["red"], ["matte"])]
    graph = helper.make_graph(
        nodes,
        "red",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 3, side, side])],
        [helper.make_tensor_value_info("matte", TensorProto.FLOAT, [1, 1, side, side])],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), path)


@pytest.mark.parametrize(("side", "logits"), [(64, False), ("side", True)])
def test_a_users_model_writes_masks_in_our_layout(rig, tmp_path, side, logits):
    pytest.importorskip("onnxruntime")
    from smplxpp.capture.masks import MattingModel, write_mattes

    model_file(tmp_path / "red.onnx", side=side, logits=logits)
    picture = np.zeros((40, 30, 3), np.uint8)
    picture[:, 15:, 0] = 255
    matte = MattingModel(tmp_path / "red.onnx")(picture)
    assert matte.shape == (40, 30) and matte.dtype == np.uint8
    assert matte[:, :13].max() <= 2 and matte[:, 17:].min() >= 253

    capture = open_capture(rig)
    written = list(write_mattes(capture, MattingModel(tmp_path / "red.onnx"), tmp_path / "mattes"))
    assert len(written) == 6 and written[0].name == "A_mask000000.png"
    stamp = written[0].stat().st_mtime_ns
    list(write_mattes(capture, MattingModel(tmp_path / "red.onnx"), tmp_path / "mattes"))
    assert written[0].stat().st_mtime_ns == stamp
    scene, matted = make_scene(), open_capture(rig, masks=tmp_path / "mattes")
    if logits:  # the room is blue, the person is not
        inside = matted.mask("A", 0) > 127
        truth = scene.masks["A", 0] > 127
        assert (inside & truth).sum() / (inside | truth).sum() > 0.95


@pytest.mark.long
def test_convert_takes_the_mattes_of_a_users_model(rig, tmp_path, capsys):
    pytest.importorskip("onnxruntime")
    model_file(tmp_path / "red.onnx", side="side", logits=True)
    command = ["capture", "convert", str(rig), "--matting", str(tmp_path / "red.onnx"), "--json"]
    assert main([*command, "--out", str(tmp_path / "new")]) == 2
    assert "--masks" in capsys.readouterr().out and not (tmp_path / "new").exists()
    assert main([*command, "--out", str(tmp_path / "new"), "--masks", str(tmp_path / "mattes")]) == 0
    matted, converted = open_capture(rig, masks=tmp_path / "mattes"), open_capture(tmp_path / "new")
    assert np.array_equal(converted.mask("A", 0), matted.mask("A", 0))
    assert not np.array_equal(converted.mask("A", 0), open_capture(rig).mask("A", 0))


def test_what_is_no_matting_model_is_refused(tmp_path):
    pytest.importorskip("onnxruntime")
    from smplxpp.capture.masks import MattingModel

    with pytest.raises(InputError, match="existing ONNX file"):
        MattingModel(tmp_path / "none.onnx")
    (tmp_path / "broken.onnx").write_bytes(b"no")
    with pytest.raises(InputError, match=r"broken\.onnx"):
        MattingModel(tmp_path / "broken.onnx")
    os.mkfifo(tmp_path / "pipe.onnx")
    with pytest.raises(InputError, match="regular file"):
        MattingModel(tmp_path / "pipe.onnx")


def small_model(path, nodes, *, kind="FLOAT", shape=(1, 3, 8, 8), inputs=1):
    """A model of ready nodes between `image` (or `image0`, `image1`) and `matte`."""
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper

    names = [f"image{k}" for k in range(inputs)] if inputs != 1 else ["image"]
    graph = helper.make_graph(
        [helper.make_node(*node[:3], **node[3]) for node in nodes],
        "foreign",
        [helper.make_tensor_value_info(name, getattr(TensorProto, kind), shape) for name in names],
        [helper.make_tensor_value_info("matte", getattr(TensorProto, kind), None)],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), path)


@pytest.mark.parametrize(
    "options",
    [
        {"kind": "DOUBLE"},
        {"shape": (1, 3, 8)},
        {"shape": (1, 4, 8, 8)},
        {"shape": (4, 3, 8, 8)},
        {"shape": (1, 3, 1 << 30, 1 << 30)},
        {"shape": (1, 3, 0, 8)},
    ],
)
def test_models_for_something_else_are_refused_when_they_are_opened(tmp_path, options):
    pytest.importorskip("onnxruntime")
    from smplxpp.capture.masks import MattingModel

    small_model(tmp_path / "other.onnx", [("Identity", ["image"], ["matte"], {})], **options)
    with pytest.raises(InputError, match=r"other\.onnx"):
        MattingModel(tmp_path / "other.onnx")


@pytest.mark.parametrize(
    ("operation", "words"),
    [("Identity", "64|8 x 8"), ("Log", "finite"), ("Reshape", "that runs")],
)
def test_models_that_give_no_matte_are_refused_when_they_run(tmp_path, operation, words):
    pytest.importorskip("onnxruntime")
    from smplxpp.capture.masks import MattingConfig, MattingModel

    reduced = ("ReduceMean", ["image"], ["mean"], {"keepdims": 0})
    nodes = {
        "Identity": [("Identity", ["image"], ["matte"], {})],
        "Log": [("Split", ["image"], ["r", "g", "b"], {"axis": 1, "num_outputs": 3}), ("Log", ["r"], ["matte"], {})],
        "Reshape": [
            reduced,
            ("Cast", ["mean"], ["whole"], {"to": 7}),
            ("Shape", ["image"], ["shape"], {}),
            ("Add", ["shape", "whole"], ["wrong"], {}),
            ("Reshape", ["image", "wrong"], ["matte"], {}),
        ],
    }[operation]
    small_model(tmp_path / "foreign.onnx", nodes)
    with pytest.raises(InputError, match=words) as error:
        MattingModel(tmp_path / "foreign.onnx", MattingConfig(mean=(2.0, 2.0, 2.0)))(np.zeros((20, 10, 3), np.uint8))
    assert "foreign.onnx" in str(error.value)


@pytest.mark.long
def test_matting_without_onnxruntime_names_the_extra(tmp_path):
    code = (
        "import sys; sys.modules['onnxruntime'] = None\n"
        "from smplxpp.capture.masks import MattingModel\n"
        "try: MattingModel('x.onnx')\n"
        "except ImportError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=900, check=True)
    assert "(extra matting)" in done.stdout
