"""Units and upward axis of a scan that does not say them: what makes a person of it who stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int, Num

from smplxpp.body import load_body
from smplxpp.body.named_poses import standing_poses
from smplxpp.clean.units import METRES_PER_UNIT, convert_points
from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.core.surface_points import SurfacePoints, truncated_distance

_Bodies = list[tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]]
AUTO = "auto"
_UPWARDS = ("y", "z", "x", "-y", "-z", "-x")
# Heights of people from head (or a raised hand) to foot, metres, and the most ordinary of them.
_HEIGHTS, _ORDINARY = (0.9, 2.5), 1.7
_SCAN_POINTS, _BODY_POINTS, _DIRECTIONS = 400, 250, 8
# Legs of the poses that are tried: more tell nothing of what is up.
_LEGS = ("apart", "close", "knees bent")
# A second axis that is so much worse (share of the distance) leaves no doubt.
_CLEAR = 1.15


@dataclass(frozen=True)
class ScanFrame:
    """What a scan's numbers mean.

    Attributes:
        units: a name of `METRES_PER_UNIT`. up: the scan's upward axis, as `convert_points` takes it.
        sure: whether no other axis comes near. said: the finding in words.
    """

    units: str
    up: str
    sure: bool
    said: str


def find_scan_frame(
    vertices: Num[np.ndarray, "N 3"], faces: Int[np.ndarray, "M 3"], *, units: str = AUTO, up: str = AUTO
) -> ScanFrame:
    """Find the units and the upward axis of a person's scan.

    The mean body in poses of scanning is compared with the scan standing on each of its six sides, from eight
    directions; the nearest tells what is up, its height the units. Upright within some 20 degrees is near enough.

    Args:
        units, up: what is known already; "auto" is found.

    Raises:
        InputError: no surface, or no unit makes it as high as a person.
    """
    surface = _surface(np.asarray(vertices, dtype=np.float64), np.asarray(faces))
    bodies = _bodies()
    costs = {axis: _cost(surface, bodies, axis) for axis in (_UPWARDS if up == AUTO else (up,))}
    order = sorted(costs, key=lambda axis: costs[axis])
    best = order[0]
    height = float(np.ptp(convert_points(surface.points, up=best)[:, 1]))
    chosen = _units(height) if units == AUTO else units
    sure = len(order) == 1 or costs[order[1]] > _CLEAR * costs[best]
    said = f"{'stated' if units != AUTO else 'found'} units {chosen}: {height:.4g} {chosen} from head to foot; "
    said += f"{'stated' if up != AUTO else 'found'} upward axis {best}"
    if not sure:
        said += f", though {order[1]} fits nearly as well: state it with --up"
    return ScanFrame(chosen, best, sure, said)


def _surface(vertices: np.ndarray, faces: np.ndarray) -> SurfacePoints:
    """Points of the scan as it stands, its largest extent 1."""
    finite = np.isfinite(vertices).all(axis=1)
    kept = faces[finite[faces].all(axis=1)] if len(faces) else faces
    safe = np.where(finite[:, None], vertices, 0.0)
    if not len(kept) or not TriangleMesh(safe, kept).face_areas.sum() > 0:
        raise InputError("scan", expected="a surface with faces that have an area", received="none")
    mesh = TriangleMesh(safe, kept)
    surface = SurfacePoints.sample(mesh, _SCAN_POINTS)
    outwards = np.einsum("nx,nx->", surface.normals, surface.points - surface.points.mean(axis=0)) >= 0
    return surface if outwards else SurfacePoints.from_arrays(surface.points, -surface.normals, surface.face)


def _units(height: float) -> str:
    fitting = [u for u, scale in METRES_PER_UNIT.items() if _HEIGHTS[0] <= height * scale <= _HEIGHTS[1]]
    if not fitting:
        raise InputError(
            "scan: size",
            expected=f"a person {_HEIGHTS[0]} to {_HEIGHTS[1]} m high in {', '.join(METRES_PER_UNIT)}",
            received=f"{height:.4g} from head to foot",
            remedy="give a scan of a whole person, without stray geometry, and state its units with --units",
        )
    return min(fitting, key=lambda u: abs(np.log(height * METRES_PER_UNIT[u] / _ORDINARY)))


def _cost(surface: SurfacePoints, bodies: _Bodies, up: str) -> float:
    """How far the nearest body is from the scan standing on one of its sides, metres of that body."""
    points, normals = (convert_points(values, up=up) for values in (surface.points, surface.normals))
    points = points - points.mean(axis=0)
    low, high = points[:, 1].min(), points[:, 1].max()
    best = np.inf
    for body_points, body_normals in bodies:
        scale = np.ptp(body_points[:, 1]) / max(high - low, 1e-12)
        placed = points * scale
        placed[:, 1] += body_points[:, 1].min() - placed[:, 1].min()
        there = SurfacePoints.from_arrays(placed, normals)
        for k in range(_DIRECTIONS):
            turn = matrix_from_rotvec(np.array([0.0, 2.0 * np.pi * k / _DIRECTIONS, 0.0]))
            best = min(best, truncated_distance(body_points @ turn.T, body_normals @ turn.T, there))
    return best


def _bodies() -> _Bodies:
    """Points and normals of the open body in every pose that is tried, its middle on the vertical axis."""
    body = load_body()
    vectors = [v for name, v in standing_poses(body.joint_count) if name.rpartition("legs ")[2] in _LEGS]
    params = BodyParams.from_full_pose(
        np.stack(vectors), betas=np.zeros((1, 0)), expression=np.zeros((1, 0)), transl=np.zeros((1, 3))
    )
    out = []
    for vertices in body.forward(params).vertices:
        drawn = SurfacePoints.sample(body.mesh(vertices), _BODY_POINTS)
        middle = drawn.points.mean(axis=0) * np.array([1.0, 0.0, 1.0])
        out.append((drawn.points - middle, drawn.normals))
    return out
