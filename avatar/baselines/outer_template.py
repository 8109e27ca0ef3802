"""A template without layers: what a surface reconstructed from images would give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from avatar.gaussians.sampling import seen_faces
from smplxpp.core import SKIN, InputError
from smplxpp.template.template import Template


def outer_template(template: Template) -> Template:
    """Return the faces that views from outside see in the T-pose, with one label for all.

    What is under clothes is gone, so that body and clothes are one outer surface, as the implicit templates of
    Animatable Gaussians (Li et al. 2024) are; unlike theirs it is not welded where clothes end, and its skinning
    weights are those of the layers. Vertices stay, those of the body drive its joints.

    Raises:
        InputError: no face can be seen.
    """
    # Faces under clothes are not seen in the T-pose from any direction; only what is visible is kept.
    seen = seen_faces(template.mesh)
    if not seen.any():
        raise InputError("template", expected="faces that a view from outside sees", received="none")
    return replace(template, faces=template.faces[seen], vertex_labels=np.full_like(template.vertex_labels, SKIN.id))
