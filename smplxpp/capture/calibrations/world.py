"""Bring the cameras of a calibration file to metres with +y up, by what the file, the user or the cameras say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from smplxpp.capture.calibrations.file_camera import AXES, FileCamera, RigFile
from smplxpp.core.errors import InputError
from smplxpp.core.rotations import matrix_from_rotvec

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
"""Lengths in metres by the names that users give them."""
# Distances of cameras from the middle of a rig for one person, in metres: from a closet of phones to a hall.
_NEAREST, _FARTHEST = 0.6, 30.0
# A world whose vertical is within this angle of an axis, in degrees, has this axis up: cameras tell it by some degrees.
_SNAP = 25.0
_EPS = 1e-9


def metres_of(rig: RigFile, units: str | None, *, source: str) -> tuple[float, list[str]]:
    """Return the length of the file's unit in metres, with a note where it was guessed.

    Without a unit of the format or the user, it is the first of m, mm, cm, inch in which the cameras stand 0.6 to 30 m
    from the middle of what they look at.

    Raises:
        InputError: no unit makes a rig for a person.
    """
    if units is not None:
        return UNITS[units], []
    if rig.metres is not None:
        return rig.metres, []
    distance = _median_distance(rig.cameras)
    fitting = [name for name in ("m", "mm", "cm", "inch") if _NEAREST <= UNITS[name] * distance <= _FARTHEST]
    if not fitting:
        raise InputError(
            source,
            expected=f"cameras {_NEAREST:g} to {_FARTHEST:g} m from what they look at, in some unit",
            received=f"{distance:.4g} of an unknown unit",
            remedy="name it: --units m, cm, mm or inch",
        )
    name = fitting[0]
    return UNITS[name], [
        f"unit taken for {name}, because the cameras then stand {UNITS[name] * distance:.1f} m from the middle "
        "(--units names it)"
    ]


def upright_from_world(rig: RigFile, up: str | None, *, source: str) -> tuple[Float64[np.ndarray, "3 3"], list[str]]:
    """Return the rotation that turns the file's world to +y up, with notes.

    The axis is that of the user, else of the format, else what the cameras' pictures say: horizontal rows of pixels are
    horizontal in the world, and their upper edges point up.

    Raises:
        InputError: the cameras do not tell it.
    """
    seen = _seen_up(rig.cameras)
    named = up or rig.up
    if named is not None:
        notes = []
        if up is None and seen is not None and float(np.dot(seen, AXES[named])) < 0.5:
            notes.append(
                f"the format has {named} up, but the upper edges of the pictures point along "
                f"{_rounded(seen)} of the world: name the axis with --up if the person lies"
            )
        return _turn(np.array(AXES[named], dtype=np.float64)), notes
    if seen is None:
        raise InputError(
            source, expected="cameras that tell where up is", received="none", remedy="name the axis: --up z"
        )
    axis = max(AXES, key=lambda name: float(np.dot(seen, AXES[name])))
    if float(np.dot(seen, AXES[axis])) > np.cos(np.radians(_SNAP)):
        return _turn(np.array(AXES[axis], dtype=np.float64)), [
            f"{axis} taken for up, as the pictures say (--up names it)"
        ]
    return _turn(seen), [
        "no axis of the calibration's world points up: turned upright by the pictures' edges, to some degrees "
        "(--up names an axis)"
    ]


def _seen_up(cameras: Sequence[FileCamera]) -> Float64[np.ndarray, " 3"] | None:
    """Return the direction that is up by the cameras' pictures; None where they contradict each other.

    The rows of most cameras are level, so that up is perpendicular to all of them: it is the direction with the least
    sum of squares along the rows, if the cameras look in different directions; else the mean of the upper edges.
    """
    rights, ups = (np.stack([sign * camera.R[row] for camera in cameras]) for row, sign in ((0, 1.0), (1, -1.0)))
    mean = ups.mean(axis=0)
    if np.linalg.norm(mean) < 0.3:
        return None
    mean /= np.linalg.norm(mean)
    _, spread, axes = np.linalg.svd(rights)
    if len(cameras) >= 3 and spread[1] > 0.4 * spread[0] and abs(axes[2] @ mean) > 0.7:
        return axes[2] * np.sign(axes[2] @ mean)
    return mean


def _turn(up: np.ndarray) -> Float64[np.ndarray, "3 3"]:
    """Return the shortest rotation of a direction to +y; axes go to axes exactly."""
    y = np.array([0.0, 1.0, 0.0])
    axis, cosine = np.cross(up, y), float(up @ y)
    sine = float(np.linalg.norm(axis))
    if sine < _EPS:
        return np.eye(3) if cosine > 0 else np.diag([1.0, -1.0, -1.0])
    turn = matrix_from_rotvec(axis / sine * np.arctan2(sine, cosine))
    return np.rint(turn) if np.abs(turn - np.rint(turn)).max() < _EPS else turn


def _median_distance(cameras: Sequence[FileCamera]) -> float:
    """Return the median distance of the cameras from the point nearest to all their axes, in the file's unit."""
    centres, ahead = np.stack([c.centre for c in cameras]), np.stack([c.R[2] for c in cameras])
    return float(np.median(np.linalg.norm(centres - focus_of(centres, ahead), axis=1)))


def focus_of(centres: Float64[np.ndarray, "C 3"], ahead: Float64[np.ndarray, "C 3"]) -> Float64[np.ndarray, " 3"]:
    """Return the point with the least sum of squared distances from the cameras' axes.

    Args:
        centres: positions of the cameras.
        ahead: unit vectors along which they look.
    """
    across = np.eye(3) - ahead[:, :, None] * ahead[:, None, :]  # projections perpendicular to the axes
    normal, right = across.sum(axis=0), (across @ centres[:, :, None]).sum(axis=0)[:, 0]
    # The distance is undetermined for cameras with parallel axes: it stays near them.
    mean = centres.mean(axis=0)
    damping = 1e-6 * len(centres) * np.eye(3)
    return mean + np.linalg.solve(normal + damping, right - normal @ mean)


def _rounded(direction: np.ndarray) -> str:
    return "(" + ", ".join(f"{value:.2f}" for value in direction) + ")"
