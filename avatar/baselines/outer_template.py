"""Reduce a template to its outer surface, which a reconstruction from images would give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatar.gaussians.sampling import seen_faces
from smplxpp.core import SKIN, InputError
from smplxpp.template.template import Template


def outer_template(template: Template) -> Template:
    """Return the template with only the faces seen from outside in the T-pose, all with the label of skin.

    Faces under clothes are dropped. Body and clothes become one outer surface, like the implicit templates of
    Animatable Gaussians (Li et al. 2024), but it is not welded where clothes end, and keeps the layers' skinning
    weights. All vertices stay, because those of the body drive its joints.

    Raises:
        InputError: no face can be seen.
    """
    # Faces under clothes are not seen in the T-pose from any direction; only what is visible is kept.
    seen = seen_faces(template.mesh)
    if not seen.any():
        raise InputError("template", expected="faces that a view from outside sees", received="none")
    labels = np.full_like(template.vertex_labels, SKIN.id)
    return replace(template, faces=template.faces[seen], vertex_labels=labels, texture=None)
