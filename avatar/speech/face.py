"""The mouth's articulators on a body's own face: expressions by ARKit's names, and the jaw joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from avatar.speech.coarticulation import ARTICULATORS
from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams

JAW_ANGLE = 0.15
"""Radians that the jaw hangs at most beyond rest, where training saw no more."""
MARGIN = 0.15
"""Of an expression (no unit) beyond what training saw of it, where it saw it move."""
MOST = 0.8
"""Of an expression that training did not see move, the most that is asked for."""
_MOVES = 0.05  # spread from which an expression counts as seen to move; of the jaw, radians
_JAW = 0  # of rotation axes: x, about which the jaw hangs

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
BLINK = ("eyeBlinkLeft", "eyeBlinkRight")


def _both_sides(name: str, known: Sequence[str]) -> tuple[str, ...]:
    return (name,) if name in known else (f"{name}Left", f"{name}Right")


@dataclass(frozen=True, eq=False)
class Face:
    """How a body's face speaks.

    Attributes:
        basis: expressions of each articulator at its 1. blink: the expressions of closed eyes.
        neutral: expressions at rest. lowest, highest: what is not left, whatever is asked for.
        jaw: rotation vector of the jaw at rest. jaw_reach: how far it hangs beyond it at most, radians.
    """

    basis: Float64[np.ndarray, "6 E"]
    blink: Float64[np.ndarray, " E"]
    neutral: Float64[np.ndarray, " E"]
    lowest: Float64[np.ndarray, " E"]
    highest: Float64[np.ndarray, " E"]
    jaw: Float64[np.ndarray, " 3"]
    jaw_reach: float

    @staticmethod
    def of(expression_names: Sequence[str], joint_names: Sequence[str], seen: BodyParams | None = None) -> Face:
        """Make the face of a body whose expressions have ARKit's names.

        Args:
            seen: frames of the training: their mean is the face at rest; an expression that moves in them goes `MARGIN`
                beyond their range at most, others to `MOST`. None: rest is zero.

        Raises:
            InputError: a body without these names, or frames of another body.
        """
        names = list(expression_names)
        E = len(names)
        wanted = {side for shape in _ARKIT.values() for one in shape for side in _both_sides(one, names)} | {*BLINK}
        missing = sorted(wanted - set(names))
        if missing:
            raise InputError(
                "expressions of the body",
                expected="ARKit's names, by which a mouth is moved",
                received=f"{E} expressions without {', '.join(missing[:3])} and {len(missing[3:])} more"
                if len(missing) > 3
                else f"{E} expressions without {', '.join(missing)}",
                remedy="the open body has them; numbered expressions (SMPL-X, FLAME) are not solved for yet",
            )
        if seen is not None and seen.expression.shape[1] > E:
            raise InputError(
                "expressions of the training", expected=f"{E} a frame", received=str(seen.expression.shape[1])
            )
        basis = np.zeros((len(ARTICULATORS), E))
        for row, articulator in enumerate(ARTICULATORS):
            for one, value in _ARKIT[articulator].items():
                for side in _both_sides(one, names):
                    basis[row, names.index(side)] = value
        has_jaw = "jaw" in joint_names
        if not has_jaw:
            basis[ARTICULATORS.index("jaw"), names.index("jawOpen")] = _JAW_ALONE
        blink = np.zeros(E)
        blink[[names.index(side) for side in BLINK]] = 1.0
        frames = np.zeros((1, E))
        jaw = np.zeros((1, 3))
        if seen is not None:
            frames = np.zeros((len(seen), E))
            frames[:, : seen.expression.shape[1]] = seen.expression
            jaw = np.asarray(seen.jaw_pose)
        neutral, low, high = frames.mean(axis=0), frames.min(axis=0), frames.max(axis=0)
        moved = high - low > _MOVES
        rest = jaw.mean(axis=0)
        seen_reach = float(jaw[:, _JAW].max() - rest[_JAW])
        return Face(
            basis=basis,
            blink=blink,
            neutral=neutral,
            lowest=np.where(moved, low - MARGIN, np.minimum(neutral, 0.0)),
            highest=np.where(moved, high + MARGIN, np.maximum(neutral, MOST)),
            jaw=rest,
            jaw_reach=(max(seen_reach, JAW_ANGLE) if has_jaw else 0.0),
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
