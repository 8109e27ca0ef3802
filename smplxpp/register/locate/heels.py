"""Lift the heels of a body that stands in the floor of its scan: shoes with heels.

Feet are fitted flat, so that a leg in a heeled shoe comes out too long and its foot ends below the sole. A local step
cannot lift it, because knee, ankle and toes would have to bend together. A foot that is lower than the scan around it
is therefore tried on heels of two heights: the ankle is raised along the leg (law of cosines for hip and knee), the
foot is pitched down and the toes up, and the candidate of lowest cost is kept. A straight leg cannot be shortened by
its knee, and the fit has made it too long: candidates with shorter legs are tried, too.

At the end the feet are turned to where their shoes are (`settle_feet`), because the pose prior keeps toes straight
and a step of the whole body moves them little: with the depth d of a point of the foot in the shoe (negative
outside), and e the distance of a point of the shoe from the foot, pitch, toes, turn and tilt of each foot minimise

    mean (2 min(|d|, 5 cm))^2 [d < 0] + mean clip(d - 15 mm, 0, 3 cm)^2 [d > 0] + mean clip(e - 8 mm, 0, 4 cm)^2.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.core.surface_points import SurfacePoints
from smplxpp.register.kinematics import BodyState
from smplxpp.register.locate.proxy import BodyProxy
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
    # A foot that is still in the floor hangs on a leg that is too long.
    if low and max(_below_floor(search, found.state, side) for side in low) >= _BELOW:
        tried = []
        for length in _SHORTER:
            state = _on_their_shoes(search, _with_shorter_legs(search, found.state, length), low)
            tried.append(search.polished(found.name, state, skin, steps=6))
        best = min(tried, key=lambda one: one.cost)
        found = best if best.cost < found.cost - 0.05 else found
    return found


def settle_feet(search: Search, found: Found) -> Found:
    """Return the body with its lifted feet turned into their shoes, on shorter legs where they still end below these.

    A step of the whole body leaves a leg too long for its heel, because a sole is small beside trousers, and a foot
    that lies below the sole cannot be turned into the shoe. Flat feet stay.

    The cost of the pose stays that before, because toes that a heel bends are no odd pose.
    """
    lifted = [side for side in ("left", "right") if _pitch(search, found.state, side) > _LIFTED]
    if not lifted:
        return found
    shoes = [_Shoe.of(search, found.state, side) for side in lifted]
    state, least = found.state, np.inf
    for length in (0.0, 0.015, 0.03, 0.045):
        shorter = _with_shorter_legs(search, found.state, length) if length else found.state
        tried = _on_their_shoes(search, shorter, lifted)
        cost = sum(shoe.cost(search, tried) for shoe in shoes if len(shoe.surface))
        if cost < _BETTER * least:
            state, least = tried, cost
    now = search.polished(found.name, state, None, steps=0)
    return replace(found, state=state, misfit=now.misfit)


_SHORTER = (0.04, 0.06)
"""Shortening of the legs in metres, where the heels alone do not lift the feet out of the floor."""
_KEPT = 0.004
"""Weight of a standard deviation of shape against a metre of a bone's length, when legs are shortened."""
_LIFTED = np.radians(15.0)
"""Pitch of a foot from which it is lifted; flat on the floor it is less than 10 degrees."""
_BETTER = 0.9
"""Share of the cost of a foot in its shoe below which another pose of it is taken."""


def _pitch(search: Search, state: BodyState, side: str) -> float:
    """Return by how much a foot points farther down than in the T-pose, radians."""
    names = search.kinematics.body.joint_names
    ends = [names.index(f"{side}_{joint}") for joint in ("ankle", "foot")]
    posed, rest = search.kinematics.posture(state, 0).joints[ends], search.kinematics.rest_joints[ends]
    now, before = (np.arcsin((ankle[1] - foot[1]) / np.linalg.norm(ankle - foot)) for ankle, foot in (posed, rest))
    return float(now - before)


def _with_shorter_legs(search: Search, state: BodyState, length: float) -> BodyState:
    """Return the body with a shape whose legs are shorter by a length, metres, and whose other bones stay.

    With the derivatives D of the lengths of all bones by the shape, and the wanted changes r, the change of shape is
    argmin |D x - r|^2 + (4 mm)^2 |x|^2. The pelvis stays in its place.
    """
    kinematics, count = search.kinematics, len(state.betas)
    names, parents = list(kinematics.body.joint_names), kinematics.body.parents
    rest = kinematics.rest_joints + kinematics.joint_dirs[:, :, :count] @ state.betas
    leg = [f"{side}_{joint}" for side in ("left", "right") for joint in ("knee", "ankle")]
    rows, wanted = [], []
    for joint, name in enumerate(names):
        bone = rest[joint] - rest[parents[joint]] if joint else np.zeros(3)
        size = float(np.linalg.norm(bone))
        # Eyes and fingers are too short to say anything about shape.
        if size > 0.05 and not name.endswith("_hip"):
            change = kinematics.joint_dirs[joint, :, :count] - kinematics.joint_dirs[parents[joint], :, :count]
            rows.append(bone / size @ change)
            wanted.append(-0.5 * length if name in leg else 0.0)
    matrix = np.array(rows)
    step = np.linalg.solve(matrix.T @ matrix + _KEPT**2 * np.eye(count), matrix.T @ np.array(wanted))
    moved = kinematics.joint_dirs[0, :, :count] @ step
    return replace(state, betas=state.betas + step, transl=state.transl - moved)


