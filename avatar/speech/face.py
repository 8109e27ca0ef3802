"""The mouth's articulators, and ARKit's expressions, on a body's own face and its jaw joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from avatar.speech.arkit import ARKIT, BLINK
from avatar.speech.bases import numbered_basis
from avatar.speech.coarticulation import ARTICULATORS
from smplxpp.body.model import BodyModel
from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams

JAW_ANGLE = 0.15
"""Radians that the jaw hangs at most beyond rest, where training saw no more."""
MARGIN = 0.15
"""Of an expression (no unit) beyond what training saw of it, where it saw it move."""
MARGIN_NUMBERED = 0.5
"""The same of a numbered one, whose unit is a standard deviation."""
MOST = 0.8
"""Of an expression that training did not see move, the most that is asked for."""
MOST_NUMBERED = 2.0
"""The same of a numbered one, either way."""
_MOVES = 0.05  # spread from which an expression counts as seen to move; of the jaw, radians
_JAW = 0  # of rotation axes: x, about which the jaw hangs
_OPEN = 0.5  # ARKit's jawOpen at which the jaw hangs as far as an open vowel has it

# Articulator -> ARKit's expressions at its 1.
_ARKIT: dict[str, dict[str, float]] = {
    "jaw": {"jawOpen": 0.25, "mouthLowerDown": 0.15},
    "press": {"mouthPress": 0.5, "mouthRollLower": 0.3, "mouthRollUpper": 0.25},
    "tuck": {"mouthRollLower": 0.7, "mouthUpperUp": 0.2},
    "round": {"mouthPucker": 0.7, "mouthFunnel": 0.35},
    "spread": {"mouthSmile": 0.3, "mouthStretch": 0.35},
    "bare": {"mouthLowerDown": 0.3, "mouthUpperUp": 0.2},
}
_JAW_ALONE = 0.6  # jawOpen of a body without a jaw joint


def _both_sides(name: str) -> tuple[str, ...]:
    return (name,) if name in ARKIT else (f"{name}Left", f"{name}Right")


def _named(names: list[str]) -> Float64[np.ndarray, "52 E"]:
    """ARKit's expressions on a body that has them by name."""
    wanted = {side for shape in _ARKIT.values() for one in shape for side in _both_sides(one)} | {*BLINK}
    missing = sorted(wanted - set(names))
    if missing:
        more = f" and {len(missing[3:])} more" if len(missing) > 3 else ""
        raise InputError(
            "expressions of the body",
            expected="ARKit's names, by which a mouth is moved, or numbers",
            received=f"{len(names)} expressions without {', '.join(missing[:3])}{more}",
        )
    return np.array([[float(name == own) for own in names] for name in ARKIT])


