"""Pose a body's face: articulators, ARKit's blendshapes or FLAME's expressions to its own expressions and jaw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from avatar.speech.coarticulation import ARTICULATORS
from avatar.speech.curves import BLINK
from smplxpp.body.blendshapes import ARKIT, both_sides, transfer_blendshapes
from smplxpp.body.model import BodyModel
from smplxpp.core import BodyParams, InputError
from smplxpp.core.errors import one_line

JAW_ANGLE = 0.15
"""Rotation of the jaw for an open vowel, radians, and its limit where the training did not open it further."""
# Limits of expressions. They keep the face near what the student was trained on, at the price of weaker expressions.
MARGIN = 0.15
"""Extension of an expression's observed range, if the training varied it; ARKit's blendshapes run from 0 to 1."""
MARGIN_NUMBERED = 0.5
"""The same for a numbered expression, in standard deviations."""
MAX_UNOBSERVED = 0.8
"""Upper limit of an expression that the training did not vary."""
MAX_UNOBSERVED_NUMBERED = 2.0
"""The same for a numbered expression, on both sides, in standard deviations."""
_JAW = 0  # the axis x, about which the jaw opens

# Articulator -> ARKit's blendshapes at its value 1. Tuned by eye.
_ARKIT_OF_ARTICULATOR: dict[str, dict[str, float]] = {
    "jaw": {"jawOpen": 0.25, "mouthLowerDown": 0.15},
    "press": {"mouthPress": 0.5, "mouthRollLower": 0.3, "mouthRollUpper": 0.25},
    "tuck": {"mouthRollLower": 0.7, "mouthUpperUp": 0.2},
    "round": {"mouthPucker": 0.7, "mouthFunnel": 0.35},
    "spread": {"mouthSmile": 0.3, "mouthStretch": 0.35},
    "bare": {"mouthLowerDown": 0.3, "mouthUpperUp": 0.2},
}


def _named_basis(names: list[str]) -> Float64[np.ndarray, "52 E"]:
    """Return the matrix that selects a body's expressions for ARKit's blendshapes, 0 for those that it lacks."""
    wanted = {side for shape in _ARKIT_OF_ARTICULATOR.values() for one in shape for side in both_sides(one)} | {*BLINK}
    missing = sorted(wanted - set(names))
    if missing:
        more = f" and {len(missing[3:])} more" if len(missing) > 3 else ""
        raise InputError(
            "expressions of the body",
            expected="ARKit's names of the mouth's blendshapes, or numbers",
            received=f"{len(names)} expressions without {', '.join(missing[:3])}{more}",
        )
    return np.array([[float(name == own) for own in names] for name in ARKIT])


@dataclass(frozen=True, eq=False)
class Face:
    """The face of a body: bases and limits of its expressions, and its jaw.

    Attributes:
        arkit: expressions of each of `ARKIT` at its value 1.
        basis: expressions of each articulator at its value 1.
        blink: expressions of closed eyes.
        neutral: expressions at rest.
        lowest: lower limits of the expressions.
        highest: upper limits of the expressions.
        jaw: rotation vector of the jaw at rest.
        jaw_reach: largest opening of the jaw from there, radians.
        numbered: whether the expressions are numbered rather than named.
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

    __repr__ = one_line

    @staticmethod
    def of(
        expression_names: Sequence[str],
        joint_names: Sequence[str],
        seen: BodyParams | None = None,
        *,
        body: BodyModel | None = None,
    ) -> Face:
        """Make the face of a body whose expressions are named after ARKit's blendshapes or numbered.

        Args:
            expression_names: of the body.
            joint_names: of the body; without a "jaw" the mouth opens by its expression alone.
            seen: frames of the training. Their mean is the face at rest. An expression that varies in them is limited
                to their range and `MARGIN`, another one to `MAX_UNOBSERVED`. None: rest is zero.
            body: the body, to transfer ARKit's blendshapes to numbered expressions; None: names are needed.

        Raises:
            InputError: expressions that are neither named nor numbered, or frames of another body.
        """
        names = list(expression_names)
        E = len(names)
        if seen is not None and seen.expression.shape[1] > E:
            raise InputError(
                "expressions of the training", expected=f"{E} a frame", received=str(seen.expression.shape[1])
            )
        numbered = body is not None and E > 0 and not set(ARKIT) & set(names)
        arkit = transfer_blendshapes(body).coefficients if numbered and body is not None else _named_basis(names)
        # Articulators as combinations of ARKit's blendshapes.
        weights = np.zeros((len(ARTICULATORS), len(ARKIT)))
        for row, articulator in enumerate(ARTICULATORS):
            for one, value in _ARKIT_OF_ARTICULATOR[articulator].items():
                for side in both_sides(one):
                    weights[row, ARKIT.index(side)] = value
        has_jaw = "jaw" in joint_names
        if not has_jaw:
            weights[ARTICULATORS.index("jaw"), ARKIT.index("jawOpen")] = 0.6
        # Rest and observed ranges.
        frames = np.zeros((1, E))
        jaw = np.zeros((1, 3))
        if seen is not None:
            frames = np.zeros((len(seen), E))
            frames[:, : seen.expression.shape[1]] = seen.expression
            jaw = np.asarray(seen.jaw_pose)
        neutral, low, high = frames.mean(axis=0), frames.min(axis=0), frames.max(axis=0)
        # An expression that varies by less is noise of the tracking, and its range says nothing of what the student
        # can show.
        varied = high - low > 0.05
        margin, least, most = (MARGIN, 0.0, MAX_UNOBSERVED)
        if numbered:
            margin, least, most = (MARGIN_NUMBERED, -MAX_UNOBSERVED_NUMBERED, MAX_UNOBSERVED_NUMBERED)
        rest = jaw.mean(axis=0)
        seen_reach = float(jaw[:, _JAW].max() - rest[_JAW])
        return Face(
            arkit=arkit,
            basis=weights @ arkit,
            blink=arkit[[ARKIT.index(side) for side in BLINK]].sum(axis=0),
            neutral=neutral,
            lowest=np.where(varied, low - margin, np.minimum(neutral, least)),
            highest=np.where(varied, high + margin, np.maximum(neutral, most)),
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
        """Return expressions and rotation vectors of the jaw for articulator curves.

        Args:
            curves: `ARTICULATORS`, 0 to 1.
            closed_eyes: 0 to 1.
            strength: factor of the mouth's motion; closures of the lips are not scaled.
        """
        # Expressions are linear in the articulators: rest + articulators times basis + eyelids, then clipped to the
        # limits.
        scale = np.where(np.isin(ARTICULATORS, ("press", "tuck")), 1.0, strength)
        asked = self.neutral + (curves * scale) @ self.basis + closed_eyes[:, None] * self.blink
        jaw = np.tile(self.jaw, (len(curves), 1))
        opening = curves[:, ARTICULATORS.index("jaw")] * strength
        jaw[:, _JAW] += np.minimum(JAW_ANGLE * opening, self.jaw_reach)
        # A jaw that rests open closes for bilabials.
        pressed = curves[:, ARTICULATORS.index("press")]
        jaw[:, _JAW] -= pressed * max(float(self.jaw[_JAW]), 0.0)
        return np.clip(asked, self.lowest, self.highest), jaw

    def pose_arkit(
        self, values: Float64[np.ndarray, "T 52"], *, strength: float = 1.0
    ) -> tuple[Float64[np.ndarray, "T E"], Float64[np.ndarray, "T 3"]]:
        """Return expressions and rotation vectors of the jaw for curves of `ARKIT`.

        `jawOpen` rotates the jaw joint, at 0.5 as far as an open vowel, and `mouthClose` closes it. The expressions of
        the same names are scaled down as for speech, because the joint already moves the mouth.
        """
        # A copy: the columns of the jaw are changed below.
        values = strength * values
        jaw = np.tile(self.jaw, (len(values), 1))
        if self.jaw_reach:
            opening = values[:, ARKIT.index("jawOpen")]
            shut = np.minimum(values[:, ARKIT.index("mouthClose")], opening)
            jaw[:, _JAW] += np.clip(JAW_ANGLE * (opening - shut) / 0.5, 0.0, self.jaw_reach)
            values[:, ARKIT.index("jawOpen")] *= _ARKIT_OF_ARTICULATOR["jaw"]["jawOpen"]
            values[:, ARKIT.index("mouthClose")] = shut * _ARKIT_OF_ARTICULATOR["jaw"]["jawOpen"]
        return np.clip(self.neutral + values @ self.arkit, self.lowest, self.highest), jaw

    def pose_flame(
        self, values: Float64[np.ndarray, "T N"], rotations: Float64[np.ndarray, "T 3"], *, strength: float = 1.0
    ) -> tuple[Float64[np.ndarray, "T E"], Float64[np.ndarray, "T 3"]]:
        """Return expressions and rotation vectors of the jaw for FLAME's, whose first expressions the body shares.

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
        # Body and file may have different numbers of FLAME's expressions; the shared first ones are used.
        width = min(asked.shape[1], values.shape[1])
        asked[:, :width] = strength * values[:, :width]
        jaw = self.jaw + strength * rotations
        jaw[:, _JAW] = np.minimum(jaw[:, _JAW], self.jaw[_JAW] + max(self.jaw_reach, 0.0))
        return np.clip(self.neutral + asked, self.lowest, self.highest), jaw
