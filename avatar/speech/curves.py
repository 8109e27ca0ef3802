"""Face curves in time: ARKit's 52 blendshapes or FLAME's expressions, and the syllables found in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from avatar.speech.phonemes import Phoneme, Speech
from smplxpp.core.errors import InputError

_SIDED = (
    *("eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide", "browDown"),
    *("browOuterUp", "cheekSquint", "noseSneer", "mouthSmile", "mouthFrown", "mouthDimple", "mouthStretch"),
    *("mouthPress", "mouthLowerDown", "mouthUpperUp"),
)
_UNSIDED = (
    *("jawForward", "jawLeft", "jawRight", "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker", "mouthLeft"),
    *("mouthRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "browInnerUp"),
    *("cheekPuff", "tongueOut"),
)
ARKIT: tuple[str, ...] = tuple(sorted([*_UNSIDED, *(f"{name}{side}" for name in _SIDED for side in ("Left", "Right"))]))
"""ARKit's 52 blendshapes by name, in alphabetical order."""
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
