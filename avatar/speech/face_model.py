"""Any network from sound to ARKit's expressions, in ONNX.

Signature: one input of samples, float32 (1, N), mono; one output, float32 (1, T, 52) or (T, 52), T frames evenly over
the sound. The model's metadata may say `sample_rate` (Hz; 16000 where it does not) and `names` (of the 52, parted by
commas; alphabetical where it does not).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from avatar.speech.arkit import ARKIT
from avatar.speech.curves import Curves
from avatar.speech.text import EXTRA
from smplxpp.core.errors import InputError
from smplxpp.core.files.onnx_file import OnnxModel
from smplxpp.core.files.wave_file import Sound

_RATE = 16_000


class FaceModel:
    """A network that hears a sound and moves a face.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        InputError: no such model, or another signature.
    """

    def __init__(self, path: Path, *, threads: int = 2) -> None:
        self._model = OnnxModel(path, kind="face model", extra=EXTRA, threads=threads)
        inputs, outputs, said = self._model.inputs, self._model.outputs, self._model.metadata
        if len(inputs) != 1 or len(inputs[0].shape) != 2 or inputs[0].type != "tensor(float)" or len(outputs) != 1:
            raise InputError(
                self._model.subject,
                expected="one input of samples, float32 (1, N), and one output",
                received=f"{[(one.name, one.type, one.shape) for one in inputs]}, {len(outputs)} outputs",
            )
        try:
            self.rate = int(said.get("sample_rate", _RATE))
        except ValueError:
            self.rate = 0
        if not 4000 <= self.rate <= 192_000:
            raise InputError(
                f"{self._model.subject}: sample_rate", expected="4000 to 192000", received=repr(said["sample_rate"])
            )
        self._names = [one.strip() for one in said["names"].split(",")] if "names" in said else list(ARKIT)
        if sorted(self._names) != list(ARKIT):
            raise InputError(f"{self._model.subject}: names", expected="ARKit's 52, each once", received="others")

    def __call__(self, sound: Sound) -> Curves:
        """Return the curves of a sound.

        Raises:
            InputError: a model that cannot run, or gives something else.
        """
        samples = sound.at_rate(self.rate).samples.astype(np.float32)
        given = np.asarray(self._model.run({self._model.inputs[0].name: samples[None]})[0])
        values = given[0] if given.ndim == 3 and len(given) == 1 else given
        if values.ndim != 2 or values.shape[1] != len(ARKIT) or not len(values):
            raise InputError(self._model.subject, expected="an output (1, T, 52)", received=f"shape {given.shape}")
        order = [self._names.index(name) for name in ARKIT]
        return Curves.evenly(values[:, order].astype(np.float64), len(values) / max(sound.seconds, 1e-3))
