"""Hands tried as they may be turned and bent: the nearest to the surface about them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Bool
from scipy.spatial import cKDTree

from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.core.surface_points import SurfacePoints, position_normal_features
from smplxpp.register.anatomy import Anatomy
from smplxpp.register.config import RegisterConfig
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.locate.descend import DrawnTogether, descend
from smplxpp.register.locate.limbs import state_distance
from smplxpp.register.locate.proxy import BodyProxy
from smplxpp.register.normal_equations import Columns
from smplxpp.register.priors import Priors, Start

# Degrees about the forearm, of the wrist up and down, and of every joint of the fingers.
_TWISTED, _WRIST, _CURLED = (-80, -40, 0, 40, 80), (-35, 0, 35), (4, 28, 65)
_MIRROR = np.array([1.0, -1.0, -1.0])
# Metres about the middle of the forearm's end within which a scan's points may be the hand's; points looked at.
_ABOUT, _POINTS, _LEAST = 0.22, 500, 60
# Metres: what the rest of the body explains, and a distance that says no more than "far".
_EXPLAINED, _FAR = 0.05, 0.06
_FOLLOWED, _STEPS = 4, 8
# Metres by which a tried hand must be nearer; how fixed all else is (metres, betas).
_BETTER, _FIXED = 0.0005, (1e-4, 1e-3)


def try_hands(kinematics: Kinematics, proxy: BodyProxy, surface: SurfacePoints, state: BodyState) -> BodyState:
    """The state with each hand as it is, or turned and bent so that it lies nearer to the surface.

    Args:
        proxy: many points, those of the hands among them. surface: many points.
    """
    for side in ("left", "right"):
        state = _tried(kinematics, proxy, surface, state, side)
    return state


def _tried(kinematics: Kinematics, proxy: BodyProxy, surface: SurfacePoints, state: BodyState, side: str) -> BodyState:
    names = list(kinematics.body.joint_names)
    wrist, elbow = names.index(f"{side}_wrist"), names.index(f"{side}_elbow")
    fingers = np.flatnonzero(kinematics.hangs_on[:, wrist] & (np.arange(len(names)) != wrist))
    arm = proxy.select(_of_arm(proxy, kinematics, wrist, elbow))
    about = _about(kinematics, proxy, surface, state, wrist)
    if about is None or len(arm.region) < _LEAST or not len(fingers):
        return state

    def distance(one: BodyState) -> float:
        return state_distance(kinematics, arm, about, one, far=_FAR)

    mirror = np.ones(3) if side == "left" else _MIRROR
    curled_ones = fingers[["thumb" not in names[k] for k in fingers]]
    tried = []
    for twisted, bent, curled in product(_TWISTED, _WRIST, _CURLED):
        # Half of the twist at the elbow, half at the wrist, as bones do it.
        half = matrix_from_rotvec(np.radians(np.array([0.5 * twisted, 0.0, 0.0]) * mirror))
        rotations = state.rotations.copy()
        rotations[0, elbow] = rotations[0, elbow] @ half
        rotations[0, wrist] = half @ matrix_from_rotvec(np.radians(np.array([0.0, 0.0, bent]) * mirror))
        rotations[0, curled_ones] = matrix_from_rotvec(np.radians(np.array([0.0, 0.0, -curled]) * mirror))
        tried.append(replace(state, rotations=rotations))
    chosen = sorted(tried, key=distance)[:_FOLLOWED]
    joints = np.concatenate([[elbow, wrist], fingers])
    ends = [_drawn(kinematics, arm, about, one, joints) for one in (state, *chosen)]
    costs = [distance(one) for one in ends]
    best = int(np.argmin(costs))
    return ends[best] if costs[best] < costs[0] - _BETTER else ends[0]


def _about(
    kinematics: Kinematics, proxy: BodyProxy, surface: SurfacePoints, state: BodyState, wrist: int
) -> SurfacePoints | None:
    """Points of the surface that may be of the hand: near, and not what the rest of the body explains."""
    posture = kinematics.posture(state, 0)
    near = np.linalg.norm(surface.points - posture.joints[wrist], axis=1) < _ABOUT
    elbow = kinematics.parents[wrist]
    other = proxy.select(~kinematics.hangs_on[proxy.limb, elbow])
    explained, _ = cKDTree(position_normal_features(*other.posed(kinematics, posture))).query(surface.tree.data)
    rows = np.flatnonzero(near & (explained > _EXPLAINED))
    return surface.select(rows[:: max(1, len(rows) // _POINTS)]) if len(rows) >= _LEAST else None


def _of_arm(proxy: BodyProxy, kinematics: Kinematics, wrist: int, elbow: int) -> Bool[np.ndarray, " N"]:
    """The hand and the far half of the forearm."""
    joints = kinematics.rest_joints
    along = joints[wrist] - joints[elbow]
    far = (proxy.points.rest - joints[elbow]) @ along > 0.6 * along @ along
    return (kinematics.hangs_on[proxy.limb, wrist]) | ((proxy.limb == elbow) & far)


def _drawn(
    kinematics: Kinematics, arm: BodyProxy, about: SurfacePoints, state: BodyState, joints: np.ndarray
) -> BodyState:
    """The hand drawn onto the surface, all else as it is."""
    body = kinematics.body
    columns = Columns(joints, body.joint_count, 0, body.num_expressions, body.num_betas)
    start = Start(state, np.inf, *_FIXED)
    priors = Priors(columns, np.zeros(1, np.int64), Anatomy.of(body.joint_count), RegisterConfig(), start=start)
    term = DrawnTogether(arm, about, sigma=0.006, count=100.0)
    for reach in np.geomspace(0.06, 0.015, _STEPS):
        term.reach = float(reach)
        state = descend(kinematics, columns, state, [term], priors)
    return state
