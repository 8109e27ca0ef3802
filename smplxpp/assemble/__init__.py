"""Assembly of body and parts, and the repair of layers that cut into each other."""

from smplxpp.assemble.body_colors import body_colors_from_scan
from smplxpp.assemble.build import AssemblyConfig, AssemblyReport, CanonicalPart, LayerReport, assemble_template
from smplxpp.assemble.darn import DarnConfig, Darning, cut_holes, darn
from smplxpp.assemble.layers import Obstacle, Penetration, measure_penetration
from smplxpp.assemble.left_inside import LeftInside
from smplxpp.assemble.penetration import PushConfig, push_out, stand_off, turned_faces

__all__ = [
    "AssemblyConfig",
    "AssemblyReport",
    "CanonicalPart",
    "DarnConfig",
    "Darning",
    "LayerReport",
    "LeftInside",
    "Obstacle",
    "Penetration",
    "PushConfig",
    "assemble_template",
    "body_colors_from_scan",
    "cut_holes",
    "darn",
    "measure_penetration",
    "push_out",
    "stand_off",
    "turned_faces",
]
