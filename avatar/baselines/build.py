"""Make a baseline from its configuration and a template, and reduce a template to its outer surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from avatar.baselines.avatar_base import Baseline
from avatar.baselines.point_mlp import PointMLPAvatar, PointMLPConfig
from avatar.baselines.textured_mesh import TexturedMeshAvatar, TexturedMeshConfig
from avatar.baselines.uv_unet import UVUNetAvatar, UVUNetConfig
from avatar.gaussians.binding import BoundGaussians
from avatar.gaussians.sampling import seen_faces
from avatar.rig.rig import Rig
from smplxpp.core import SKIN, InputError
from smplxpp.template.template import Template

BaselineConfig = PointMLPConfig | UVUNetConfig | TexturedMeshConfig
_KINDS = {PointMLPConfig: PointMLPAvatar, UVUNetConfig: UVUNetAvatar, TexturedMeshConfig: TexturedMeshAvatar}


def make_baseline(config: BaselineConfig, rig: Rig, gaussians: BoundGaussians, frames: Sequence[int]) -> Baseline:
    """Make an untrained baseline of the configuration's kind.

    Args:
        config: selects the kind and its sizes.
        rig: of any template.
        gaussians: fitted on the template.
        frames: frames with a code.
    """
    return _KINDS[type(config)](config, rig, gaussians, frames)


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
