"""Body models of the SMPL family: the open body, files of the user, and files of parameters."""

from smplxpp.body.importers import LayoutName, UpAxis, detect_layout, load_params, params_from_content
from smplxpp.body.loader import load_body
from smplxpp.body.model import BodyModel, PosedBody
from smplxpp.body.named_poses import stress_poses

__all__ = [
    "BodyModel",
    "LayoutName",
    "UpAxis",
    "PosedBody",
    "detect_layout",
    "load_body",
    "load_params",
    "params_from_content",
    "stress_poses",
]
