"""Assemble body and parts to a template, fill holes, and push layers that intersect apart."""

from smplxpp.assemble.body_inside import body_colors_from_scan
from smplxpp.assemble.build import AssemblyConfig, AssemblyReport, CanonicalPart, LayerReport, assemble_template
from smplxpp.assemble.fill_holes import FilledHoles, FillHolesConfig, cut_holes, cut_slits, fill_holes, part_legs
from smplxpp.assemble.layers import Obstacle, Penetration, RemainingPenetration, measure_penetration
from smplxpp.assemble.push_out import PushConfig, flipped_faces, push_out, stand_off

__all__ = [
    "AssemblyConfig",
    "AssemblyReport",
    "CanonicalPart",
    "FillHolesConfig",
    "FilledHoles",
    "LayerReport",
    "Obstacle",
    "Penetration",
    "PushConfig",
    "RemainingPenetration",
    "assemble_template",
    "body_colors_from_scan",
    "cut_holes",
    "cut_slits",
    "fill_holes",
    "part_legs",
    "flipped_faces",
    "measure_penetration",
    "push_out",
    "stand_off",
]
