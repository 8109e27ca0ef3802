"""Tiny keypoint models in ONNX that know red, green and blue spots: what a detector has to find in an image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

NAMES = ("nose", "coco_left_hip", "coco_right_hip")
SPOT = 2.5
"""Radius of a spot, pixels."""


def spotted(
    points: np.ndarray, size: tuple[int, int], background: tuple[int, int, int] = (0, 0, 0), radius: float = SPOT
) -> np.ndarray:
    """An image with a soft red, green and blue spot at the points, centres at +0.5."""
    rows, columns = np.mgrid[: size[1], : size[0]] + 0.5
    image = np.broadcast_to(np.array(background, float), (size[1], size[0], 3)).copy()
    for k, (x, y) in enumerate(points):
        image[..., k] += 255 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * radius**2))
    return np.clip(image, 0, 255).astype(np.uint8)


def write_model(path: Path, kind: str, *, width: int = 48, height: int = 64, channels: int = 3) -> Path:
    """A model whose points are where the channels of its input, divided by 255, are brightest.

    Args:
        kind: "simcc" with two bins a pixel, "heatmap" with a cell every other pixel, "points", which no detector reads.
    """
    import onnx
    from onnx import TensorProto, helper, numpy_helper

    def constant(name: str, value: np.ndarray) -> onnx.NodeProto:
        return helper.make_node("Constant", [], [name], value=numpy_helper.from_array(value, name))

    def output(name: str, *shape: int) -> onnx.ValueInfoProto:
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 3, *shape])

    if kind == "simcc":
        nodes = []
        for name, axis in (("x", 2), ("y", 3)):
            length = width if name == "x" else height
            nodes += [
                constant(f"axis_{name}", np.array([axis], np.int64)),
                helper.make_node("ReduceMax", ["image", f"axis_{name}"], [f"rows_{name}"], keepdims=0),
                constant(f"sizes_{name}", np.array([1, 3, 2 * length], np.int64)),
                helper.make_node(
                    "Resize",
                    [f"rows_{name}", "", "", f"sizes_{name}"],
                    [f"simcc_{name}"],
                    mode="linear",
                    coordinate_transformation_mode="asymmetric",
                ),
            ]
        outputs = [output("simcc_x", 2 * width), output("simcc_y", 2 * height)]
    elif kind == "heatmap":
        nodes = [
            constant("starts", np.array([0, 0], np.int64)),
            constant("ends", np.array([height, width], np.int64)),
            constant("axes", np.array([2, 3], np.int64)),
            constant("steps", np.array([2, 2], np.int64)),
            helper.make_node("Slice", ["image", "starts", "ends", "axes", "steps"], ["heatmaps"]),
        ]
        outputs = [output("heatmaps", height // 2, width // 2)]
    else:
        nodes = [
            constant("axes", np.array([2, 3], np.int64)),
            helper.make_node("ReduceMax", ["image", "axes"], ["points"], keepdims=0),
        ]
        outputs = [helper.make_tensor_value_info("points", TensorProto.FLOAT, [1, channels])]
    image = helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, channels, height, width])
    graph = helper.make_graph(nodes, "spots", [image], outputs)
    path.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), path)
    return path


def write_card(path: Path, **changes: object) -> Path:
    """The card of such a model."""
    import json

    content = {"names": NAMES, "mean": [0, 0, 0], "std": [255, 255, 255], **changes}
    path.with_suffix(".json").write_text(json.dumps(content))
    return path
