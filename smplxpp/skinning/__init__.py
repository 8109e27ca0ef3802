"""Compute forward kinematics, linear blend skinning, and the inverse of skinning from a pose to the T-pose."""

from smplxpp.skinning.inverse import UnposeConfig, Unposed, UnposeReport, invertible_weights, pose, unpose
from smplxpp.skinning.linear_blend import blend_transforms, forward_kinematics, skin

__all__ = [
    "UnposeConfig",
    "UnposeReport",
    "Unposed",
    "blend_transforms",
    "forward_kinematics",
    "invertible_weights",
    "pose",
    "skin",
    "unpose",
]
