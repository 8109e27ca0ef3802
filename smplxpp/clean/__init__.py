"""Cleaning: raw scans to manifold meshes, labelled scans to loose parts within a face budget."""

from smplxpp.clean.components import drop_specks, fill_pinholes, loop_lengths
from smplxpp.clean.parts import CleanedPart, PartReport, PartsConfig, clean_parts
from smplxpp.clean.point_normals import estimate_normals
from smplxpp.clean.poisson import PointSurface, PoissonConfig, surface_from_points
from smplxpp.clean.remesh import remesh
from smplxpp.clean.repair import CleanReport, Sanitized, sanitize
from smplxpp.clean.scan_frame import ScanFrame, find_scan_frame
from smplxpp.clean.simplify import Simplified, simplify
from smplxpp.clean.smooth import ROUGH, Smoothed, roughness, smooth_if_rough
from smplxpp.clean.solid import Solid, SolidConfig, SolidReport, solid_of_parts, thickened, wall_thickness
from smplxpp.clean.units import METRES_PER_UNIT, check_human_scale, convert_points
from smplxpp.clean.webs import WebConfig, cut_webs, find_webs

__all__ = [
    "METRES_PER_UNIT",
    "ROUGH",
    "CleanReport",
    "CleanedPart",
    "PartReport",
    "PartsConfig",
    "PointSurface",
    "PoissonConfig",
    "Sanitized",
    "ScanFrame",
    "Simplified",
    "Smoothed",
    "Solid",
    "SolidConfig",
    "SolidReport",
    "WebConfig",
    "check_human_scale",
    "clean_parts",
    "convert_points",
    "cut_webs",
    "drop_specks",
    "estimate_normals",
    "fill_pinholes",
    "find_scan_frame",
    "find_webs",
    "loop_lengths",
    "remesh",
    "roughness",
    "sanitize",
    "simplify",
    "smooth_if_rough",
    "solid_of_parts",
    "surface_from_points",
    "thickened",
    "wall_thickness",
]
