"""Search the poses of single limbs and hands on a grid, to leave the local minima of ICP.

An arm that ICP has pulled to the hip does not find its own surface again. So every arm and leg, and later every hand,
is tried in the poses of a grid while the rest of the body is held; the nearest to the surface is kept.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import cKDTree

from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.core.surface_points import TRUNCATION_M, SurfacePoints, position_normal_features, truncated_distance
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.locate.icp import IcpTerm, gauss_newton_step
from smplxpp.register.locate.proxy import BodyProxy
from smplxpp.register.normal_equations import Columns
from smplxpp.register.observations import RegisterConfig
from smplxpp.register.priors import Anatomy, Priors
from smplxpp.register.start import Start

LimbPose = tuple[list[Float64[np.ndarray, " 3"]], ...]
"""Rotation vectors of the joints of a limb, degrees, applied one after the other."""
MIRROR = np.array([1.0, -1.0, -1.0])
"""Mirrors rotation vectors of the left side to the right side."""


def try_limbs(kinematics: Kinematics, proxy: BodyProxy, surface: SurfacePoints, state: BodyState) -> BodyState:
    """Replace each arm and leg by the pose of the grid that brings body and surface nearest, if one is nearer."""
    place = {name: k for k, name in enumerate(kinematics.body.joint_names)}
    best = state_distance(kinematics, proxy, surface, state)
    for limb, joints in (("arm", ("shoulder", "elbow", "wrist")), ("leg", ("hip", "knee", "ankle"))):
        for side in ("left", "right"):
            index = [place[f"{side}_{joint}"] for joint in joints]
            # A pose of the grid replaces the limb if it is nearer by half a per cent of the whole distance.
            chosen = state
            for tried in _grid(limb, side):
                rotations = state.rotations.copy()
                rotations[0, index] = tried
                other = replace(state, rotations=rotations)
                cost = state_distance(kinematics, proxy, surface, other)
                if cost < best * (1.0 - 0.005):
                    best, chosen = cost, other
            state = chosen
    return state


def state_distance(
    kinematics: Kinematics, proxy: BodyProxy, surface: SurfacePoints, state: BodyState, *, far: float = TRUNCATION_M
) -> float:
    """Return the mean distance between body and surface in both directions, metres, truncated at `far`."""
    return truncated_distance(*proxy.posed(kinematics, kinematics.posture(state, 0)), surface, far=far)


@cache
def _grid(limb: str, side: str) -> list[Float64[np.ndarray, "3 3 3"]]:
    """Return the rotations of the three joints of an arm or a leg in all poses of its grid."""
    mirror = np.ones(3) if side == "left" else MIRROR
    out = []
    for vectors in _arms() if limb == "arm" else _legs():
        rotations = np.tile(np.eye(3), (3, 1, 1))
        for k, rotvecs in enumerate(vectors):
            for vector in rotvecs:
                rotations[k] = rotations[k] @ matrix_from_rotvec(np.radians(vector * mirror))
        out.append(rotations)
    return out


def _arms() -> list[LimbPose]:
    """Return the grid of arm poses: lowered from the T-pose, taken forwards, twisted, bent at the elbow; degrees."""
    out: list[LimbPose] = []
    for lowered, forwards, twisted, bent in product((-78, -48, -12, 30, 70), (0, -45, -85), (0, 65), (-8, -60, -110)):
        if twisted and bent > -30:
            continue  # twisting a straight arm changes nothing
        shoulder = [np.array([0.0, forwards, 0.0]), np.array([0.0, 0.0, lowered]), np.array([twisted, 0.0, 0.0])]
        out.append((shoulder, [np.array([0.0, bent, 0.0])]))
    return out


def _legs() -> list[LimbPose]:
    """Return the grid of leg poses: lifted forwards at the hip, bent at the knee; degrees."""
    poses = product((15, 0, -25, -60, -90), (4, 40, 85))
    return [([np.array([lifted, 0.0, -5.0])], [np.array([knee, 0.0, 0.0])]) for lifted, knee in poses]


def try_hands(kinematics: Kinematics, proxy: BodyProxy, surface: SurfacePoints, state: BodyState) -> BodyState:
    """Refine each hand by ICP from the best poses of a grid, and keep the result if it is nearer to the surface.

    Args:
        kinematics: of the body.
        proxy: many points, with those of the hands.
        surface: many points of the scan.
        state: the body, fitted without its fingers.
    """
    for side in ("left", "right"):
        state = try_hand(kinematics, proxy, surface, state, side)
    return state


def try_hand(
    kinematics: Kinematics, proxy: BodyProxy, surface: SurfacePoints, state: BodyState, side: str
) -> BodyState:
    """Refine one hand; return the state as it is if too little of the hand can be seen."""
    names = list(kinematics.body.joint_names)
    wrist, elbow = names.index(f"{side}_wrist"), names.index(f"{side}_elbow")
    fingers = np.flatnonzero(kinematics.descends_from[:, wrist] & (np.arange(len(names)) != wrist))
    arm = proxy.select(_of_arm(proxy, kinematics, wrist, elbow))
    about = _surface_of_hand(kinematics, proxy, surface, state, wrist)
    if about is None or len(arm.region) < 60 or not len(fingers):
        return state

    def distance(one: BodyState) -> float:
        return state_distance(kinematics, arm, about, one, far=0.06)

    mirror = np.ones(3) if side == "left" else MIRROR
    curled_ones = fingers[["thumb" not in names[k] for k in fingers]]
    # The grid, degrees: twist of the forearm, bend of the wrist, curl of every finger joint.
    tried = []
    for twisted, bent, curled in product((-80, -40, 0, 40, 80), (-35, 0, 35), (4, 28, 65)):
        # Half of the twist is at the elbow, half at the wrist, as the two bones of the forearm distribute it.
        half = matrix_from_rotvec(np.radians(np.array([0.5 * twisted, 0.0, 0.0]) * mirror))
        rotations = state.rotations.copy()
        rotations[0, elbow] = rotations[0, elbow] @ half
        rotations[0, wrist] = half @ matrix_from_rotvec(np.radians(np.array([0.0, 0.0, bent]) * mirror))
        rotations[0, curled_ones] = matrix_from_rotvec(np.radians(np.array([0.0, 0.0, -curled]) * mirror))
        tried.append(replace(state, rotations=rotations))
    # Refine the hand as it is and the four best of the grid; a new pose must be half a millimetre nearer.
    chosen = sorted(tried, key=distance)[:4]
    joints = np.concatenate([[elbow, wrist], fingers])
    ends = [_refined_hand(kinematics, arm, about, one, joints) for one in (state, *chosen)]
    costs = [distance(one) for one in ends]
    best = int(np.argmin(costs))
    return ends[best] if costs[best] < costs[0] - 0.0005 else ends[0]


def _surface_of_hand(
    kinematics: Kinematics, proxy: BodyProxy, surface: SurfacePoints, state: BodyState, wrist: int
) -> SurfacePoints | None:
    """Return points of the surface that may show the hand: within 22 cm of the wrist, and over 5 cm from all other
    limbs. At most about 500 are kept; None if there are fewer than 60."""
    posture = kinematics.posture(state, 0)
    near = np.linalg.norm(surface.points - posture.joints[wrist], axis=1) < 0.22
    elbow = kinematics.parents[wrist]
    other = proxy.select(~kinematics.descends_from[proxy.limb, elbow])
    explained, _ = cKDTree(position_normal_features(*other.posed(kinematics, posture))).query(surface.tree.data)
    rows = np.flatnonzero(near & (explained > 0.05))
    return surface.select(rows[:: max(1, len(rows) // 500)]) if len(rows) >= 60 else None


def _of_arm(proxy: BodyProxy, kinematics: Kinematics, wrist: int, elbow: int) -> Bool[np.ndarray, " N"]:
    """Return which points belong to the hand or to the far 40 % of the forearm."""
    joints = kinematics.rest_joints
    along = joints[wrist] - joints[elbow]
    far = (proxy.points.rest - joints[elbow]) @ along > 0.6 * along @ along
    return (kinematics.descends_from[proxy.limb, wrist]) | ((proxy.limb == elbow) & far)


def _refined_hand(
    kinematics: Kinematics, arm: BodyProxy, about: SurfacePoints, state: BodyState, joints: np.ndarray
) -> BodyState:
    """Refine a hand by eight ICP steps whose reach falls from 60 to 15 mm; the rest of the body is held in place."""
    body = kinematics.body
    columns = Columns(joints, body.joint_count, 0, body.num_expressions, body.num_betas)
    # A tight prior on translation (0.1 mm) and shape (0.001) holds the body.
    start = Start(state, np.inf, 1e-4, 1e-3)
    priors = Priors(columns, np.zeros(1, np.int64), Anatomy.of(body.joint_count), RegisterConfig(), start=start)
    term = IcpTerm(arm, about, sigma=0.006, count=100.0)
    for reach in np.geomspace(0.06, 0.015, 8):
        term.reach = float(reach)
        state = gauss_newton_step(kinematics, columns, state, [term], priors)
    return state