@dataclass(frozen=True, eq=False)
class _Shoe:
    """A lower leg and the surface around it.

    Attributes:
        side: left or right.
        proxy: points of the body below the knee.
        weight: of each of them; those of the foot count 1, of the shin, which trousers cover, less.
        surface: points of the scan.
        tree: search tree of their positions.
    """

    side: str
    proxy: BodyProxy
    weight: np.ndarray
    surface: SurfacePoints
    tree: cKDTree

    @staticmethod
    def of(search: Search, state: BodyState, side: str) -> _Shoe:
        """Gather the points about one ankle; those nearer to the other leg belong to the other shoe."""
        kinematics, many, fine = search.kinematics, search.many, search.fine
        names = list(kinematics.body.joint_names)
        posture, ankle = kinematics.posture(state, 0), names.index(f"{side}_ankle")
        proxy = many.select(np.flatnonzero(kinematics.descends_from[many.limb, names.index(f"{side}_knee")]))
        hip = names.index("right_hip" if side == "left" else "left_hip")
        nearest = cKDTree(kinematics.points(many.points, posture)).query(fine.points)[1]
        near = np.linalg.norm(fine.points - posture.joints[ankle], axis=1) < _AROUND
        own = near & ~kinematics.descends_from[many.limb[nearest], hip]
        weight = np.where(kinematics.descends_from[proxy.limb, ankle], 1.0, 0.3)
        surface = fine.select(np.flatnonzero(own))
        return _Shoe(side, proxy, weight / weight.sum(), surface, cKDTree(surface.points))

    def cost(self, search: Search, state: BodyState) -> float:
        """Return the cost of the module's docstring, square millimetres."""
        places = search.kinematics.points(self.proxy.points, search.kinematics.posture(state, 0))
        distance, nearest = self.tree.query(places)
        offset = places - self.surface.points[nearest]
        outside = np.einsum("ij,ij->i", self.surface.normals[nearest], offset) > 0
        # A foot leaves its shoe less than it leaves it empty, as heels and pointed tips are.
        depth = np.where(outside, 2.0 * np.minimum(distance, 0.05), np.clip(distance - 0.015, 0.0, 0.03))
        empty = np.clip(cKDTree(places).query(self.surface.points)[0] - 0.008, 0.0, 0.04)
        return 1e6 * float(self.weight @ depth**2 + (empty**2).mean())


def _on_their_shoes(search: Search, state: BodyState, sides: list[str]) -> BodyState:
    """Return the body with pitch, toes, turn and tilt of feet as their shoes have them (Nelder-Mead, three starts)."""
    for side in sides:
        state = _on_shoe(search, state, _Shoe.of(search, state, side))
    return state


def _on_shoe(search: Search, state: BodyState, shoe: _Shoe) -> BodyState:
    if not len(shoe.surface):
        return state
    ankle = search.kinematics.body.joint_names.index(f"{shoe.side}_ankle")
    joints = search.kinematics.posture(state, 0).joints

    def turned(x: np.ndarray) -> BodyState:
        pitched = on_heel(search, state, shoe.side, (0.0, float(x[0]), float(x[1])), joints)
        rotations = pitched.rotations.copy()
        rotations[0, ankle] = rotations[0, ankle] @ matrix_from_rotvec(np.radians([0.0, x[2], x[3]]))
        return replace(pitched, rotations=rotations)

    def cost(x: np.ndarray) -> float:
        # A degree of turn or tilt costs a little, because a round toe does not tell them.
        return shoe.cost(search, turned(x)) + 0.05 * float(x[2:] @ x[2:])

    best, least = None, _BETTER * shoe.cost(search, state)
    for pitch, toes in ((0.0, 0.0), (25.0, -25.0), (45.0, -45.0)):
        start = np.array([pitch, toes, 0.0, 0.0])
        simplex = np.concatenate([start[None], start + np.diag([12.0, -12.0, 6.0, 6.0])])
        options = {"initial_simplex": simplex, "maxfev": 150, "xatol": 0.5, "fatol": 0.5}
        found = minimize(cost, start, method="Nelder-Mead", options=options)
        if found.fun < least:
            best, least = found.x, float(found.fun)
    return state if best is None else turned(best)


def _below_floor(search: Search, state: BodyState, side: str) -> float:
    """Return how far a foot reaches below the scan around it, metres."""
    kinematics = search.kinematics
    posture = kinematics.posture(state, 0)
    ankle = kinematics.body.joint_names.index(f"{side}_ankle")
    own = kinematics.descends_from[search.many.limb, ankle]
    places = kinematics.points(search.many.points, posture)[own]
    near = np.linalg.norm(search.fine.points - posture.joints[ankle], axis=1) < _AROUND
    if not own.any() or not near.any():
        return 0.0
    return float(search.fine.points[near, 1].min() - places[:, 1].min())


def on_heel(
    search: Search,
    state: BodyState,
    side: str,
    heel: tuple[float, float, float],
    joints: np.ndarray | None = None,
) -> BodyState:
    """Return the body with one foot on a heel of a height (metres), with pitches of foot and toes (degrees).

    The posed joints of the state are computed where they are not given.

    With thigh a, shin b and the distance d from hip to ankle, the angle at the knee is acos((a^2 + b^2 - d^2) / 2ab),
    and that between thigh and d acos((a^2 + d^2 - b^2) / 2ad). The height is taken off d.
    """
    height, foot, toes = heel
    names = search.kinematics.body.joint_names
    index = {name: names.index(f"{side}_{name}") for name in ("hip", "knee", "ankle", "foot")}
    joints = search.kinematics.posture(state, 0).joints if joints is None else joints
    hip, knee, ankle = (joints[index[name]] for name in ("hip", "knee", "ankle"))
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
