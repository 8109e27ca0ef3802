"""What a page needs to move the mouth by live sound: the network's weights, and how the avatar's own face speaks."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from smplxpp.core.files.paths import read_bytes
from smplxpp.core.files.tensor_bytes import pack_tensors, unpack_tensors

if TYPE_CHECKING:
    from avatar.speech import Face


def lips_of(face: Face) -> bytes:
    """Return tensors in the layout of safetensors: those of `avatar.speech.lips.WEIGHTS`, and `face.NAME`.

    Of the face: `basis` (6, E) of the articulators, `neutral`, `lowest`, `highest` (E), `jaw` (3) at rest, and
    `jaw_reach` (2), the radians that an open vowel hangs it and that it hangs at most.
    """
    from avatar.speech.face import JAW_ANGLE
    from avatar.speech.lips import WEIGHTS

    tensors, about = unpack_tensors(read_bytes(WEIGHTS, subject="lip network"), subject="lip network")
    own = {name: getattr(face, name) for name in ("basis", "neutral", "lowest", "highest", "jaw")}
    own["jaw_reach"] = np.array([JAW_ANGLE, face.jaw_reach])
    return pack_tensors({**tensors, **{f"face.{name}": value for name, value in own.items()}}, about)
