"""ONNX models: opened by onnxruntime on the CPU, run, and told in words where they cannot be."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.files.paths import regular_file

_SHOWN = 400


class OnnxModel:
    """A user's model.

    Attributes:
        path: its file.
        subject: what errors call it.
        inputs, outputs: onnxruntime's, with `name`, `type` and `shape`.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        InputError: no such file, or not a model.
    """

    def __init__(self, path: str | Path, *, kind: str, extra: str, threads: int = 2) -> None:
        try:
            import onnxruntime
        except ImportError:
            raise MissingExtraError("onnxruntime", extra=extra, purpose=f"a {kind} in ONNX") from None
        self.path = regular_file(path, subject=kind, remedy="name an existing ONNX file")
        self.subject = f"{kind} {path}"
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        try:
            self._session = onnxruntime.InferenceSession(str(self.path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # noqa: BLE001  onnxruntime raises classes of its own for every kind of damage
            raise InputError(self.subject, expected="an ONNX model", received=f"{error}"[:_SHOWN]) from None
        self.inputs, self.outputs = self._session.get_inputs(), self._session.get_outputs()

    def run(self, values: Mapping[str, np.ndarray]) -> list[Any]:
        """What the model gives, in the order of `outputs`.

        Raises:
            InputError: it cannot compute these values.
        """
        try:
            return self._session.run(None, dict(values))
        except Exception as error:  # noqa: BLE001  onnxruntime raises classes of its own for whatever a model cannot do
            raise InputError(self.subject, expected="a model that runs", received=f"{error}"[:_SHOWN]) from None
