"""Every stage measured: distances between surfaces, mesh quality, weights, stretch, penetration. No torch."""

from smplxpp.metrics.comparison import (
    CompareConfig,
    DirectedDistances,
    DirectionStats,
    MeshComparison,
    ThresholdScores,
    summarize,
)
from smplxpp.metrics.completeness import Patch, Uncovered, body_regions, far_patches, uncovered_body
from smplxpp.metrics.conventions import Convention, presets
from smplxpp.metrics.distance import compare, directed_distances, point_to_surface
from smplxpp.metrics.hausdorff import DirectedHausdorff, HausdorffBounds, hausdorff
from smplxpp.metrics.intersections import (
    Interpenetration,
    PenetrationReport,
    interpenetration,
    penetration,
    self_intersections,
    signed_distance,
)
from smplxpp.metrics.mirror import mirror_ratio, mirrored_by_views
from smplxpp.metrics.pose_error import PoseError, mean_pose_error, pose_error
from smplxpp.metrics.quality import MeshQuality, doubtful_pair, faulty_faces, mesh_quality
from smplxpp.metrics.sampling import SurfaceSamples, sample_surface
from smplxpp.metrics.stretch import StretchReport, edge_stretch, flipped_faces, stretch_report
from smplxpp.metrics.weights import VariationStats, WeightReport, rig_report, total_variation, weight_report

__all__ = [
    "CompareConfig",
    "Convention",
    "DirectedDistances",
    "DirectedHausdorff",
    "DirectionStats",
    "HausdorffBounds",
    "Interpenetration",
    "MeshComparison",
    "MeshQuality",
    "Patch",
    "PenetrationReport",
    "PoseError",
    "StretchReport",
    "SurfaceSamples",
    "ThresholdScores",
    "Uncovered",
    "VariationStats",
    "WeightReport",
    "body_regions",
    "compare",
    "directed_distances",
    "doubtful_pair",
    "edge_stretch",
    "far_patches",
    "faulty_faces",
    "flipped_faces",
    "hausdorff",
    "interpenetration",
    "mean_pose_error",
    "mesh_quality",
    "mirror_ratio",
    "mirrored_by_views",
    "penetration",
    "point_to_surface",
    "pose_error",
    "presets",
    "sample_surface",
    "self_intersections",
    "signed_distance",
    "stretch_report",
    "summarize",
    "total_variation",
    "uncovered_body",
    "rig_report",
    "weight_report",
]
