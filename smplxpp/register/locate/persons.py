"""Detect scans of other things than one whole person: several people, something large beside one, a cut body.

These are tests of the geometry, which need no detector. A single one may be wrong (a helmet under an arm counts as a
second head), so that they lower the confidence, explain it in words, and refuse nothing by themselves.
"""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float64
from scipy.ndimage import binary_dilation
from scipy.spatial import ConvexHull, cKDTree

from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.surface_points import SurfacePoints
from smplxpp.core.topology import component_labels, face_components
from smplxpp.raster import view_directions

_RADII = (0.080, 0.092, 0.104)
"""Metres, radii of spheres like heads with their hair, of children and of adults."""
_DIRECTIONS = 40
"""Number of directions from a head's centre in which its surface is looked for."""


@dataclass(frozen=True)
class Piece:
    """A connected piece of a surface.

    Attributes:
        size: width (x), height (y) and depth (z), metres.
        center: of its bounding box, x and z, metres.
        share: of the surface's area.
    """

    size: tuple[float, float, float]
    center: tuple[float, float]
    share: float

    def __str__(self) -> str:
        return " x ".join(f"{length:.2f}" for length in self.size) + " m"


def convex_share(mesh: TriangleMesh) -> float:
    """Return the share of a surface that lies on its convex hull, within 1 % of its height: 1 of a box or a ball.

    Scans of clothed people have 0.14 to 0.29 in any pose, because legs, arms and neck leave hollows.
    """
    vertices = mesh.vertices[mesh.referenced]
    planes = ConvexHull(vertices, qhull_options="QJ").equations
    points = SurfacePoints.sample(mesh, 1000, seed=0).points
    depth = -(points @ planes[:, :3].T + planes[:, 3]).max(axis=1)
    return float((depth < 0.01 * np.ptp(vertices[:, 1])).mean())


def share_beyond(mesh: TriangleMesh, posed: TriangleMesh) -> float:
    """Return the share of a posed body's surface that some view from the side shows outside a scan's silhouette.

    What the scan of a person lacks, the body has in the air. Clothes hide the body in every view.
    """
    cell, margin, views = 0.02, 2, 6  # metres; cells about the silhouette, 4 cm; directions in half a turn
    inside, own = SurfacePoints.sample(mesh, 30000, seed=0).points, SurfacePoints.sample(posed, 1000, seed=0).points
    disk = np.hypot(*np.mgrid[-margin : margin + 1, -margin : margin + 1]) <= margin
    beyond = np.zeros(len(own), dtype=bool)
    for angle in np.arange(views) * np.pi / views:
        axes = np.array([[np.cos(angle), 0.0], [0.0, 1.0], [np.sin(angle), 0.0]])
        # The silhouette as cells that hold points; 30,000 leave none empty on a person, and the margin none on a wall.
        places = np.floor(np.concatenate([inside, own]) @ axes / cell).astype(np.int64)
        places -= places.min(axis=0) - margin
        shown = np.zeros(places.max(axis=0) + margin + 1, dtype=bool)
        shown[tuple(places[: len(inside)].T)] = True
        beyond |= ~binary_dilation(shown, disk)[tuple(places[len(inside) :].T)]
    return float(beyond.mean())


def people_apart(mesh: TriangleMesh) -> tuple[Piece, ...]:
    """Return the pieces of a surface that are as large as a person and stand beside each other; at most one is usual.

    Garments are pieces too, which lie around the body; pieces that share most of their ground are one.
    """
    # Vertices at one place are one, so that seams of textures cut nothing.
    _, same = np.unique(np.round(mesh.vertices, 5), axis=0, return_inverse=True)
    piece = face_components(same.reshape(-1)[mesh.faces])
    area = np.bincount(piece, mesh.face_areas)
    tall, out = float(np.ptp(mesh.vertices[mesh.referenced, 1])), list[Piece]()
    for k in np.argsort(-area)[:6]:
        points = mesh.vertices[np.unique(mesh.faces[piece == k])]
        low, high = points.min(axis=0), points.max(axis=0)
        found = Piece(
            (float(high[0] - low[0]), float(high[1] - low[1]), float(high[2] - low[2])),
            (float(low[0] + high[0]) / 2, float(low[2] + high[2]) / 2),
            float(area[k] / area.sum()),
        )
        # As large as a person: half as tall as the whole scan, with a sixth of its surface.
        if found.size[1] > 0.5 * tall and found.share > 1 / 6 and all(_apart(found, other) for other in out):
            out.append(found)
    return tuple(out)


