"""Build ONNX graphs by calls on the names of values."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np

from smplxpp.core.lazy import import_extra


class Graph:
    """A graph under construction: nodes and constants; a value is the name that a call returned.

    Raises:
        MissingExtraError: onnx is not installed.
    """

    def __init__(self, name: str) -> None:
        self._onnx = _onnx()
        self._name = name
        self._nodes: list[Any] = []
        self._constants: dict[tuple[str, tuple[int, ...], bytes], str] = {}
        self._initializers: list[Any] = []
        self._inputs: list[Any] = []

    def constant(self, value: Any, dtype: type | str = np.float32) -> str:
        """Return a constant; equal constants are stored once."""
        array = np.ascontiguousarray(value, dtype)
        key = (array.dtype.str, array.shape, array.tobytes())
        if key not in self._constants:
            self._constants[key] = self._store(f"c{len(self._initializers)}", array)
        return self._constants[key]

    def input(self, name: str, *shape: int, default: np.ndarray | None = None) -> str:
        """Return an input of floats, optional if it has a default."""
        self._inputs.append(self._onnx.helper.make_tensor_value_info(name, self._onnx.TensorProto.FLOAT, shape))
        if default is not None:
            self._store(name, np.ascontiguousarray(default, np.float32))
        return name

    def __call__(self, operator: str, *values: Any, **attributes: Any) -> str:
        """Return the output of an operator; arguments that are not names become float constants."""
        return self.split(operator, 1, *values, **attributes)[0]

    def split(self, operator: str, outputs: int, *values: Any, **attributes: Any) -> list[str]:
        """Return all outputs of an operator by their names."""
        names = [value if isinstance(value, str) else self.constant(value) for value in values]
        out = [f"v{len(self._nodes)}_{k}" for k in range(outputs)]
        self._nodes.append(self._onnx.helper.make_node(operator, names, out, **attributes))
        return out

    def gather(self, value: str, rows: Any) -> str:
        """Return selected rows of a value along its first axis."""
        return self("Gather", value, self.constant(rows, np.int32), axis=0)

    def reshape(self, value: str, *shape: int) -> str:
        """Return a value in another shape, with its numbers in order."""
        return self("Reshape", value, self.constant(shape, np.int64))

    def sum(self, value: str, axis: int, *, keep: bool = False) -> str:
        """Return the sum of a value along one axis."""
        return self("ReduceSum", value, self.constant([axis], np.int64), keepdims=int(keep))

    def norm(self, value: str) -> str:
        """Return Euclidean norms along the last axis, which is kept."""
        return self("Sqrt", self.sum(self("Mul", value, value), -1, keep=True))

    def scatter(self, value: str, rows: np.ndarray, count: int, width: int) -> str:
        """Scatter the rows of a value to `rows` (ascending) of a (count, width) array of zeros."""
        # Inverse index: each row of the output gathers its value, or the row of zeros appended after the last value.
        if len(rows) == count:
            return value
        place = np.full(count, len(rows), np.int64)
        place[rows] = np.arange(len(rows))
        return self.gather(self("Concat", value, np.zeros((1, width)), axis=0), place)

    def model(self, outputs: Mapping[str, tuple[str, tuple[int, ...]]], about: Mapping[str, str]) -> bytes:
        """Return the bytes of the ONNX file, checked.

        Args:
            outputs: value and shape by name.
            about: metadata of the file.
        """
        opset = 17  # version of the ONNX operators
        # An `Identity` gives each output its public name, even where one value is two outputs.
        helper, infos = self._onnx.helper, []
        for name, (value, shape) in outputs.items():
            self._nodes.append(helper.make_node("Identity", [value], [name]))
            infos.append(helper.make_tensor_value_info(name, self._onnx.TensorProto.FLOAT, shape))
        graph = helper.make_graph(self._nodes, self._name, self._inputs, infos, self._initializers)
        model = helper.make_model(
            graph, opset_imports=[helper.make_opsetid("", opset)], ir_version=8, producer_name="smplxpp"
        )
        helper.set_model_props(model, dict(about))
        self._onnx.checker.check_model(model)
        return model.SerializeToString()

    def _store(self, name: str, array: np.ndarray) -> str:
        self._initializers.append(self._onnx.numpy_helper.from_array(array, name))
        return name


def _onnx() -> ModuleType:
    onnx = import_extra("onnx", extra="onnx", purpose="an avatar as ONNX")
    for name in ("checker", "helper", "numpy_helper"):
        import_module(f"onnx.{name}")
    return onnx
