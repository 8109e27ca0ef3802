"""Refuse to build on a body of low confidence, with a picture of it and remedies."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, TriangleMesh
from smplxpp.raster import render_within
from smplxpp.register.locate import BodyNotFoundError, LocatedBody

LEAST_CONFIDENCE = 0.1
"""Confidence of a located body below which a build stops.

Of 14 real scans and 18 procedural people in rare poses, bodies with every limb in its place have .74 and up, but for
one in clothes 45 mm wide (.03); the other facing, lost poses and two people stay below .04, a single limb elsewhere
below .09."""
_HELP = (
    "cut away everything but the person, place landmarks (`smplxpp label`, --landmarks), ask a "
    "detector (--detector mediapipe), or give the parameters (--params). --accept-failures builds all the same"
)


def require_found(
    scan: TriangleMesh,
    body: BodyModel,
    params: BodyParams,
    *,
    confidence: float,
    findings: Sequence[str],
    picture_file: Path | None = None,
) -> None:
    """Refuse to build on a body that was found with too little confidence.

    Args:
        scan: the surface, metres, +Y up.
        body: the model.
        params: the body that was found, one row.
        confidence: of it, from 0 to 1.
        findings: sentences about evidence against one whole person.
        picture_file: file in which the caller will write the error's picture, for the message; None: it does not.

    Raises:
        BodyNotFoundError: the confidence is below `LEAST_CONFIDENCE`.
    """
    if confidence >= LEAST_CONFIDENCE:
        return
    what = "".join(f"; {finding}" for finding in findings)
    raise BodyNotFoundError(
        LocatedBody(params, confidence, findings=tuple(findings)),
        received=f"a body with a confidence of {confidence:.2g} (a build needs {LEAST_CONFIDENCE:g}){what}",
        remedy=_HELP if picture_file is None else f"look at {picture_file}; {_HELP}",
        picture=picture_within(scan, body, params),
    )


def picture_within(scan: TriangleMesh, body: BodyModel, params: BodyParams) -> np.ndarray:
    """Draw a scan, and a body within it from its front and its side.

    Args:
        scan: the surface, metres, +Y up.
        body: the model.
        params: the body, one row.
    """
    x, _, z = body.joint_rotations(params)[0, 0][:, 2]
    posed = body.mesh(body.forward(params).vertices[0])
    return render_within(posed, scan, facing=float(np.arctan2(x, z)))
