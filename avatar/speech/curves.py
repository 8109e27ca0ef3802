"""Face curves in time: ARKit's 52 blendshapes or FLAME's expressions, and the syllables found in them."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from avatar.speech.phonemes import Phoneme, Speech
from avatar.speech.pronunciation import EXTRA
from smplxpp.body.blendshapes import ARKIT
from smplxpp.core import DEFAULT_FPS, InputError
from smplxpp.core.files import as_list, as_number, as_numbers, as_object, as_text, read_arrays, read_json, read_text
from smplxpp.core.files.onnx_file import OnnxModel
from smplxpp.core.files.paths import ascii_numbers
from smplxpp.core.files.sound_file import Sound

BLINK = ("eyeBlinkLeft", "eyeBlinkRight")
FLAME_EXPRESSIONS = 50
"""Largest number of FLAME's expressions in curves; SMPL-X's are the first ten, or hundred, of the same space."""
MAX_SECONDS = 1800.0
"""Longest speech or face curves, seconds."""


@dataclass(frozen=True, eq=False)
class Curves:
    """Expressions of a face in time.

    Attributes:
        times: seconds, ascending from 0.
        values: of `ARKIT` in its order, 0 to 1; or of FLAME (up to 50).
        jaw: rotation vectors of the jaw joint beside FLAME's expressions; None with ARKit's, whose `jawOpen` hangs it.

    Raises:
        InputError: no frame, times that do not ascend, another number of values, NaN, or more than half an hour.
    """

    times: Float64[np.ndarray, " T"]
    values: Float64[np.ndarray, "T N"]
    jaw: Float64[np.ndarray, "T 3"] | None = None

    def __post_init__(self) -> None:
        def refuse(what: str, expected: str, received: object) -> None:
            raise InputError(f"curves: {what}", expected=expected, received=str(received))

        T, width = self.values.shape if self.values.ndim == 2 else (0, 0)
        if not T or self.times.shape != (T,):
            refuse(
                "frames", "at least one, each with its time", f"{self.values.shape} values, {self.times.shape} times"
            )
        if not (np.isfinite(self.times).all() and (np.diff(self.times) > 0.0).all() and abs(self.times[0]) < 1e-9):
            refuse("times", "ascending from 0", "others")
        if self.times[-1] > MAX_SECONDS:
            refuse("times", f"at most {MAX_SECONDS:g} s", f"{self.times[-1]:.0f} s")
        if self.jaw is None and width != len(ARKIT):
            refuse("expressions", f"{len(ARKIT)} of ARKit", width)
        if self.jaw is not None and (self.jaw.shape != (T, 3) or not 1 <= width <= FLAME_EXPRESSIONS):
            refuse(
                "expressions",
                f"up to {FLAME_EXPRESSIONS} of FLAME with a jaw of three numbers",
                (width, self.jaw.shape),
            )
        for what, value, most in (("expressions", self.values, 100.0), ("jaw", self.jaw, 7.0)):
            if value is not None and not (np.abs(value) <= most).all():
                refuse(what, f"numbers within {most:g}", "others or NaN")

    @staticmethod
    def evenly(values: Float64[np.ndarray, "T N"], fps: float, jaw: Float64[np.ndarray, "T 3"] | None = None) -> Curves:
        """Return curves at a constant frame rate, frames a second.

        Raises:
            InputError: no positive rate, and what `Curves` refuses.
        """
        if not 0.0 < fps <= 1000.0:
            raise InputError("curves: frames a second", expected="more than 0, at most 1000", received=f"{fps:g}")
        return Curves(np.arange(len(values)) / fps, np.asarray(values, np.float64), jaw)

    @property
    def seconds(self) -> float:
        """The end of the last frame, seconds."""
        return float(self.times[-1] + (self.times[-1] / max(len(self.times) - 1, 1)))

    @property
    def blinks(self) -> bool:
        """Whether the eyes close in some frame: a blink is above 0.4."""
        lids = [ARKIT.index(name) for name in BLINK]
        return self.jaw is None and float(self.values[:, lids].max()) > 0.4

    def at(self, times: Float64[np.ndarray, " S"]) -> tuple[Float64[np.ndarray, "S N"], Float64[np.ndarray, "S 3"]]:
        """Return values and jaw at other times, interpolated linearly; neutral outside of the curves."""
        # 0 outside of the curves, which is the neutral face; np.interp alone would hold the first and the last value.
        inside = ((times >= 0.0) & (times <= self.seconds))[:, None]

        def between(values: Float64[np.ndarray, "T W"]) -> Float64[np.ndarray, "S W"]:
            return inside * np.stack([np.interp(times, self.times, column) for column in values.T], axis=1)

        jaw = np.zeros((len(times), 3)) if self.jaw is None else between(self.jaw)
        return between(self.values), jaw

    def speech(self) -> Speech:
        """Return a syllable of 120 ms at each opening of the mouth, stressed where it is wide, for gestures."""
        if self.jaw is None:
            opening = self.values[:, ARKIT.index("jawOpen")] - self.values[:, ARKIT.index("mouthClose")]
        else:
            opening = self.jaw[:, 0]
        # Peaks of the opening above 12 % of the widest are syllables, above half of it stressed ones.
        opening = opening - np.quantile(opening, 0.05)
        widest = max(float(opening.max()), 1e-6)
        around = np.pad(opening, 1, constant_values=np.inf)  # no peak at either end
        local_maximum = (opening >= around[:-2]) & (opening > around[2:])
        peaks = np.flatnonzero(local_maximum & (opening > 0.12 * widest))
        syllable = 0.12
        out, last = [], 0.0
        for k in peaks:
            start, end = self.times[k] - 0.5 * syllable, self.times[k] + 0.5 * syllable
            if start >= last:
                stress = int(opening[k] > 0.5 * widest)
                out.append(Phoneme("AH", float(start), float(min(end, self.seconds)), stress))
                last = end
        return Speech(tuple(out), self.seconds)


_TIMECODE_RATES = (24, 25, 30, 50, 60)  # frames that the second of a timecode counts
_INDEX_OF_NAME = {name.lower(): k for k, name in enumerate(ARKIT)}


def read_curves(path: str | Path, *, fps: float | None = None) -> Curves:
    """Read face curves in the format of the file's suffix.

    - `.csv`: a row a frame, columns by ARKit's names in any case, with or without a prefix that ends in a point (Live
      Link Face, Audio2Face-3D); other columns are left out. A column of times: seconds, or
      hours:minutes:seconds:frames.
    - `.json`: Audio2Face's export: `facsNames`, `weightMat`, `exportFps`.
    - `.npz`: `blendshapes` (T, 52) with `names` of the columns, or `expression` (T, up to 50) and `jaw_pose` (T, 3) of
      FLAME; `fps`.

    Args:
        path: the file.
        fps: frames a second where the file does not state them; None: `DEFAULT_FPS`.

    Raises:
        InputError: another suffix, a file in none of these formats, or values that `Curves` refuses.
    """
    path = Path(path)
    readers: dict[str, Callable[[Path, float], Curves]] = {".csv": _csv, ".json": _json, ".npz": _npz}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise InputError(f"curves {path}", expected=".csv, .json or .npz", received=path.suffix or "no suffix")
    return reader(path, fps or DEFAULT_FPS)


def _csv(path: Path, fps: float) -> Curves:
    subject = f"curves {path}"
    try:
        rows = list(csv.reader(read_text(path, subject="curves", most=1 << 28).splitlines()))
    except csv.Error as error:
        raise InputError(subject, expected="comma-separated values", received=str(error)) from None
    rows = [row for row in rows if row]
    # Of a table: 55 minutes at 60 frames a second.
    max_rows = 200_000
    if not 2 <= len(rows) <= max_rows:
        expected = f"a row of names and up to {max_rows} of numbers"
        raise InputError(subject, expected=expected, received=f"{len(rows)} rows")
    # Columns of ARKit's blendshapes, whatever else the program writes beside them.
    names = [name.strip().rsplit(".", 1)[-1].lower() for name in rows[0]]
    where = _columns(names, subject)
    for number, row in enumerate(rows[1:], start=2):
        if len(row) != len(names):
            raise InputError(f"{subject}, row {number}", expected=f"{len(names)} values", received=str(len(row)))
    values = np.zeros((len(rows) - 1, len(ARKIT)))
    for column, k in where:
        values[:, k] = _floats([row[column] for row in rows[1:]], f"{subject}, column {rows[0][column]}")
    # Times of the frames, or a constant rate where there is no such column.
    time_columns = ("timecode", "time", "timestamp", "seconds")
    clock = next((names.index(one) for one in time_columns if one in names), None)
    if clock is None:
        return Curves.evenly(values, fps)
    times = _clock([row[clock] for row in rows[1:]], f"{subject}, column {rows[0][clock]}")
    good = np.r_[True, np.diff(np.maximum.accumulate(times)) > 0.0]  # phones write some frames twice
    return Curves(times[good] - times[0], values[good])


def _columns(names: Sequence[str], subject: str) -> list[tuple[int, int]]:
    """Return the columns of a table that are ARKit's, each with its index in `ARKIT`."""
    where = [(column, _INDEX_OF_NAME[name]) for column, name in enumerate(names) if name in _INDEX_OF_NAME]
    if "jawopen" not in names or len(where) < 10:
        received = ", ".join(names[:6])[:120] or "none"
        raise InputError(subject, expected="columns of ARKit's names, jawOpen among them", received=received)
    if len({k for _, k in where}) < len(where):
        raise InputError(subject, expected="every name once", received="one of ARKit's twice")
    return where


