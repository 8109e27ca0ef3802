"""What a scan does not show of the body in it: a lost head, a half, holes; and where its skin stands off the body."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from smplxpp.core import MeshLike, as_mesh, concatenate_meshes, normalize_rows
from smplxpp.core.errors import one_line
from smplxpp.core.topology import face_components
from smplxpp.metrics.distance import point_to_surface
from smplxpp.metrics.sampling import sample_surface
from smplxpp.raster import outer_visible_points, outside_views, rasterize_mesh

TRUNK_AND_LIMBS = ("head", "torso", "left arm", "right arm", "left leg", "right leg")
ENDS = ("left hand", "right hand", "left foot", "right foot")
_REGION_OF_JOINT = {
    **dict.fromkeys(("pelvis", "spine1", "spine2", "spine3", "collar"), "torso"),
    **dict.fromkeys(("neck", "head", "jaw", "eye_smplhf"), "head"),
    **dict.fromkeys(("shoulder", "elbow"), "arm"),
    **dict.fromkeys(("hip", "knee"), "leg"),
    **dict.fromkeys(("ankle", "foot"), "foot"),
}
# A point counts as seen by a view that it faces within 60 degrees and in which the body has nothing before it.
_FACING = 0.5
_BEFORE = 3e-3


@dataclass(frozen=True, eq=False)
class Uncovered:
    """How much of a body no surface shows or covers.

    Attributes:
        face: (P,) faces of the body that hold the samples.
        share: (P,) of the views that see a sample of the naked body, those in which the scan has nothing before it or
            close behind it; NaN where no view sees it.
    """

    face: Int64[np.ndarray, " P"]
    share: Float64[np.ndarray, " P"]

    __repr__ = one_line

    def mean(self, chosen: Bool[np.ndarray, " M"] | None = None) -> float:
        """The mean share over the area of all faces or of the chosen ones; 0 where no view sees any."""
        known = ~np.isnan(self.share)
        if chosen is not None:
            known &= chosen[self.face]
        return float(self.share[known].mean()) if known.any() else 0.0


@dataclass(frozen=True)
class Patch:
    """A connected patch: its area in square metres and the middle of it."""

    area: float
    center: tuple[float, float, float]


def uncovered_body(
    body: MeshLike,
    scan: MeshLike,
    *,
    samples: int = 20_000,
    seed: int = 0,
    behind: float = 0.025,
    views: int = 32,
    resolution: int = 640,
) -> Uncovered:
    """Find what of a body a scan neither shows nor covers, as views from all around see it.

    Cloth covers what lies behind it, however wide it is; where the scan has a hole, views look through it. What the
    body itself hides, armpits and the mouth, is not asked for.

    Args:
        body: in the scan's pose.
        scan: in metres.
        behind: metres that the scan may lie behind the body along a view, for fits that are off.
        views: number of parallel views spread over the sphere.
        resolution: pixels of a view's side.
    """
    body = as_mesh(body, subject="body")
    scan = as_mesh(scan, subject="scan")
    points = sample_surface(body, samples, seed=seed)
    normals = normalize_rows(points.normals)
    seen, open_ = np.zeros(samples), np.zeros(samples)
    # Two depth maps a view: of the body alone, and of the scan. A sample counts in a view that the body itself does not
    # block; it is open there if the scan is met only farther behind it, or not at all.
    for camera in outside_views(concatenate_meshes([body, scan]), views=views, resolution=resolution):
        naked, clothed = (rasterize_mesh(mesh, camera).depth for mesh in (body, scan))
        x, y, z = camera.screen_from_world(points.points).T[:3]
        column, row = np.floor(x).astype(int), np.floor(y).astype(int)
        shown = (normals @ camera.forward < -_FACING) & (z <= naked[row, column] + _BEFORE)
        seen += shown
        open_ += shown & (clothed[row, column] > z + behind)
    # Share of its views in which a sample is open; NaN for samples that no view sees.
    share = np.divide(open_, seen, out=np.full(samples, np.nan), where=seen > 0)
    return Uncovered(points.face, share)


def body_regions(joint_names: Sequence[str]) -> tuple[str, ...]:
    """The region of each joint: one of `TRUNK_AND_LIMBS` and `ENDS`; fingers, and whatever is unknown, are hands."""
    out = []
    for name in joint_names:
        side, _, rest = name.partition("_") if name.startswith(("left_", "right_")) else ("", "", name)
        region = _REGION_OF_JOINT.get(rest, "hand")
        out.append(region if region in TRUNK_AND_LIMBS else f"{side} {region}")
    return tuple(out)


def far_patches(scan: MeshLike, chosen: Bool[np.ndarray, " M"], body: MeshLike, *, far: float) -> list[Patch]:
    """Connected patches of the chosen faces that stand more than `far` metres off a body, largest first.

    Faces that look down or that nothing outside sees are left out: they close a scan from below and within.
    """
    scan = as_mesh(scan, subject="scan")
    body = as_mesh(body, subject="body")
    # A scan's face that looks down closes a skirt from below: no view shows it.
    looks_down = -0.5
    index = np.flatnonzero(chosen & (scan.face_normals[:, 1] > looks_down))
    centers = scan.face_centers[index]
    off = point_to_surface(centers, body)[0] > far
    index, centers = index[off], centers[off]
    # Of these, the faces within a millimetre of what views from outside show.
    seen = outer_visible_points(scan, centers, tolerance=1e-3)
    index, centers = index[seen], centers[seen]
    if not len(index):
        return []
    patch, area = face_components(scan.faces[index]), scan.face_areas[index]
    # Area of each connected patch, and its centroid weighted by area.
    total = np.bincount(patch, area)
    middle = np.stack([np.bincount(patch, area * centers[:, k]) for k in range(3)], axis=1) / total[:, None]
    return [Patch(float(total[k]), (middle[k, 0], middle[k, 1], middle[k, 2])) for k in np.argsort(-total)]
