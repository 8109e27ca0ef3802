"""Arms and legs tried one by one: a limb that lies where the surface has none is put where it has one."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Float64

from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.core.surface_points import TRUNCATION_M, SurfacePoints, truncated_distance
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.locate.proxy import BodyProxy

# Degrees: how far an arm is lowered from the T-pose, taken forwards, twisted, and bent at the elbow.
_LOWERED, _FORWARDS, _TWISTED, _BENT = (-78, -48, -12, 30, 70), (0, -45, -85), (0, 65), (-8, -60, -110)
# A leg: lifted forwards, and bent at the knee.
_LIFTED, _KNEE = (15, 0, -25, -60, -90), (4, 40, 85)
# Turns of the joints of a limb, one after the other.
_Limb = tuple[list[Float64[np.ndarray, " 3"]], ...]
_MIRROR = np.array([1.0, -1.0, -1.0])
# A limb is exchanged for one that is nearer by this share of the whole distance.
_BETTER = 0.005


def try_limbs(kinematics: Kinematics, proxy: BodyProxy, surface: SurfacePoints, state: BodyState) -> BodyState:
    """The state with every limb as it is or as one of the tried ones, whichever brings body and surface nearest."""
    place = {name: k for k, name in enumerate(kinematics.body.joint_names)}
    best = state_distance(kinematics, proxy, surface, state)
    for joints, tried in (
        (("shoulder", "elbow", "wrist"), list(_arms())),
        (("hip", "knee", "ankle"), list(_legs())),
    ):
        for side in ("left", "right"):
            index = [place[f"{side}_{joint}"] for joint in joints]
            mirror = np.ones(3) if side == "left" else _MIRROR
            chosen = state
            for vectors in tried:
                rotations = state.rotations.copy()
                rotations[0, index] = np.eye(3)
                for k, turns in zip(index, vectors, strict=False):
                    for vector in turns:
                        rotations[0, k] = rotations[0, k] @ matrix_from_rotvec(np.radians(vector * mirror))
                other = replace(state, rotations=rotations)
                cost = state_distance(kinematics, proxy, surface, other)
                if cost < best * (1.0 - _BETTER):
                    best, chosen = cost, other
            state = chosen
    return state


def state_distance(
    kinematics: Kinematics, proxy: BodyProxy, surface: SurfacePoints, state: BodyState, *, far: float = TRUNCATION_M
) -> float:
    """How far body and surface are from each other, metres; what is beyond `far` counts as so far."""
    return truncated_distance(*proxy.posed(kinematics, kinematics.posture(state, 0)), surface, far=far)


def _arms() -> list[_Limb]:
    out: list[_Limb] = []
    for lowered, forwards, twisted, bent in product(_LOWERED, _FORWARDS, _TWISTED, _BENT):
        if twisted and bent > -30:
            continue  # a straight arm looks the same
        shoulder = [np.array([0.0, forwards, 0.0]), np.array([0.0, 0.0, lowered]), np.array([twisted, 0.0, 0.0])]
        out.append((shoulder, [np.array([0.0, bent, 0.0])]))
    return out


def _legs() -> list[_Limb]:
    return [([np.array([lifted, 0.0, -5.0])], [np.array([knee, 0.0, 0.0])]) for lifted, knee in product(_LIFTED, _KNEE)]