def _floats(texts: Sequence[str], subject: str) -> np.ndarray:
    try:
        return np.array([float(ascii_numbers(text) or 0.0) for text in texts])
    except ValueError as error:
        raise InputError(subject, expected="numbers", received=str(error)[:120]) from None


def _clock(texts: Sequence[str], subject: str) -> np.ndarray:
    """Parse seconds, or timecodes hours:minutes:seconds:frames.

    A second counts as many frames as the highest number shows: 24, 25, 30, 50 or 60. Within a single second, which may
    end early, it counts 60, as Live Link Face does.
    """
    if not any(":" in text for text in texts):
        return _floats(texts, subject)
    whole: list[float] = []
    counted: list[float] = []
    for text in texts:
        found = re.fullmatch(r"(?a)\s*(\d{1,3}):(\d{1,2}):(\d{1,2})[:;.](\d{1,3}(?:\.\d{1,9})?)\s*", text)
        if not found:
            raise InputError(subject, expected="hours:minutes:seconds:frames", received=repr(text[:40]))
        hours, minutes, seconds, frames = (float(one) for one in found.groups())
        whole.append(3600.0 * hours + 60.0 * minutes + seconds)
        counted.append(frames)
    most = int(max(counted)) + 1
    rate = next((rate for rate in _TIMECODE_RATES if rate >= most), None)
    if rate is None:
        raise InputError(subject, expected=f"frames below {_TIMECODE_RATES[-1]}", received=f"frame {most - 1}")
    rate = rate if len(set(whole)) > 1 else _TIMECODE_RATES[-1]
    return np.array(whole) + np.array(counted) / rate


