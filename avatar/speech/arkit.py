"""ARKit's 52 expressions by name."""

from __future__ import annotations

_SIDED = (
    *("eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide", "browDown"),
    *("browOuterUp", "cheekSquint", "noseSneer", "mouthSmile", "mouthFrown", "mouthDimple", "mouthStretch"),
    *("mouthPress", "mouthLowerDown", "mouthUpperUp"),
)
_ALONE = (
    *("jawForward", "jawLeft", "jawRight", "jawOpen", "mouthClose", "mouthFunnel", "mouthPucker", "mouthLeft"),
    *("mouthRight", "mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper", "browInnerUp"),
    *("cheekPuff", "tongueOut"),
)
ARKIT: tuple[str, ...] = tuple(sorted([*_ALONE, *(f"{name}{side}" for name in _SIDED for side in ("Left", "Right"))]))
"""In alphabetical order."""
BLINK = ("eyeBlinkLeft", "eyeBlinkRight")
