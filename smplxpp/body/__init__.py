"""Body models of the SMPL family: the open body, files of the user, skinning, and files of parameters."""

from smplxpp.body.importers import detect_layout, load_params, params_from_content
from smplxpp.body.loader import load_body
from smplxpp.body.model import BodyModel, PosedBody
from smplxpp.body.skinning import blend_transforms, forward_kinematics, skin

__all__ = [
    "BodyModel",
    "PosedBody",
    "blend_transforms",
    "detect_layout",
    "forward_kinematics",
    "load_body",
    "load_params",
    "params_from_content",
    "skin",
]