def _json(path: Path, fps: float) -> Curves:
    subject = f"curves {path}"
    stored = as_object(read_json(path, subject="curves"), subject=subject)
    names = [as_text(one, subject=f"{subject}: facsNames") for one in as_list(stored.get("facsNames"), subject=subject)]
    where = _columns([name.lower() for name in names], subject)
    # A row a frame; columns in the order of `facsNames`.
    matrix = as_numbers(stored.get("weightMat"), (None, len(names)), subject=f"{subject}: weightMat")
    if "exportFps" in stored:
        fps = as_number(stored["exportFps"], subject=f"{subject}: exportFps")
    return Curves.evenly(_reorder(matrix, where), fps)


def _reorder(matrix: np.ndarray, where: Sequence[tuple[int, int]]) -> np.ndarray:
    values = np.zeros((len(matrix), len(ARKIT)))
    for column, k in where:
        values[:, k] = matrix[:, column]
    return values


def _npz(path: Path, fps: float) -> Curves:
    subject = f"curves {path}"
    arrays = read_arrays(path, subject="curves")
    if "fps" in arrays:
        fps = float(as_numbers(arrays["fps"], (), subject=f"{subject}: fps"))

    def take(wanted: Sequence[str]) -> Any:
        return next((arrays[name] for name in wanted if name in arrays), None)

    # Names under which common tools store the same arrays.
    shapes = take(("arkit", "blendshapes", "blendshape", "bs", "weights"))
    expression = take(("expression", "exp", "expr", "flame_expression"))
    jaw = take(("jaw_pose", "jaw", "jaw_rot"))
    if shapes is not None:
        names = [str(one) for one in np.ravel(arrays["names"])] if "names" in arrays else []
        where = _columns([name.lower() for name in names], subject) if names else [(k, k) for k in range(len(ARKIT))]
        width = len(names) or len(ARKIT)
        return Curves.evenly(_reorder(as_numbers(shapes, (None, width), subject=subject), where), fps)
    if expression is None or jaw is None:
        raise InputError(
            subject,
            expected="blendshapes (T, 52), or expression and jaw_pose of FLAME",
            received=", ".join(sorted(arrays)[:8]) or "nothing",
        )
    values = as_numbers(expression, (None, None), subject=f"{subject}: expression")
    return Curves.evenly(
        values[:, :FLAME_EXPRESSIONS], fps, as_numbers(jaw, (len(values), 3), subject=f"{subject}: jaw_pose")
    )


