"""Body models of the SMPL family: the open body, files of the user, and files of parameters."""

from smplxpp.body.importers import (
    LayoutName,
    UpAxis,
    Whose,
    detect_layout,
    family_of_params,
    is_skeleton,
    load_motion,
    load_params,
    params_from_content,
)
from smplxpp.body.loader import load_body
from smplxpp.body.model import BodyModel, PosedBody
from smplxpp.body.named_poses import stress_poses
from smplxpp.body.smpl_joints import smpl_joints, with_smpl_joints

__all__ = [
    "BodyModel",
    "LayoutName",
    "UpAxis",
    "Whose",
    "PosedBody",
    "detect_layout",
    "family_of_params",
    "is_skeleton",
    "load_body",
    "load_motion",
    "load_params",
    "params_from_content",
    "smpl_joints",
    "stress_poses",
    "with_smpl_joints",
]
