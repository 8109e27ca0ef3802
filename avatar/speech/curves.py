"""Curves of a face that other engines made: ARKit's 52 or FLAME's expressions in time, and the speech in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from avatar.speech.arkit import ARKIT, BLINK
from avatar.speech.phonemes import Phoneme, Speech
from smplxpp.core.errors import InputError

FLAME = 50
"""Expressions of FLAME that other engines give; SMPL-X's are the first ten, or hundred, of the same space."""
_LONGEST = 1800.0  # seconds
_OPEN, _STRONG = 0.12, 0.5  # of the widest opening: from which somebody speaks; from which a syllable is stressed
_BLINKS = 0.4  # from which an eye counts as closed now and then
_SYLLABLE = 0.12  # seconds


@dataclass(frozen=True, eq=False)
class Curves:
    """A face in time.

    Attributes:
        times: seconds, ascending from 0. values: of `ARKIT` in its order, 0 to 1; or of FLAME (up to 50).
        jaw: rotation vectors of the jaw joint beside FLAME's expressions; None with ARKit's, whose `jawOpen` hangs it.

    Raises:
        InputError: no frame, times that do not ascend, other widths, NaN, or more than half an hour.
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
        if self.times[-1] > _LONGEST:
            refuse("times", f"at most {_LONGEST:g} s", f"{self.times[-1]:.0f} s")
        if self.jaw is None and width != len(ARKIT):
            refuse("expressions", f"{len(ARKIT)} of ARKit", width)
        if self.jaw is not None and (self.jaw.shape != (T, 3) or not 1 <= width <= FLAME):
            refuse("expressions", f"up to {FLAME} of FLAME with a jaw of three numbers", (width, self.jaw.shape))
        for what, value, most in (("expressions", self.values, 100.0), ("jaw", self.jaw, 7.0)):
            if value is not None and not (np.abs(value) <= most).all():
                refuse(what, f"numbers within {most:g}", "others or NaN")

    @staticmethod
    def evenly(values: Float64[np.ndarray, "T N"], fps: float, jaw: Float64[np.ndarray, "T 3"] | None = None) -> Curves:
        """Return curves of so many frames a second.

        Raises:
            InputError: no positive rate, and what `Curves` refuses.
        """
        if not 0.0 < fps <= 1000.0:
            raise InputError("curves: frames a second", expected="more than 0, at most 1000", received=f"{fps:g}")
        return Curves(np.arange(len(values)) / fps, np.asarray(values, np.float64), jaw)

    @property
    def seconds(self) -> float:
        """When the last frame is over."""
        return float(self.times[-1] + (self.times[-1] / max(len(self.times) - 1, 1)))

    @property
    def blinks(self) -> bool:
        """Whether the eyes close in them."""
        lids = [ARKIT.index(name) for name in BLINK]
        return self.jaw is None and float(self.values[:, lids].max()) > _BLINKS

    def at(self, times: Float64[np.ndarray, " S"]) -> tuple[Float64[np.ndarray, "S N"], Float64[np.ndarray, "S 3"]]:
        """Return values and jaw at other times, linearly between frames; neutral outside of them."""
        inside = ((times >= 0.0) & (times <= self.seconds))[:, None]

        def between(values: Float64[np.ndarray, "T W"]) -> Float64[np.ndarray, "S W"]:
            return inside * np.stack([np.interp(times, self.times, column) for column in values.T], axis=1)

        jaw = np.zeros((len(times), 3)) if self.jaw is None else between(self.jaw)
        return between(self.values), jaw

    def speech(self) -> Speech:
        """Return syllables where the mouth opens, stressed where it opens wide: what gestures go by."""
        if self.jaw is None:
            opening = self.values[:, ARKIT.index("jawOpen")] - self.values[:, ARKIT.index("mouthClose")]
        else:
            opening = self.jaw[:, 0]
        opening = opening - np.quantile(opening, 0.05)
        widest = max(float(opening.max()), 1e-6)
        around = np.pad(opening, 1, constant_values=np.inf)  # no top at either end
        middle = (opening >= around[:-2]) & (opening > around[2:])
        tops = np.flatnonzero(middle & (opening > _OPEN * widest))
        out, last = [], 0.0
        for k in tops:
            start, end = self.times[k] - 0.5 * _SYLLABLE, self.times[k] + 0.5 * _SYLLABLE
            if start >= last:
                stress = int(opening[k] > _STRONG * widest)
                out.append(Phoneme("AH", float(start), float(min(end, self.seconds)), stress))
                last = end
        return Speech(tuple(out), self.seconds)
