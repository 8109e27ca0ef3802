"""Clean raw scans to manifold meshes, and labelled scans to loose parts within a face budget."""

from smplxpp.clean.bridges import BridgeConfig, cut_bridges, find_bridges, find_tears
from smplxpp.clean.parts import (
    CleanedPart,
    PartReport,
    PartsConfig,
    clean_parts,
    drop_specks,
    fill_pinholes,
    loop_lengths,
)
from smplxpp.clean.poisson import PointSurface, PoissonConfig, estimate_normals, surface_from_points
from smplxpp.clean.remesh import remesh
from smplxpp.clean.repair import CleanReport, Sanitized, sanitize
from smplxpp.clean.scan_frame import METRES_PER_UNIT, ScanFrame, check_human_scale, convert_points, find_scan_frame
from smplxpp.clean.simplify import Simplified, simplify
from smplxpp.clean.smooth import ROUGH, Smoothed, roughness, smooth_if_rough
from smplxpp.clean.solid import Solid, SolidConfig, SolidReport, solid_of_parts, wall_thickness
from smplxpp.clean.thicken import thickened

__all__ = [
    "METRES_PER_UNIT",
    "ROUGH",
    "BridgeConfig",
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
    "check_human_scale",
    "clean_parts",
    "convert_points",
    "cut_bridges",
    "drop_specks",
    "estimate_normals",
    "fill_pinholes",
    "find_bridges",
    "find_tears",
    "find_scan_frame",
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
