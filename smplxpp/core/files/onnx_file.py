"""ONNX models: opened by onnxruntime on the CPU, run, and told in words where they cannot be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.paths import read_bytes, regular_file

_SHOWN = 400


class OnnxModel:
    """A user's model.

    Args:
        shown: values inside the model that it gives too, behind its own outputs.

    Attributes:
        path: its file.
        subject: what errors call it.
        inputs, outputs: onnxruntime's, with `name`, `type` and `shape`.
        metadata: what the model says of itself, by name.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        InputError: no such file, or not a model.
    """

    def __init__(self, path: str | Path, *, kind: str, extra: str, threads: int = 2, shown: Sequence[str] = ()) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise MissingExtraError("onnxruntime", extra=extra, purpose=f"a {kind} in ONNX") from None
        self.path = regular_file(path, subject=kind, remedy="name an existing ONNX file")
        self.subject = f"{kind} {path}"
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        try:
            model = _showing(read_bytes(self.path, subject=kind), shown) if shown else str(self.path)
            self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # noqa: BLE001  onnxruntime raises classes of its own for every kind of damage
            raise InputError(self.subject, expected="an ONNX model", received=f"{error}"[:_SHOWN]) from None
        self.inputs, self.outputs = self._session.get_inputs(), self._session.get_outputs()
        self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)

    def run(self, values: Mapping[str, np.ndarray]) -> list[Any]:
        """What the model gives, in the order of `outputs`.

        Raises:
            InputError: it cannot compute these values.
        """
        try:
            return self._session.run(None, dict(values))
        except Exception as error:  # noqa: BLE001  onnxruntime raises classes of its own for whatever a model cannot do
            raise InputError(self.subject, expected="a model that runs", received=f"{error}"[:_SHOWN]) from None


def _showing(model: bytes, names: Sequence[str]) -> bytes:
    """Return a model with more outputs.

    Two messages of protocol buffers behind each other are one, whose lists are joined: a model (field 7: its graph) of
    a graph of outputs (field 12) of names (field 1) adds them, without a reader of ONNX.
    """

    def field(number: int, content: bytes) -> bytes:
        size, length = b"", len(content)
        while length > 0x7F:
            size, length = size + bytes([length & 0x7F | 0x80]), length >> 7
        return bytes([number << 3 | 2]) + size + bytes([length]) + content

    return model + field(7, b"".join(field(12, field(1, name.encode())) for name in names))
