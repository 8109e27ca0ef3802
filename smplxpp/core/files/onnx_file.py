"""Open and run ONNX models with onnxruntime on the CPU, with errors in plain words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes, regular_file
from smplxpp.core.lazy import import_extra


class OnnxModel:
    """An ONNX model of the user, opened for the CPU.

    Args:
        path: file of the model.
        kind: what the model is called in messages, such as "matting model".
        extra: extra of smplxpp that installs onnxruntime.
        threads: number of threads of the computation.
        shown: names of inner values that `run` returns after the outputs.

    Attributes:
        path: file of the model.
        subject: name of the model in messages.
        inputs: onnxruntime's descriptions of the inputs, with `name`, `type` and `shape`.
        outputs: the same of the outputs.
        metadata: custom metadata of the model, by name.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        InputError: no such file, or not a model.
    """

    def __init__(self, path: str | Path, *, kind: str, extra: str, threads: int = 2, shown: Sequence[str] = ()) -> None:
        onnxruntime = import_extra("onnxruntime", extra=extra, purpose=f"a {kind} in ONNX")
        self.path = regular_file(path, subject=kind, remedy="name an existing ONNX file")
        self.subject = f"{kind} {path}"
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        try:
            model = _with_outputs(read_bytes(self.path, subject=kind), shown) if shown else str(self.path)
            self._session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # noqa: BLE001  onnxruntime raises classes of its own for every kind of damage
            raise InputError(self.subject, expected="an ONNX model", received=f"{error}"[:400]) from None
        self._options = onnxruntime.RunOptions
        self.inputs, self.outputs = self._session.get_inputs(), self._session.get_outputs()
        self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)

    def run(self, values: Mapping[str, np.ndarray], *, release: bool = False) -> list[Any]:
        """Run the model on named inputs; returns its outputs in the order of `outputs`.

        A model may loop for ever: an interrupt ends it.

        Args:
            values: inputs by name.
            release: give the memory of this run back, which is kept for the next one otherwise.

        Raises:
            InputError: the model cannot compute with these values.
        """
        # In a thread of its own, because Python sees no interrupt before native code returns; the options end the run.
        options, answer = self._options(), Future[list[Any]]()
        options.log_severity_level = 4  # fatal alone: errors come out as exceptions
        if release:
            options.add_run_config_entry("memory.enable_memory_arena_shrinkage", "cpu:0")
        thread = Thread(target=self._answer, args=(dict(values), options, answer), daemon=True)
        thread.start()
        try:
            return answer.result()
        except Exception as error:  # noqa: BLE001  onnxruntime raises classes of its own for whatever a model cannot do
            raise InputError(self.subject, expected="a model that runs", received=f"{error}"[:400]) from None
        finally:
            options.terminate = True
            thread.join(timeout=5.0)  # seconds; the run ends between two operators

    def _answer(self, values: dict[str, np.ndarray], options: Any, answer: Future[list[Any]]) -> None:
        try:
            answer.set_result(self._session.run(None, values, options))
        except Exception as error:  # noqa: BLE001  passed on to the thread that asked
            answer.set_exception(error)


def _with_outputs(model: bytes, names: Sequence[str]) -> bytes:
    """Return the bytes of a model with more outputs.

    Concatenated protocol buffer messages merge, and their lists are joined. So appending a model (field 7: graph) whose
    graph has outputs (field 12) with names (field 1) adds these outputs without a parser of ONNX.
    """

    def field(number: int, content: bytes) -> bytes:
        size, length = b"", len(content)
        while length > 0x7F:
            size, length = size + bytes([length & 0x7F | 0x80]), length >> 7
        return bytes([number << 3 | 2]) + size + bytes([length]) + content

    return model + field(7, b"".join(field(12, field(1, name.encode())) for name in names))
