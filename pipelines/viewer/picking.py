"""Find the surface under the pointer: intersections of rays, and the line that a drag draws on the surface."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from smplxpp.segment.corrected_faces import ScanSurface


@dataclass(frozen=True, eq=False)
class Hit:
    """Intersection of a ray with a scan.

    Attributes:
        face: number of the face.
        point: intersection, metres.
        normal: normal of the face, on the side of the ray's origin.
        distance: distance from the ray's origin, metres.
    """

    face: int
    point: Float64[np.ndarray, " 3"]
    normal: Float64[np.ndarray, " 3"]
    distance: float


def hits(surface: ScanSurface, origin: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"]) -> list[Hit]:
    """Return all intersections of a ray with the scan, nearest first."""
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
    """Return the nearest intersection, or None if the ray misses the scan."""
    found = hits(surface, origin, direction)
    return found[0] if found else None


def middle_of_limb(
    surface: ScanSurface, origin: Float[np.ndarray, " 3"], direction: Float[np.ndarray, " 3"]
) -> Float64[np.ndarray, " 3"] | None:
    """Return the middle between a ray's entry into a limb and its exit, which is about the joint's centre.

    The exit is the first face behind the entry that faces away from the ray's origin. None if the ray misses or does
    not exit, as in a scan that is open at the back.
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
    """Return points and normals of the scan under a dragged pointer.

    Args:
        surface: the scan.
        origin: centre of the camera.
        places: positions of the pointer, on any plane before the camera.
        radius: radius of the brush, metres.

    Returns:
        A line for each piece of surface: a new one begins where the pointer leaves the scan or jumps to a limb behind.
    """
    # A jump of more than two radii (at least 3 cm) is another piece of surface. Points within a fifth of the radius add
    # nothing and are dropped; lines of 2,000 points are continued in a new one.
    lines: list[list[Hit]] = []
    last: Hit | None = None
    for place in _between(np.asarray(places, dtype=np.float64), radius):
        hit = first_hit(surface, origin, place - origin)
        if hit is None:
            last = None
            continue
        step = np.inf if last is None else float(np.linalg.norm(hit.point - last.point))
        if step > max(2.0 * radius, 0.03):
            lines.append([hit])
        elif len(lines[-1]) >= 2000:
            lines.append([lines[-1][-1], hit])
        elif np.linalg.norm(hit.point - lines[-1][-1].point) > 0.2 * radius:
            lines[-1].append(hit)
        last = hit
    return [(np.stack([hit.point for hit in line]), np.stack([hit.normal for hit in line])) for line in lines]


def _between(places: Float64[np.ndarray, "n 3"], radius: float) -> Float64[np.ndarray, "m 3"]:
    """Return places at most half a radius apart, at most 64 between two positions of the pointer."""
    if len(places) == 1:
        return places
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    counts = np.clip(np.ceil(2.0 * steps / radius), 1, 64).astype(int)
    parts = [
        places[k] + np.arange(count)[:, None] / count * (places[k + 1] - places[k]) for k, count in enumerate(counts)
    ]
    return np.concatenate([*parts, places[-1:]])
