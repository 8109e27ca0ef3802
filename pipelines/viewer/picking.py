"""What of a scan lies under the pointer: rays, and the line that a drag of it leaves on the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from smplxpp.segment.corrected_faces import ScanSurface

# Points of a line that jump by more than this share of the brush, or this many metres, are on another piece of surface.
_JUMP_RADII, _LEAST_JUMP = 2.0, 0.03
# Rays a radius of the brush, between two places of the pointer.
_RAYS, _MOST_RAYS = 2.0, 64
# Points of a line nearer to each other than this share of the brush say nothing more; longer lines are cut.
_NEAR_RADII, _MOST_POINTS = 0.2, 2000


@dataclass(frozen=True, eq=False)
class Hit:
    """Where a ray meets a scan.

    Attributes:
        face: number. point: metres. normal: the face's, turned to where the ray comes from.
        distance: from the ray's origin, metres.
    """

    face: int
    point: Float64[np.ndarray, " 3"]
    normal: Float64[np.ndarray, " 3"]
    distance: float


def hits(surface: ScanSurface, origin: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"]) -> list[Hit]:
    """All places where a ray meets the scan, nearest first."""
    start = np.ascontiguousarray(origin, dtype=np.float64)
    along = np.asarray(direction, dtype=np.float64)
    along = np.ascontiguousarray(along / np.linalg.norm(along))
    mesh = surface.mesh
    (met,) = surface.tree.intersect_ray(mesh.vertices, mesh.faces, start[None], along[None])
    found = sorted((float(one[1]), int(one[0])) for one in met if one[1] > 0)
    out = []
    for distance, face in found:
        normal = mesh.face_normals[face]
        out.append(Hit(face, start + distance * along, -normal if normal @ along > 0 else normal, distance))
    return out


def first_hit(surface: ScanSurface, origin: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"]) -> Hit | None:
    """The nearest of them; None where the ray misses the scan."""
    found = hits(surface, origin, direction)
    return found[0] if found else None


def middle_of_limb(
    surface: ScanSurface, origin: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"]
) -> Float64[np.ndarray, " 3"] | None:
    """The middle between where a ray enters a limb and where it leaves it: about where its joint is.

    It leaves at the first face behind the first one that faces away from the ray's origin. None where it misses, and
    where it finds no way out, as of a scan that is open at the back.
    """
    found = hits(surface, origin, direction)
    along = np.asarray(direction, dtype=np.float64)
    for one in found[1:]:
        if surface.mesh.face_normals[one.face] @ along > 0:
            return 0.5 * (found[0].point + one.point)
    return None


def line_under(
    surface: ScanSurface,
    origin: Float[np.ndarray, " 3"],
    places: Float[np.ndarray, "n 3"],
    radius: float,
) -> list[tuple[Float64[np.ndarray, "m 3"], Float64[np.ndarray, "m 3"]]]:
    """Points and normals of the scan under a pointer that was dragged.

    Args:
        origin: of the camera. places: that the pointer went through, on any plane before it.
        radius: of the brush, metres.

    Returns:
        A line for each piece of surface: where the pointer leaves the scan, or jumps to a limb behind, another begins.
    """
    lines: list[list[Hit]] = []
    last: Hit | None = None
    for place in _between(np.asarray(places, dtype=np.float64), radius):
        hit = first_hit(surface, origin, place - origin)
        if hit is None:
            last = None
            continue
        step = np.inf if last is None else float(np.linalg.norm(hit.point - last.point))
        if step > max(_JUMP_RADII * radius, _LEAST_JUMP):
            lines.append([hit])
        elif len(lines[-1]) >= _MOST_POINTS:
            lines.append([lines[-1][-1], hit])
        elif np.linalg.norm(hit.point - lines[-1][-1].point) > _NEAR_RADII * radius:
            lines[-1].append(hit)
        last = hit
    return [(np.stack([hit.point for hit in line]), np.stack([hit.normal for hit in line])) for line in lines]


def _between(places: Float64[np.ndarray, "n 3"], radius: float) -> Float64[np.ndarray, "m 3"]:
    """Places as close to each other as the brush needs."""
    if len(places) == 1:
        return places
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    counts = np.clip(np.ceil(_RAYS * steps / radius), 1, _MOST_RAYS).astype(int)
    parts = [
        places[k] + np.arange(count)[:, None] / count * (places[k + 1] - places[k]) for k, count in enumerate(counts)
    ]
    return np.concatenate([*parts, places[-1:]])
