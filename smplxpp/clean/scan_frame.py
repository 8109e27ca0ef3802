"""Convert scans between units and axes, check a person's size, and find units and upward axis that a scan lacks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64, Int, Num

from smplxpp.body import load_body
from smplxpp.body.named_poses import standing_poses
from smplxpp.core import BodyParams, InputError, TriangleMesh, matrix_from_rotvec, require_choice
from smplxpp.core.surface_points import SurfacePoints, truncated_distance

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
# Rotations from a frame with the named upward axis to one with +Y, both right-handed.
_Y_FROM_UP = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "x": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    "-y": np.diag([-1.0, -1.0, 1.0]),
    "-z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-x": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
}
_Bodies = list[tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]]
AUTO = "auto"


def convert_points(points: Num[np.ndarray, "N 3"], *, units: str = "m", up: str = "y") -> Float64[np.ndarray, "N 3"]:
    """Convert points in the stated units and axes to metres, +Y up.

    Args:
        points: points in the source's frame.
        units: "m", "cm", "mm" or "inch".
        up: the source's upward axis: "y", "z", "x", "-y", "-z" or "-x".

    Raises:
        InputError: an unknown name.
    """
    for name, value, known in (("units", units, METRES_PER_UNIT), ("up", up, _Y_FROM_UP)):
        require_choice(f"option {name}", value, tuple(known))
    return np.asarray(points, dtype=np.float64) @ _Y_FROM_UP[up].T * METRES_PER_UNIT[units]


def check_human_scale(vertices: Float[np.ndarray, "N 3"], *, subject: str = "scan") -> None:
    """Refuse a person that is not in metres or does not stand along Y.

    The largest extent shows the unit. An extent more than 1.3 times the vertical one shows swapped axes, because a
    person with spread arms is about as wide as high, and much less deep.

    Args:
        vertices: (N, 3) of the surface, without unreferenced and non-finite vertices.
        subject: name of the scan in messages.

    Raises:
        InputError: the message names the option that repairs it.
    """
    # A clothed adult or adolescent, standing or crouching, is 0.7 to 2.6 m high.
    low, high = 0.7, 2.6
    extent = np.ptp(np.asarray(vertices, dtype=np.float64), axis=0)
    size = float(extent.max())
    if not low <= size <= high:
        fitting = [u for u, scale in METRES_PER_UNIT.items() if 1.2 <= size * scale <= 2.3]
        raise InputError(
            f"{subject}: size",
            expected=f"a person {low} to {high} m high",
            received=f"a largest extent of {size:.4g}",
            remedy=f"the file is probably in {fitting[0]}: state it with --units {fitting[0]}"
            if fitting
            else "state the units with --units, and check for stray geometry far from the person",
        )
    # Swapped axes: the longest extent is not the vertical one.
    widest = int(np.argmax(extent))
    if widest != 1 and size > 1.3 * extent[1]:
        axis = "xyz"[widest]
        raise InputError(
            f"{subject}: axes",
            expected="a person standing along +Y",
            received=f"extents {extent[0]:.2f} x {extent[1]:.2f} x {extent[2]:.2f} m, longest along {axis.upper()}",
            remedy=f"state the upward axis with --up {axis} (or --up=-{axis} if it points down)",
        )


@dataclass(frozen=True)
class ScanFrame:
    """Units and upward axis of a scan's coordinates.

    Attributes:
        units: a name of `METRES_PER_UNIT`.
        up: upward axis, as `convert_points` takes it.
        unambiguous: whether every other axis fits clearly worse.
        note: the finding as a sentence for logs.
    """

    units: str
    up: str
    unambiguous: bool
    note: str


def find_scan_frame(
    vertices: Num[np.ndarray, "N 3"], faces: Int[np.ndarray, "M 3"], *, units: str = AUTO, up: str = AUTO
) -> ScanFrame:
    """Find the units and the upward axis of a person's scan.

    The mean body in standing poses is compared with the scan turned to each of six upward axes and eight headings. The
    axis of the smallest distance is up, and the height along it gives the units. A scan may lean by some 20 degrees.

    Args:
        vertices: vertices of the scan.
        faces: faces of the scan.
        units: known units; "auto" finds them.
        up: known upward axis; "auto" finds it.

    Raises:
        InputError: no surface, or no unit gives a person's height.
    """
    surface = _surface(np.asarray(vertices, dtype=np.float64), np.asarray(faces))
    bodies = _bodies()
    costs = {axis: _cost(surface, bodies, axis) for axis in (tuple(_Y_FROM_UP) if up == AUTO else (up,))}
    order = sorted(costs, key=lambda axis: costs[axis])
    best = order[0]
    height = float(np.ptp(convert_points(surface.points, up=best)[:, 1]))
    chosen = _units(height) if units == AUTO else units
    # The axis is unambiguous if the second best has a distance more than 15 % larger.
    unambiguous = len(order) == 1 or costs[order[1]] > 1.15 * costs[best]
    note = f"{'stated' if units != AUTO else 'found'} units {chosen}: {height:.4g} {chosen} from head to foot; "
    note += f"{'stated' if up != AUTO else 'found'} upward axis {best}"
    if not unambiguous:
        note += f", though {order[1]} fits nearly as well: state it with --up"
    return ScanFrame(chosen, best, unambiguous, note)


def _surface(vertices: np.ndarray, faces: np.ndarray) -> SurfacePoints:
    """Sample 400 points of the scan's surface, with normals turned outward."""
    finite = np.isfinite(vertices).all(axis=1)
    kept = faces[finite[faces].all(axis=1)] if len(faces) else faces
    safe = np.where(finite[:, None], vertices, 0.0)
    if not len(kept) or not TriangleMesh(safe, kept).face_areas.sum() > 0:
        raise InputError("scan", expected="a surface with faces that have an area", received="none")
    mesh = TriangleMesh(safe, kept)
    surface = SurfacePoints.sample(mesh, 400)
    outwards = np.einsum("nx,nx->", surface.normals, surface.points - surface.points.mean(axis=0)) >= 0
    return surface if outwards else SurfacePoints.from_arrays(surface.points, -surface.normals, surface.face)


