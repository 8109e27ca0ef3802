"""Convert scans between units and axes, check a person's size, and find units and upward axis that a scan lacks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float64
from numpy.typing import ArrayLike

from smplxpp.body import load_body
from smplxpp.body.named_poses import low_poses, standing_poses
from smplxpp.core import BodyParams, InputError, TriangleMesh, matrix_from_rotvec, require_choice
from smplxpp.core.foreign import METRES_PER_UNIT, PointsLike, mesh_arrays, point_arrays
from smplxpp.core.surface_points import SurfacePoints, truncated_distance

# Rotations from a frame with the named upward axis to one with +Y, both right-handed.
_Y_FROM_UP = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "x": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    "-y": np.diag([-1.0, -1.0, 1.0]),
    "-z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-x": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
}
# Heights from head (or a raised hand) to foot for which a unit is taken without a question, metres: standing adults and
# adolescents. Lower ones are children, crouching people or sizes in no unit at all; what is scaled to 1 is 1 m high.
_LOW, _HIGH = 1.3, 2.5
_Bodies = list[tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 3"]]]
AUTO = "auto"


def convert_points(points: PointsLike, *, units: str | float = "m", up: str = "y") -> Float64[np.ndarray, "N 3"]:
    """Convert points in the stated units and axes to metres, +Y up.

    Args:
        points: points in the source's frame.
        units: "m", "cm", "mm" or "inch", or the metres of one unit.
        up: the source's upward axis: "y", "z", "x", "-y", "-z" or "-x".

    Raises:
        InputError: an unknown name.
    """
    if isinstance(units, str):
        require_choice("option units", units, tuple(METRES_PER_UNIT))
    require_choice("option up", up, tuple(_Y_FROM_UP))
    scale = METRES_PER_UNIT[units] if isinstance(units, str) else units
    return point_arrays(points)[0] @ _Y_FROM_UP[up].T * scale


def sizes_by_unit(size: float) -> str:
    """Return in words what a size would be in each unit: `98.9 m, 98.9 cm (0.989 m), ...`."""
    return ", ".join(
        f"{size:.4g} {unit}" + ("" if scale == 1.0 else f" ({size * scale:.3g} m)")
        for unit, scale in METRES_PER_UNIT.items()
    )


def check_human_scale(vertices: PointsLike, *, subject: str = "scan", axes: bool = True) -> None:
    """Refuse a person that is not in metres or does not stand along Y.

    The largest extent shows the unit. An extent more than 1.3 times the vertical one shows swapped axes, because a
    person with spread arms is about as wide as high, and much less deep.

    Args:
        vertices: (N, 3) of the surface, without unreferenced and non-finite vertices.
        subject: name of the scan in messages.
        axes: whether the extents are compared. Who sits on the floor is 1.35 times as long as high; where the upward
            axis was found without another one that fits, it is that.

    Raises:
        InputError: the message names the option that repairs it.
    """
    # A clothed adult or adolescent, standing or crouching, is 0.7 to 2.6 m high.
    low, high = 0.7, 2.6
    extent = np.ptp(point_arrays(vertices)[0], axis=0)
    size = float(extent.max())
    if not low <= size <= high:
        fitting = [u for u, scale in METRES_PER_UNIT.items() if 1.2 <= size * scale <= 2.3]
        raise InputError(
            f"{subject}: size",
            expected=f"a person {low} to {high} m high",
            received=f"a largest extent of {size:.4g}",
            remedy=f"the file is probably in {fitting[0]}: state it with --units {fitting[0]}"
            if fitting
            else "state the units with --units, or the person's stature in metres with --height (a scan alone), and "
            "check for stray geometry far from the person",
        )
    # Swapped axes: the longest extent is not the vertical one.
    widest = int(np.argmax(extent))
    if axes and widest != 1 and size > 1.3 * extent[1]:
        axis = "xyz"[widest]
        raise InputError(
            f"{subject}: axes",
            expected="a person standing along +Y",
            received=f"extents {extent[0]:.2f} x {extent[1]:.2f} x {extent[2]:.2f} m, longest along {axis.upper()}",
            remedy=f"state the upward axis with --up {axis} (or --up=-{axis} if it points down); if it is +Y, the scan "
            "is of half a person or of something else: legs, head and trunk have to be there",
        )


@dataclass(frozen=True)
class ScanFrame:
    """Units and upward axis of a scan's coordinates.

    Attributes:
        units: a name of `METRES_PER_UNIT`, or the metres of one unit where the person's height was stated.
        up: upward axis, as `convert_points` takes it.
        unambiguous: whether every other axis fits clearly worse.
        note: the finding as a sentence for logs.
    """

    units: str | float
    up: str
    unambiguous: bool
    note: str


def find_scan_frame(
    vertices: PointsLike,
    faces: ArrayLike | None = None,
    *,
    units: str = AUTO,
    up: str = AUTO,
    height: float | None = None,
    usual: str = "",
) -> ScanFrame:
    """Find the units and the upward axis of a person's scan.

    The mean body in standing, kneeling and sitting poses is compared with the scan turned to each of six upward axes
    and eight headings. The axis of the smallest distance is up, and the height along it gives the units. A scan may
    lean by some 20 degrees.

    Args:
        vertices: vertices of the scan, or a mesh of any library.
        faces: faces of the scan; None if a mesh is given.
        units: known units; "auto" finds them.
        up: known upward axis; "auto" finds it.
        height: metres from the lowest to the highest point; the units then follow from it.
        usual: upward axis of the file's format, taken where no other one fits clearly better; empty for none.

    Raises:
        InputError: no surface, units that are stated beside a height, or a size that is no standing person's in any
            unit, or that of data scaled to [-1, 1].
    """
    points, corners = mesh_arrays(vertices if faces is None else (vertices, faces))
    if height is not None:
        check_height(height, units)
    surface = _surface(np.asarray(points, dtype=np.float64), corners)
    costs = {up: 0.0}
    if up == AUTO:
        bodies = _bodies()
        costs = {axis: _cost(surface, bodies, axis) for axis in _Y_FROM_UP}
    order = sorted(costs, key=lambda axis: costs[axis])
    # The distance of the second best is more than 15 % larger where the axis is unambiguous.
    clearly = 1.15
    if usual in costs and costs[usual] <= clearly * costs[order[0]]:
        order.sort(key=lambda axis: axis != usual)
    best = order[0]
    whole = convert_points(points[np.unique(corners)], up=best)[:, 1]
    whole = whole[np.isfinite(whole)]
    size = float(np.ptp(_without_strays(whole)))
    if height is not None:
        axis = f"{'stated' if up != AUTO else 'found'} upward axis {best}"
        note = f"stated height {height:g} m: {size:.4g} units of {1000 * height / size:.4g} mm; {axis}"
        return ScanFrame(height / size, best, True, note)
    if units == AUTO:
        _refuse_normalised(whole)
    chosen = _units(size) if units == AUTO else units
    unambiguous = len(order) == 1 or costs[order[1]] > clearly * costs[best]
    note = f"{'stated' if units != AUTO else 'found'} units {chosen}: {size:.4g} {chosen} from head to foot; "
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


def check_height(height: float, units: str) -> None:
    """Refuse a stated height that is no person's, or that comes beside stated units.

    Raises:
        InputError: naming the option.
    """
    tallest = 2.6  # metres; the tallest person measured so far was 2.72 m, and a height in feet is 4 and more
    if not 0.4 <= height <= tallest:
        raise InputError(
            "option height",
            expected=f"a person's height in metres, 0.4 to {tallest}",
            received=f"{height:g}",
            remedy="1.75 is one metre and 75 centimetres",
        )
    if units not in (AUTO, "m"):
        raise InputError("option height", expected="units or a height", received=f"both: units {units}")


def _without_strays(values: np.ndarray) -> np.ndarray:
    """Return coordinates without those that lie off the rest by more than a tenth of it, as stray geometry does."""
    ordered = np.sort(values)
    low, high = np.searchsorted(ordered, np.quantile(ordered, (0.001, 0.999)))
    reach = 0.1 * (ordered[high] - ordered[low])
    return ordered[(ordered >= ordered[low] - reach) & (ordered <= ordered[high] + reach)]


def _refuse_normalised(heights: np.ndarray) -> None:
    """Refuse heights from exactly -1 to 1: the scan was normalised, because no person stands 1 m in the floor."""
    if abs(heights.min() + 1.0) < 1e-3 and abs(heights.max() - 1.0) < 1e-3:
        raise _no_size("2 from head to foot, from -1 to 1: scaled data, whose unit is lost", 2.0)


def _units(height: float) -> str:
    # Bounds of neighbouring units do not overlap, so that at most one fits.
    for unit, scale in METRES_PER_UNIT.items():
        if _LOW <= height * scale <= _HIGH:
            return unit
    raise _no_size(f"{height:.4g} from head to foot", height)


def _no_size(received: str, size: float) -> InputError:
    return InputError(
        "scan: size",
        expected=f"a person {_LOW} to {_HIGH} m high in {', '.join(METRES_PER_UNIT)}",
        received=received,
        remedy=f"{sizes_by_unit(size)}: state which it is with --units, or the person's stature in metres with "
        "--height 1.75 (people who kneel or sit: --units); check for stray geometry, half a person, an animal",
    )


def _cost(surface: SurfacePoints, bodies: _Bodies, up: str) -> float:
    """Return the distance between the scan with an upward axis and the nearest body, metres of that body."""
    # Scale the scan to the body's height, place it on the floor, and turn the body to eight headings.
    headings = 8
    turns = [matrix_from_rotvec(np.array([0.0, 2.0 * np.pi * k / headings, 0.0])) for k in range(headings)]
    points, normals = (convert_points(values, up=up) for values in (surface.points, surface.normals))
    points = points - points.mean(axis=0)
    low, high = points[:, 1].min(), points[:, 1].max()
    best = np.inf
    for body_points, body_normals in bodies:
        scale = np.ptp(body_points[:, 1]) / max(high - low, 1e-12)
        placed = points * scale
        placed[:, 1] += body_points[:, 1].min() - placed[:, 1].min()
        target = SurfacePoints.from_arrays(placed, normals)
        for turn in turns:
            best = min(best, truncated_distance(body_points @ turn.T, body_normals @ turn.T, target))
    return best


@cache
def _bodies() -> _Bodies:
    """Return 250 points with normals of the open body in standing and low poses, centred on the vertical axis."""
    # Three poses of the legs suffice: more do not change which axis is up.
    body = load_body()
    legs = ("apart", "close", "knees bent")
    vectors = [v for name, v in standing_poses(body.joint_count) if name.rpartition("legs ")[2] in legs]
    # Who sits with legs stretched out is nearer to somebody who lies than to any standing pose.
    vectors += [v for _, v in low_poses(body.joint_count)]
    params = BodyParams.from_full_pose(
        np.stack(vectors), betas=np.zeros((1, 0)), expression=np.zeros((1, 0)), transl=np.zeros((1, 3))
    )
    out = []
    for vertices in body.forward(params).vertices:
        drawn = SurfacePoints.sample(body.mesh(vertices), 250)
        middle = drawn.points.mean(axis=0) * np.array([1.0, 0.0, 1.0])
        out.append((drawn.points - middle, drawn.normals))
    return out