def _apart(one: Piece, other: Piece) -> bool:
    """Return whether less than 0.7 of the smaller ground of two pieces lies within the other's."""
    shared, least = 1.0, 1.0  # square metres
    for axis, k in ((0, 0), (2, 1)):
        low = max(one.center[k] - one.size[axis] / 2, other.center[k] - other.size[axis] / 2)
        high = min(one.center[k] + one.size[axis] / 2, other.center[k] + other.size[axis] / 2)
        shared *= max(0.0, high - low)
        least *= min(one.size[axis], other.size[axis])
    return shared < 0.7 * least


def heads(surface: SurfacePoints, area: float, radii: tuple[float, ...] = _RADII) -> Float64[np.ndarray, "K 3"]:
    """Find heads: spheres of their size that the surface shows from nearly all sides.

    Each point votes for the centres that spheres through it would have along its normal (a Hough transform). A centre
    with many votes is a head if points of the sphere lie in at least 85 % of the directions, and in each of them or
    in the opposite one: a limb is open at two opposite ends, a head at the neck alone.

    Args:
        surface: points of it.
        area: of the whole surface, square metres.
        radii: of the spheres, metres.
    """
    density = len(surface) / area  # points a square metre
    found: list[tuple[float, float, np.ndarray]] = []
    tree = cKDTree(surface.points)
    rays = view_directions(_DIRECTIONS)
    for radius in radii:
        spread = min(0.025, 0.32 * radius)  # metres between a sphere and a head
        centers = surface.points - radius * surface.normals
        votes = cKDTree(centers).query_ball_point(centers, spread, return_length=True)
        # A quarter of a sphere's points at least, the strongest first; each centre stands for those near it.
        order = np.argsort(-votes, kind="stable")
        order = order[votes[order] > 0.25 * 4 * np.pi * radius**2 * density]
        left = np.ones(len(centers), dtype=bool)
        for k in order:
            if not left[k]:
                continue
            close = np.linalg.norm(centers - centers[k], axis=1) < spread
            left &= ~close
            center = centers[close].mean(axis=0)
            rows = np.array(tree.query_ball_point(center, radius + spread), dtype=np.int64)
            share, closed = _shell(surface, rows, center, radius - spread, rays)
            if share >= 0.85 and closed:
                found.append((share, radius, center))
    # The best of all radii at a place.
    heads: list[np.ndarray] = []
    for _, radius, center in sorted(found, key=lambda one: -one[0]):
        if all(np.linalg.norm(center - other) > 2.0 * min(radii[0], radius) for other in heads):
            heads.append(center)
    return np.array(heads).reshape(-1, 3)


def _shell(
    surface: SurfacePoints, rows: np.ndarray, center: np.ndarray, least: float, rays: np.ndarray
) -> tuple[float, bool]:
    """Return the share of directions in which a shell about a centre has points that face outwards, and whether every
    direction or its opposite has some."""
    away = surface.points[rows] - center
    length = np.linalg.norm(away, axis=1)
    away = away / np.maximum(length, 1e-9)[:, None]
    facing = np.einsum("nx,nx->n", away, surface.normals[rows]) > 0.75
    kept = away[facing & (length > least)]
    if not len(kept):
        return 0.0, False
    # Half of the angle between neighbouring directions, about 16 degrees for 40 of them, and some more.
    near = np.cos(np.radians(20.0))
    seen, opposite = ((kept @ (sign * rays).T).max(axis=0) > near for sign in (1.0, -1.0))
    return float(seen.mean()), bool((seen | opposite).all())


def largest_piece(surface: SurfacePoints, unexplained: Bool[np.ndarray, " N"]) -> Piece | None:
    """Return the largest connected piece of the points that a body does not explain; None without any.

    Points are connected where they are at most 6 cm apart.
    """
    pieces = _pieces(surface, unexplained)
    return _piece_of(surface, pieces[0]) if pieces else None


def others_carried(
    mesh: TriangleMesh,
    surface: SurfacePoints,
    unexplained: Bool[np.ndarray, " N"],
    *,
    posed: TriangleMesh,
    least: float,
) -> tuple[tuple[Piece, float], ...]:
    """Return the pieces that a body does not explain and that have a head of their own, with its height.

    A child in arms or on a back is half as large as a person and need stand nowhere apart. A ball has no body below its
    head, and is small.

    Args:
        mesh: the surface.
        surface: points of it.
        unexplained: whether a point is no part of the body.
        posed: the body; a head whose centre lies within it is its own, about which hair stands that no body explains.
        least: share of the surface from which a piece counts.
    """
    # Heads of babies, dolls and dogs, too. Knees, fists and buns are as large: only surface without a body counts.
    radii = (0.040, 0.048, 0.057, 0.068, *_RADII)
    dense, out = None, []
    for rows in _pieces(surface, unexplained):
        if len(rows) < least * len(surface):
            break
        # Small heads need more points than a body does, and those where the piece touches the body.
        dense = dense or SurfacePoints.sample(mesh, 4 * len(surface), seed=3)
        distance, _ = cKDTree(surface.points[rows]).query(dense.points, distance_upper_bound=0.06)
        near = dense.select(np.flatnonzero(np.isfinite(distance)))
        area = float(mesh.face_areas.sum()) * len(near) / len(dense)
        found = heads(near, area, radii)
        found = found[igl.fast_winding_number(posed.vertices, posed.faces, found) < 0.5] if len(found) else found
        # Others lie on feet and joints of the same one: the highest is the head.
        if len(found):
            out.append((_piece_of(surface, rows), float(found[:, 1].max() - surface.points[:, 1].min())))
    return tuple(out)