def _units(height: float) -> str:
    # Heights of people from head (or a raised hand) to foot, metres. If several units fit, the height nearest to 1.7 m
    # decides.
    low, high, usual = 0.9, 2.5, 1.7
    fitting = [u for u, scale in METRES_PER_UNIT.items() if low <= height * scale <= high]
    if not fitting:
        raise InputError(
            "scan: size",
            expected=f"a person {low} to {high} m high in {', '.join(METRES_PER_UNIT)}",
            received=f"{height:.4g} from head to foot",
            remedy="give a scan of a whole person, without stray geometry, and state its units with --units",
        )
    return min(fitting, key=lambda u: abs(np.log(height * METRES_PER_UNIT[u] / usual)))


def _cost(surface: SurfacePoints, bodies: _Bodies, up: str) -> float:
    """Return the distance between the scan with an upward axis and the nearest body, metres of that body."""
    # Scale the scan to the body's height, place it on the floor, and turn the body to eight headings.
    headings = 8
    points, normals = (convert_points(values, up=up) for values in (surface.points, surface.normals))
    points = points - points.mean(axis=0)
    low, high = points[:, 1].min(), points[:, 1].max()
    best = np.inf
    for body_points, body_normals in bodies:
        scale = np.ptp(body_points[:, 1]) / max(high - low, 1e-12)
        placed = points * scale
        placed[:, 1] += body_points[:, 1].min() - placed[:, 1].min()
        there = SurfacePoints.from_arrays(placed, normals)
        for k in range(headings):
            turn = matrix_from_rotvec(np.array([0.0, 2.0 * np.pi * k / headings, 0.0]))
            best = min(best, truncated_distance(body_points @ turn.T, body_normals @ turn.T, there))
    return best


def _bodies() -> _Bodies:
    """Return 250 points with normals of the open body in standing poses, centred on the vertical axis."""
    # Three poses of the legs suffice: more do not change which axis is up.
    body = load_body()
    legs = ("apart", "close", "knees bent")
    vectors = [v for name, v in standing_poses(body.joint_count) if name.rpartition("legs ")[2] in legs]
    params = BodyParams.from_full_pose(
        np.stack(vectors), betas=np.zeros((1, 0)), expression=np.zeros((1, 0)), transl=np.zeros((1, 3))
    )
    out = []
    for vertices in body.forward(params).vertices:
        drawn = SurfacePoints.sample(body.mesh(vertices), 250)
        middle = drawn.points.mean(axis=0) * np.array([1.0, 0.0, 1.0])
        out.append((drawn.points - middle, drawn.normals))
    return out
