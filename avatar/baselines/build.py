"""Make a baseline from its configuration and a template."""

from __future__ import annotations

from collections.abc import Sequence

from avatar.baselines.avatar_base import Baseline
from avatar.baselines.point_mlp import PointMLPAvatar, PointMLPConfig
from avatar.baselines.textured_mesh import TexturedMeshAvatar, TexturedMeshConfig
from avatar.baselines.uv_unet import UVUNetAvatar, UVUNetConfig
from avatar.gaussians.binding import BoundGaussians
from avatar.rig.rig import Rig

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
