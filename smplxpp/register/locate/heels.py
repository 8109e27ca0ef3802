"""Lift the heels of a body that stands in the floor of its scan: shoes with heels.

Feet are fitted flat, so that a leg in a heeled shoe comes out too long and its foot ends below the sole. A local step
cannot lift it, because knee, ankle and toes would have to bend together. A foot that is lower than the scan around it
is therefore tried on heels of two heights: the ankle is raised along the leg (law of cosines for hip and knee), the
foot is pitched down and the toes up, and the candidate of lowest cost is kept.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.register.kinematics import BodyState
from smplxpp.register.locate.search import Found, Search

# A usual and a high heel: height in metres, pitch of the foot and of the toes in degrees.
_HEELS = ((0.05, 30.0, -20.0), (0.08, 45.0, -30.0))
_BELOW = 0.015
"""Depth in metres below the scan around it from which a foot counts as in the floor; in a flat shoe it is above."""
_AROUND = 0.25
"""Metres around an ankle within which the scan shows its shoe."""


def lift_heels(search: Search, found: Found, skin: np.ndarray | None = None) -> Found:
    """Return the body with its feet on heels, where that costs less; else the same body.

    Args:
        search: the search that found it.
        found: the body, finished.
        skin: whether a point of `search.fine` is bare skin; None if unknown.
    """
    below = {side: _below_floor(search, found.state, side) for side in ("left", "right")}
    # Shoes come in pairs: where one foot is that low, the other may be half as low.
    low = [side for side, depth in below.items() if depth >= 0.5 * _BELOW] if max(below.values()) >= _BELOW else []
    # Both feet at once first, because one alone would tilt the person.
    for sides in ([low] if len(low) == 2 else []) + [[side] for side in low]:
        tried = []
        for heel in _HEELS:
            state = found.state
            for side in sides:
                state = on_heel(search, state, side, heel)
            tried.append(search.polished(found.name, state, skin, steps=6))
        best = min(tried, key=lambda one: one.cost)
        if best.cost < found.cost - 0.05:
            found = best
            if len(sides) == 2:
                break
    return found


def _below_floor(search: Search, state: BodyState, side: str) -> float:
    """Return how far a foot reaches below the scan around it, metres."""
    kinematics = search.kinematics
    posture = kinematics.posture(state, 0)
    ankle = kinematics.body.joint_names.index(f"{side}_ankle")
    own = kinematics.descends_from[search.many.limb, ankle]
    places = search.many.posed(kinematics, posture)[0][own]
    near = np.linalg.norm(search.fine.points - posture.joints[ankle], axis=1) < _AROUND
    if not own.any() or not near.any():
        return 0.0
    return float(search.fine.points[near, 1].min() - places[:, 1].min())


def on_heel(search: Search, state: BodyState, side: str, heel: tuple[float, float, float]) -> BodyState:
    """Return the body with one foot on a heel of a height (metres), with pitches of foot and toes (degrees).

    With thigh a, shin b and the distance d from hip to ankle, the angle at the knee is acos((a^2 + b^2 - d^2) / 2ab),
    and that between thigh and d acos((a^2 + d^2 - b^2) / 2ad). The height is taken off d.
    """
    height, foot, toes = heel
    names = search.kinematics.body.joint_names
    index = {name: names.index(f"{side}_{name}") for name in ("hip", "knee", "ankle", "foot")}
    hip, knee, ankle = (search.kinematics.posture(state, 0).joints[index[name]] for name in ("hip", "knee", "ankle"))
    a, b, d = (float(np.linalg.norm(v)) for v in (knee - hip, ankle - knee, ankle - hip))

    def angles(d: float) -> np.ndarray:
        cosines = [(a * a + b * b - d * d) / (2 * a * b), (a * a + d * d - b * b) / (2 * a * d)]
        return np.arccos(np.clip(cosines, -1.0, 1.0))

    bent, lifted = angles(d - height) - angles(d)
    # About the axis to the side, each in the frame of its joint; the ankle undoes what hip and knee turn.
    turns = {"hip": -lifted, "knee": -bent, "ankle": bent + lifted + np.radians(foot), "foot": np.radians(toes)}
    rotations = state.rotations.copy()
    for name, angle in turns.items():
        rotations[0, index[name]] = rotations[0, index[name]] @ matrix_from_rotvec(np.array([angle, 0.0, 0.0]))
    return replace(state, rotations=rotations)
