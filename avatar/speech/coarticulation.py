"""Coarticulation: turn phonemes into articulator curves by blending viseme targets with dominance functions.

Cohen and Massaro, Modeling coarticulation in synthetic visual speech (1993): every phoneme has, for each articulator
that it needs, a target and a dominance that decays with time from it; a curve is `sum_i D_i(t) T_i / (sum_i D_i(t) +
rest)`. Rounding thus spreads through consonants without a rounding target, and lips close for every bilabial.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from avatar.speech.phonemes import BILABIALS, LABIODENTALS, SILENCE, Phoneme, Speech

ARTICULATORS = ("jaw", "press", "tuck", "round", "spread", "bare")
"""Jaw hanging, lips pressed together, lower lip under the teeth, lips rounded, spread, teeth bared: 0 to 1."""
_JAW, _PRESS, _TUCK = (ARTICULATORS.index(name) for name in ("jaw", "press", "tuck"))

# Articulator -> (target, dominance). Articulators that a viseme does not name follow the neighbouring phonemes.
_Viseme = dict[str, tuple[float, float]]


def _vowel(jaw: float, round_: float = 0.0, spread: float = 0.0) -> _Viseme:
    return {
        **{"jaw": (jaw, 1.0), "round": (round_, 1.0), "spread": (spread, 1.0)},
        **{"press": (0.0, 1.0), "tuck": (0.0, 1.0)},
    }


_BILABIAL: _Viseme = {"jaw": (0.0, 3.0), "press": (1.0, 4.0), "tuck": (0.0, 2.0), "bare": (0.0, 2.0)}
_LABIODENTAL: _Viseme = {"jaw": (0.12, 2.0), "tuck": (1.0, 4.0), "press": (0.0, 2.0), "bare": (0.2, 1.0)}
_DENTAL: _Viseme = {"jaw": (0.25, 0.8), "bare": (0.3, 1.0), "press": (0.0, 1.0)}
_ALVEOLAR: _Viseme = {"jaw": (0.18, 0.6), "bare": (0.2, 0.5), "press": (0.0, 0.8)}
_VELAR: _Viseme = {"jaw": (0.25, 0.4), "press": (0.0, 0.8)}
_POSTALVEOLAR: _Viseme = {"jaw": (0.12, 1.2), "round": (0.7, 1.5), "bare": (0.5, 1.2), "press": (0.0, 1.0)}
_SIBILANT: _Viseme = {"jaw": (0.08, 1.4), "spread": (0.35, 0.6), "bare": (0.5, 1.2), "press": (0.0, 1.0)}
VISEMES: dict[str, _Viseme] = {
    SILENCE: {name: (0.0, 0.6) for name in ARTICULATORS},
    **dict.fromkeys(("P", "B", "M"), _BILABIAL),
    **dict.fromkeys(("F", "V"), _LABIODENTAL),
    **dict.fromkeys(("TH", "DH"), _DENTAL),
    **dict.fromkeys(("T", "D", "N", "L"), _ALVEOLAR),
    **dict.fromkeys(("K", "G", "NG", "HH"), _VELAR),
    **dict.fromkeys(("CH", "JH", "SH", "ZH"), _POSTALVEOLAR),
    **dict.fromkeys(("S", "Z"), _SIBILANT),
    "R": {"jaw": (0.22, 0.7), "round": (0.5, 0.9), "press": (0.0, 0.8)},
    "W": {"jaw": (0.12, 1.2), "round": (1.0, 2.0), "press": (0.0, 1.0)},
    "Y": {"jaw": (0.2, 0.7), "spread": (0.5, 0.8), "press": (0.0, 0.8)},
    **{"AA": _vowel(1.0), "AE": _vowel(0.85, spread=0.3), "AH": _vowel(0.6), "EH": _vowel(0.6, spread=0.3)},
    **{"IH": _vowel(0.35, spread=0.35), "IY": _vowel(0.22, spread=0.7), "ER": _vowel(0.35, 0.5)},
    **{"AO": _vowel(0.75, 0.55), "UH": _vowel(0.3, 0.6), "UW": _vowel(0.2, 1.0), "E": _vowel(0.45, spread=0.5)},
    "O": _vowel(0.5, 0.8),
}
"""Targets and dominances by phoneme; a diphthong is a sequence of two vowels. Tuned by eye."""
_DIPHTHONGS = {"AY": ("AA", "IH"), "AW": ("AA", "UH"), "EY": ("E", "IY"), "OW": ("O", "UW"), "OY": ("AO", "IH")}


@dataclass(frozen=True, kw_only=True)
class Timing:
    """Time constants of coarticulation, in seconds.

    Attributes:
        before: time constant of a dominance's rise ahead of a phoneme.
        after: time constant of its decay after the phoneme.
        lead: lead of the mouth before the sound.
        closing: time in which lips come together, and part again.
        rest: dominance of the mouth at rest, relative to the phonemes' (no unit).
    """

    before: float = 0.07
    after: float = 0.05
    lead: float = 0.02
    closing: float = 0.06
    rest: float = 0.05


def articulate(
    speech: Speech, times: Float64[np.ndarray, " T"], timing: Timing | None = None
) -> Float64[np.ndarray, "T 6"]:
    """Return the `ARTICULATORS` at given times, 0 to 1.

    A closure shorter than a frame is held for one, so that evenly spaced frames show every bilabial with closed lips.

    Args:
        speech: phonemes in time.
        times: seconds, ascending.
        timing: time constants.
    """
    timing = timing or Timing()
    # Intervals, targets T and dominances D of all phonemes.
    sounds = [part for one in _fill_silences(speech) for part in _split_diphthong(one)]
    starts = np.array([one.start for one in sounds]) - timing.lead
    ends = np.array([one.end for one in sounds]) - timing.lead
    target, dominance = np.zeros((2, len(sounds), len(ARTICULATORS)))
    for k, one in enumerate(sounds):
        for name, (value, strength) in VISEMES[one.name].items():
            target[k, ARTICULATORS.index(name)] = value
            dominance[k, ARTICULATORS.index(name)] = strength
    # Blend the phonemes near each time: sum D T / (sum D + rest).
    curves = np.zeros((len(times), len(ARTICULATORS)))
    reach = 12.0 * max(timing.before, timing.after)  # exp(-12) is negligible
    for row, t in enumerate(times):
        low, high = np.searchsorted(ends, t - reach), np.searchsorted(starts, t + reach)
        # Time from each phoneme's interval in units of its time constant, 0 inside; D decays as exp(-time).
        near = slice(low, high)
        away = np.maximum(np.maximum((starts[near] - t) / timing.before, (t - ends[near]) / timing.after), 0.0)
        weight = dominance[near] * np.exp(-away)[:, None]
        curves[row] = (weight * target[near]).sum(axis=0) / (weight.sum(axis=0) + timing.rest)
    _hold_closures(curves, speech, times, timing)
    return curves


def _fill_silences(speech: Speech) -> list[Phoneme]:
    """Return the phonemes with silences in the gaps, before the first and after the last."""
    # A second of silence on both sides lets the mouth open from rest and return to it.
    out, last = [Phoneme(SILENCE, -1.0, 0.0)], 0.0
    for one in speech.phonemes:
        if one.start > last + 1e-6:
            out.append(Phoneme(SILENCE, last, one.start))
        out.append(one)
        last = one.end
    return [*out, Phoneme(SILENCE, last, max(last, speech.seconds) + 1.0)]


def _split_diphthong(one: Phoneme) -> list[Phoneme]:
    if one.name not in _DIPHTHONGS:
        return [one]
    first, second = _DIPHTHONGS[one.name]
    middle = one.start + 0.6 * (one.end - one.start)  # the first vowel is the longer one
    return [Phoneme(first, one.start, middle), Phoneme(second, middle, one.end)]


def _hold_closures(
    curves: Float64[np.ndarray, "T 6"], speech: Speech, times: Float64[np.ndarray, " T"], timing: Timing
) -> None:
    """Close the lips for bilabials, and lower lip and teeth for labiodentals, whatever the neighbours blend to."""
    # The longest step between frames, which the window must cover for a closure to be seen.
    frame = float(np.diff(times).max(initial=0.0))
    for one in speech.phonemes:
        if one.name not in BILABIALS | LABIODENTALS:
            continue
        # A raised-cosine window about the middle of the phoneme, 1 for at least one frame.
        middle = 0.5 * (one.start + one.end) - timing.lead
        half = max(0.35 * (one.end - one.start), 0.5001 * frame)
        away = np.maximum(np.abs(times - middle) - half, 0.0) / timing.closing
        held = np.where(away < 1.0, 0.5 + 0.5 * np.cos(np.pi * np.minimum(away, 1.0)), 0.0)
        if one.name in BILABIALS:
            curves[:, _PRESS] = np.maximum(curves[:, _PRESS], held)
            curves[:, _JAW] *= 1.0 - held
        else:
            curves[:, _TUCK] = np.maximum(curves[:, _TUCK], held)
            curves[:, _JAW] = np.minimum(curves[:, _JAW], 1.0 - 0.85 * held)