def unlike_person(mesh: TriangleMesh, surface: SurfacePoints) -> str:
    """Return in words what a surface has that people lack: flat faces, or one axis of rotation; or "".

    Of 145 scans of people at most 0.07 of the surface is flat along three axes at right angles and 0.52 of the sides
    turned about the vertical; of furniture, a person beside some, on a floor or before a wall 0.3 and more is flat, of
    a round lamp all sides are turned.
    """
    # Those of faces, because vertices of a coarse box have a mean of three.
    points, normals = surface.points, mesh.face_normals[surface.face]
    low, tall = points[:, 1].min(), float(np.ptp(points[:, 1]))
    # Normals along the vertical, and along the two horizontal directions of most of the others, within 4 degrees.
    level = np.abs(normals[:, 1]) > np.cos(np.radians(4.0))
    upright = np.abs(normals[:, 1]) < np.sin(np.radians(4.0))
    turn = np.degrees(np.arctan2(normals[upright, 0], normals[upright, 2])) % 90.0
    common = np.bincount((turn / 3.0).astype(int) % 30, minlength=30)
    flat = float(level.mean() + (common + np.roll(common, 1) + np.roll(common, -1)).max() / len(points))
    # Normals of a surface of revolution meet its axis; those of its discs tell nothing.
    off, side = points - points.mean(axis=0), np.abs(normals[:, 1]) < 0.7
    across = np.abs(off[:, 0] * normals[:, 2] - off[:, 2] * normals[:, 0])[side]
    turned = float(
        (across < np.sin(np.radians(12.0)) * np.hypot(off[side, 0], off[side, 2])).sum() / max(side.sum(), 1)
    )
    if turned > 0.75:
        return f"{turned:.0%} of its sides are turned about one vertical axis: a lamp, a vase or a column"
    if flat > 0.25:
        # Levels are heights with a fiftieth of the surface that looks up; a chair has its back above its seat.
        height = (points[level & (normals[:, 1] > 0), 1] - low) / tall
        levels = np.flatnonzero(np.bincount((20 * height).astype(int), minlength=21) > 0.02 * len(points))
        above = float((points[:, 1] > low + tall * (levels.max(initial=0) + 2) / 20).mean())
        what = "furniture, a floor or a wall, alone or beside a person"
        if flat > 0.7 and feet_of(surface) > 2:
            what = "furniture as a chair" if above > 0.05 else "furniture as a table"
        elif flat > 0.7 and len(levels) > 3:
            what = "furniture as a shelf"
        return f"{flat:.0%} of the surface is flat along three axes: {what}"
    return ""


def feet_of(surface: SurfacePoints) -> int:
    """Return the number of places at which a surface stands: its lowest tenth, seen from above, in pieces.

    One person has two at most, unless she leans on something.
    """
    low, tall = surface.points[:, 1].min(), float(np.ptp(surface.points[:, 1]))
    ground = surface.points[surface.points[:, 1] < low + 0.1 * tall] * [1.0, 0.0, 1.0]
    pairs = cKDTree(ground).query_pairs(0.04 * tall, output_type="ndarray")
    return int((np.bincount(component_labels(pairs.astype(np.int64), len(ground))) > 0.1 * len(ground)).sum())


def _pieces(surface: SurfacePoints, unexplained: Bool[np.ndarray, " N"]) -> list[np.ndarray]:
    """Return the rows of the pieces of some points that are connected where at most 6 cm apart, the largest first."""
    rows = np.flatnonzero(unexplained)
    if not len(rows):
        return []
    pairs = cKDTree(surface.points[rows]).query_pairs(0.06, output_type="ndarray")
    piece = component_labels(pairs.astype(np.int64), len(rows))
    return [rows[piece == k] for k in np.argsort(-np.bincount(piece), kind="stable")]


def _piece_of(surface: SurfacePoints, rows: np.ndarray) -> Piece:
    """Return the size, the place and the share of some points of a surface."""
    points = surface.points[rows]
    low, high = points.min(axis=0), points.max(axis=0)
    return Piece(
        (float(high[0] - low[0]), float(high[1] - low[1]), float(high[2] - low[2])),
        (float(low[0] + high[0]) / 2, float(low[2] + high[2]) / 2),
        float(len(rows) / len(surface)),
    )