class FaceModel:
    """Any ONNX network from sound to ARKit's blendshapes.

    Signature: one input of samples, float32 (1, N), mono; one output, float32 (1, T, 52) or (T, 52), T frames evenly
    over the sound. The model's metadata may give `sample_rate` (Hz; 16000 by default) and `names` (of the 52, separated
    by commas; alphabetical by default).

    Args:
        path: the ONNX file.
        threads: of the runtime.

    Raises:
        MissingExtraError: onnxruntime is not installed.
        InputError: a missing model, or another signature.
    """

    def __init__(self, path: Path, *, threads: int = 2) -> None:
        self._model = OnnxModel(path, kind="face model", extra=EXTRA, threads=threads)
        inputs, outputs, metadata = self._model.inputs, self._model.outputs, self._model.metadata
        if len(inputs) != 1 or len(inputs[0].shape) != 2 or inputs[0].type != "tensor(float)" or len(outputs) != 1:
            raise InputError(
                self._model.subject,
                expected="one input of samples, float32 (1, N), and one output",
                received=f"{[(one.name, one.type, one.shape) for one in inputs]}, {len(outputs)} outputs",
            )
        try:
            self.rate = int(metadata.get("sample_rate", 16_000))
        except ValueError:
            self.rate = 0
        if not 4000 <= self.rate <= 192_000:
            raise InputError(
                f"{self._model.subject}: sample_rate", expected="4000 to 192000", received=repr(metadata["sample_rate"])
            )
        self._names = [one.strip() for one in metadata["names"].split(",")] if "names" in metadata else list(ARKIT)
        if sorted(self._names) != list(ARKIT):
            raise InputError(f"{self._model.subject}: names", expected="ARKit's 52, each once", received="others")

    def __call__(self, sound: Sound) -> Curves:
        """Return the face curves of a sound.

        Raises:
            InputError: a model that fails, or whose output has another shape.
        """
        samples = sound.at_rate(self.rate).samples.astype(np.float32)
        output = np.asarray(self._model.run({self._model.inputs[0].name: samples[None]})[0])
        values = output[0] if output.ndim == 3 and len(output) == 1 else output
        if values.ndim != 2 or values.shape[1] != len(ARKIT) or not len(values):
            raise InputError(self._model.subject, expected="an output (1, T, 52)", received=f"shape {output.shape}")
        order = [self._names.index(name) for name in ARKIT]
        return Curves.evenly(values[:, order].astype(np.float64), len(values) / max(sound.seconds, 1e-3))
