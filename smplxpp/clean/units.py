"""Units and axes: a stated conversion, and the check that a person stands upright in metres."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, Num

from smplxpp.core.errors import InputError
from smplxpp.core.validation import require_choice

METRES_PER_UNIT = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
# Rotations that bring the named axis to +Y and keep the frame right-handed.
_Y_FROM_UP = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "x": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
    "-y": np.diag([-1.0, -1.0, 1.0]),
    "-z": np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "-x": np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]),
}
# A clothed adult or adolescent, standing or crouching, is this high in metres.
_HEIGHT = (0.7, 2.6)


def convert_points(points: Num[np.ndarray, "N 3"], *, units: str = "m", up: str = "y") -> Float64[np.ndarray, "N 3"]:
    """Convert points in the stated units and axes to metres, +Y up.

    Args:
        units: "m", "cm", "mm" or "inch". up: the source's upward axis: "y", "z", "x", "-y", "-z" or "-x".

    Raises:
        InputError: an unknown name.
    """
    for name, value, known in (("units", units, METRES_PER_UNIT), ("up", up, _Y_FROM_UP)):
        require_choice(f"option {name}", value, tuple(known))
    return np.asarray(points, dtype=np.float64) @ _Y_FROM_UP[up].T * METRES_PER_UNIT[units]


def check_human_scale(vertices: Float[np.ndarray, "N 3"], *, subject: str = "scan") -> None:
    """Refuse a person that is not in metres or does not stand along Y.

    The largest extent tells the unit, the axis of an extent more than 1.3 times the vertical one tells swapped axes
    (arms out, a person is about as wide as high, and much less deep).

    Args:
        vertices: (N, 3) of the surface; unreferenced and non-finite vertices should be gone.

    Raises:
        InputError: the message names the option that repairs it.
    """
    extent = np.ptp(np.asarray(vertices, dtype=np.float64), axis=0)
    size = float(extent.max())
    if not _HEIGHT[0] <= size <= _HEIGHT[1]:
        fitting = [u for u, scale in METRES_PER_UNIT.items() if 1.2 <= size * scale <= 2.3]
        raise InputError(
            f"{subject}: size",
            expected=f"a person {_HEIGHT[0]} to {_HEIGHT[1]} m high",
            received=f"a largest extent of {size:.4g}",
            remedy=f"the file is probably in {fitting[0]}: state it with --units {fitting[0]}"
            if fitting
            else "state the units with --units, and check for stray geometry far from the person",
        )
    widest = int(np.argmax(extent))
    if widest != 1 and size > 1.3 * extent[1]:
        axis = "xyz"[widest]
        raise InputError(
            f"{subject}: axes",
            expected="a person standing along +Y",
            received=f"extents {extent[0]:.2f} x {extent[1]:.2f} x {extent[2]:.2f} m, longest along {axis.upper()}",
            remedy=f"state the upward axis with --up {axis} (or --up=-{axis} if it points down)",
        )