@dataclass(frozen=True, eq=False)
class Face:
    """How a body's face speaks.

    Attributes:
        arkit: expressions of each of `ARKIT` at its 1. basis: of each articulator. blink: of closed eyes.
        neutral: expressions at rest. lowest, highest: what is not left, whatever is asked for.
        jaw: rotation vector of the jaw at rest. jaw_reach: how far it hangs beyond it at most, radians.
        numbered: the expressions have no names.
    """

    arkit: Float64[np.ndarray, "52 E"]
    basis: Float64[np.ndarray, "6 E"]
    blink: Float64[np.ndarray, " E"]
    neutral: Float64[np.ndarray, " E"]
    lowest: Float64[np.ndarray, " E"]
    highest: Float64[np.ndarray, " E"]
    jaw: Float64[np.ndarray, " 3"]
    jaw_reach: float
    numbered: bool = False

    @staticmethod
    def of(
        expression_names: Sequence[str],
        joint_names: Sequence[str],
        seen: BodyParams | None = None,
        *,
        body: BodyModel | None = None,
    ) -> Face:
        """Make the face of a body whose expressions have ARKit's names, or are numbered.

        Args:
            seen: frames of the training: their mean is the face at rest; an expression that moves in them goes `MARGIN`
                beyond their range at most, others to `MOST`. None: rest is zero.
            body: whose numbered expressions ARKit's are solved for (`numbered_basis`); None: names are needed.

        Raises:
            InputError: a body with neither, or frames of another body.
        """
        names = list(expression_names)
        E = len(names)
        if seen is not None and seen.expression.shape[1] > E:
            raise InputError(
                "expressions of the training", expected=f"{E} a frame", received=str(seen.expression.shape[1])
            )
        numbered = body is not None and E > 0 and not set(ARKIT) & set(names)
        arkit = numbered_basis(body).coefficients if numbered and body is not None else _named(names)
        weights = np.zeros((len(ARTICULATORS), len(ARKIT)))
        for row, articulator in enumerate(ARTICULATORS):
            for one, value in _ARKIT[articulator].items():
                for side in _both_sides(one):
                    weights[row, ARKIT.index(side)] = value
        has_jaw = "jaw" in joint_names
        if not has_jaw:
            weights[ARTICULATORS.index("jaw"), ARKIT.index("jawOpen")] = _JAW_ALONE
        frames = np.zeros((1, E))
        jaw = np.zeros((1, 3))
        if seen is not None:
            frames = np.zeros((len(seen), E))
            frames[:, : seen.expression.shape[1]] = seen.expression
            jaw = np.asarray(seen.jaw_pose)
        neutral, low, high = frames.mean(axis=0), frames.min(axis=0), frames.max(axis=0)
        moved = high - low > _MOVES
        margin, least, most = (MARGIN_NUMBERED, -MOST_NUMBERED, MOST_NUMBERED) if numbered else (MARGIN, 0.0, MOST)
        rest = jaw.mean(axis=0)
        seen_reach = float(jaw[:, _JAW].max() - rest[_JAW])
        return Face(
            arkit=arkit,
            basis=weights @ arkit,
            blink=arkit[[ARKIT.index(side) for side in BLINK]].sum(axis=0),
            neutral=neutral,
            lowest=np.where(moved, low - margin, np.minimum(neutral, least)),
            highest=np.where(moved, high + margin, np.maximum(neutral, most)),
            jaw=rest,
            jaw_reach=(max(seen_reach, JAW_ANGLE) if has_jaw else 0.0),
            numbered=numbered,
        )

    def pose(
        self,
        curves: Float64[np.ndarray, "T 6"],
        closed_eyes: Float64[np.ndarray, " T"],
        *,
        strength: float = 1.0,
    ) -> tuple[Float64[np.ndarray, "T E"], Float64[np.ndarray, "T 3"]]:
        """Return expressions and rotation vectors of the jaw.

        Args:
            curves: `ARTICULATORS`, 0 to 1. closed_eyes: 0 to 1. strength: of the mouth; closures keep theirs.
        """
        scale = np.where(np.isin(ARTICULATORS, ("press", "tuck")), 1.0, strength)
        asked = self.neutral + (curves * scale) @ self.basis + closed_eyes[:, None] * self.blink
        jaw = np.tile(self.jaw, (len(curves), 1))
        opening = curves[:, ARTICULATORS.index("jaw")] * strength
        jaw[:, _JAW] += np.minimum(JAW_ANGLE * opening, self.jaw_reach)
        # A jaw that rests open has to close for bilabials.
        pressed = curves[:, ARTICULATORS.index("press")]
        jaw[:, _JAW] -= pressed * max(float(self.jaw[_JAW]), 0.0)
        return np.clip(asked, self.lowest, self.highest), jaw

    def pose_arkit(
        self, values: Float64[np.ndarray, "T 52"], *, strength: float = 1.0
    ) -> tuple[Float64[np.ndarray, "T E"], Float64[np.ndarray, "T 3"]]:
        """Return expressions and rotation vectors of the jaw, of curves of `ARKIT` as others give them.

        A jaw joint hangs by `jawOpen`, as far as for an open vowel at half of it, and closes by `mouthClose`; what the
        expression does beside it is left as small as for speech.
        """
        values = strength * values
        jaw = np.tile(self.jaw, (len(values), 1))
        if self.jaw_reach:
            opening = values[:, ARKIT.index("jawOpen")]
            shut = np.minimum(values[:, ARKIT.index("mouthClose")], opening)
            jaw[:, _JAW] += np.clip(JAW_ANGLE * (opening - shut) / _OPEN, 0.0, self.jaw_reach)
            values[:, ARKIT.index("jawOpen")] *= _ARKIT["jaw"]["jawOpen"]
            values[:, ARKIT.index("mouthClose")] = shut * _ARKIT["jaw"]["jawOpen"]
        return np.clip(self.neutral + values @ self.arkit, self.lowest, self.highest), jaw

    def pose_flame(
        self, values: Float64[np.ndarray, "T N"], turns: Float64[np.ndarray, "T 3"], *, strength: float = 1.0
    ) -> tuple[Float64[np.ndarray, "T E"], Float64[np.ndarray, "T 3"]]:
        """Return expressions and jaw, of FLAME's: a numbered body's are the first of the same.

        Raises:
            InputError: a body whose expressions have names.
        """
        if not self.numbered:
            raise InputError(
                "curves of FLAME",
                expected="a body with numbered expressions",
                received="one with ARKit's",
                remedy="give ARKit's",
            )
        asked = np.zeros((len(values), len(self.neutral)))
        width = min(asked.shape[1], values.shape[1])
        asked[:, :width] = strength * values[:, :width]
        jaw = self.jaw + strength * turns
        jaw[:, _JAW] = np.minimum(jaw[:, _JAW], self.jaw[_JAW] + max(self.jaw_reach, 0.0))
        return np.clip(self.neutral + asked, self.lowest, self.highest), jaw
