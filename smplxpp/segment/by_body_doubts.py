"""What `label_by_body` cannot be sure of, in words for the user."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float64, Int64

from smplxpp.core.labels import LABELS
from smplxpp.core.mesh import TriangleMesh
from smplxpp.segment.by_body_colors import SkinModel
from smplxpp.segment.by_body_outfit import Outfit

_CLOSE_CALL = 6.0  # nats
_WORDS = {
    "shoe_top": "where shoes or socks end",
    "lower_start": "where the lower garment's hem is",
    "lower_end": "where the lower garment's waist is",
    "upper_start": "where the upper garment's hem is",
    "cuff": "where the sleeves end",
}
_LOW, _MUCH = 0.6, 0.15
AWAY = 0.05
"""Metres between the body and the scan's bare skin from which the body is not the scan's."""


def find_doubts(
    mesh: TriangleMesh,
    labels: Int64[np.ndarray, " M"],
    confidence: Float64[np.ndarray, " M"],
    outfit: Outfit,
    skin: SkinModel | None,
    *,
    misfit: float,
) -> tuple[str, ...]:
    """Sentences; none where all is clear."""
    out = []
    if skin is None:
        out.append("the scan has no colours: labels rest on the distance to the body alone")
    elif not skin.found:
        out.append("neither the face nor the hands show skin: skin is told by what people's skin looks like at large")
    elif skin.hands is False:
        out.append("hands and face differ in colour (gloves, a covered face): skin has the colour of the face")
    if misfit > AWAY:
        out.append(f"the body lies {1e3 * misfit:.0f} mm from the scan's face and hands: no label can be trusted")
    elif misfit > 0.012:
        out.append(f"the body misses face and hands by {1e3 * misfit:.0f} mm: clothes are told by colour alone")
    close = [_WORDS[name] for name, margin in outfit.margins.items() if margin < _CLOSE_CALL]
    out.extend(f"it is a close call {words}" for words in dict.fromkeys(close))
    if outfit.one_piece:
        out.append("no seam at the waist: taken as one garment (dress, jumpsuit), labelled upper")
    area = mesh.face_areas
    for label in LABELS:
        own = labels == label.id
        total = area[own].sum()
        if total > 0 and (low := area[own & (confidence < _LOW)].sum()) > _MUCH * total:
            out.append(f"{low / total:.0%} of what is labelled {label.name} is not sure")
    return tuple(out)
