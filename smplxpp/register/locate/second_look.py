"""Search again for limbs that the surface does not show where the fitted body has them.

The first search compares whole bodies at few points without a model of clothes, so that an arm may end on the belly, or
a leg on the other leg. The dressed fit shows which surface the rest of the body explains. An unexplained limb is then
compared with the remaining surface: in the poses of a finer grid and, where a detector found its joints, in the pose
that reaches them. The nearest few are refined by ICP of the limb alone and then as whole dressed bodies, and the one
of least cost is kept, which may be the first.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from itertools import product

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.core.surface_points import SurfacePoints, position_normal_features
from smplxpp.register.kinematics import BodyState
from smplxpp.register.locate.icp import IcpTerm, PinnedLandmarks, Term, gauss_newton_step
from smplxpp.register.locate.limbs import MIRROR, LimbPose, try_hand
from smplxpp.register.locate.proxy import BodyProxy, Region
from smplxpp.register.locate.search import Found, Search
from smplxpp.register.normal_equations import Columns
from smplxpp.register.observations import RegisterConfig
from smplxpp.register.priors import Priors
from smplxpp.register.start import Start

_JOINTS = {"arm": ("shoulder", "elbow", "wrist"), "leg": ("hip", "knee", "ankle")}
# Parts of a limb, and the share below which the surface does not show them well. Fists and shoes show .4 to .8 of hands
# and feet; skirts hide lower legs, and so .2 of them are enough.
_PARTS = {"arm": {"hand": 0.5, "forearm": 0.5}, "leg": {"foot": 0.5, "lower leg": 0.2}}
# Share of the surface without explanation from which an arm may lie there, although the present one fits.
_UNEXPLAINED = 0.06
_CAP = 0.10
"""Metres, at which distances of a limb saturate: half a limb's length off is as wrong as a whole one."""
_REACH = {"arm": 0.95, "leg": 1.15}
"""Metres from shoulder or hip within which a limb's surface lies."""
_MOVED = 0.05
"""Metres from which a limb counts as found elsewhere; less is the refinement of its pose."""
_HINT_OFF = 0.10
"""Metres from which a limb's joints and a detector's keypoints differ; keypoints are centimetres off themselves."""


@dataclass(frozen=True, eq=False)
class _Limb:
    """A limb of a fitted body, the surface that the rest of the body leaves, and how both are compared.

    Attributes:
        name: "left arm" and the like.
        joints: indices of its joints, from the root outwards.
        proxy: points of the limb.
        surface: points of the scan that the limb may explain.
        rest: their distances to the rest of the body, metres, at most `_CAP`.
        size: share of the body's points that are the limb's.
        share: share of the scan's points that one point of `surface` stands for.
    """

    name: str
    joints: list[int]
    proxy: BodyProxy
    surface: SurfacePoints
    rest: Float64[np.ndarray, " N"]
    size: float
    share: float

    def thinned(self, every: int) -> _Limb:
        """Return the limb with each n-th of its points and of the surface's, to compare many poses."""
        rows = np.arange(0, len(self.rest), every)
        proxy = self.proxy.select(np.arange(0, len(self.proxy.limb), every))
        return replace(
            self, proxy=proxy, surface=self.surface.select(rows), rest=self.rest[rows], share=every * self.share
        )

    def score(self, search: Search, state: BodyState) -> float:
        """Return the mean distance of the limb and of the surface in its reach, as shares of body and scan, metres."""
        posed = position_normal_features(*self.proxy.posed(search.kinematics, search.kinematics.posture(state, 0)))
        one, _ = search.fine.tree.query(posed, distance_upper_bound=_CAP)
        left, _ = cKDTree(posed).query(self.surface.tree.data, distance_upper_bound=_CAP)
        both = np.minimum(np.minimum(left, self.rest), _CAP)
        return float(self.size * np.minimum(one, _CAP).mean() + self.share * both.sum())


def look_again(
    search: Search,
    found: Found,
    *,
    skin: np.ndarray | None = None,
    hints: Mapping[str, Float[np.ndarray, " 3"]] | None = None,
) -> tuple[Found, tuple[str, ...]]:
    """Search the doubtful limbs of a finished body again; return the best body, and the limbs that moved.

    Args:
        search: the search that found it.
        found: the body, finished.
        skin: whether a point of `search.fine` is bare skin; None if unknown.
        hints: where a detector sees joints, metres; they propose poses, which the surface has to prefer.
    """
    moved = []
    for name in doubtful_limbs(search, found, hints):
        limb = _limb(search, found.state, name)
        better = _searched(search, found, limb, skin, hints)
        if better is not found:
            if _travelled(search, found, better, limb) > _MOVED:
                moved.append(name)
            found = better
    return found, tuple(moved)


def raise_head(search: Search, found: Found, *, skin: np.ndarray | None = None) -> Found:
    """Return the body with neck and head bent otherwise, where the surface shows no face and that costs less.

    A head that starts too low ends with its forehead in the face and its chin in a collar, from where no small step
    leads out: both are round.

    Args:
        search: the search that found it.
        found: the body, finished.
        skin: whether a point of `search.fine` is bare skin; None if unknown.
    """
    match = search.outer.match(search.outer.mesh(search.kinematics.posture(found.state, 0)), search.fine)
    face = match.distance[match.region == Region.FACE]
    off = len(face) >= 20 and float(np.percentile(np.abs(face), 75)) > _NO_FACE
    if not off and found.misfit.parts["head"] > _NO_HEAD:
        return found
    names = list(search.kinematics.body.joint_names)
    joints, best = [names.index("neck"), names.index("head")], found
    for bends in product((-0.5, -0.25, 0.25), (-0.4, 0.0, 0.4)):
        rotations = found.state.rotations.copy()
        for joint, bend in zip(joints, bends, strict=True):
            rotations[0, joint] = rotations[0, joint] @ matrix_from_rotvec(np.array([bend, 0.0, 0.0]))
        other = search.polished(found.name, replace(found.state, rotations=rotations), skin, steps=5)
        if other.cost < best.cost - 0.05:
            best = other
    return best


_NO_FACE, _NO_HEAD = 0.012, 0.4
"""Metres that a quarter of a face's surface lies off the body's from which it is no face (of 15 real people a head in a
collar has 23 mm, the others at most 7), and the share of a head that is shown up to which it is none (hoods: 0.58)."""


def _travelled(search: Search, one: Found, other: Found, limb: _Limb) -> float:
    """Return how far the joints of a limb are apart in two bodies, metres; the farthest counts."""
    before, after = (search.kinematics.posture(found.state, 0).joints[limb.joints] for found in (one, other))
    return float(np.linalg.norm(after - before, axis=1).max())


def doubtful_limbs(
    search: Search, found: Found, hints: Mapping[str, Float[np.ndarray, " 3"]] | None = None
) -> list[str]:
    """Return the limbs that the surface does not show, that a detector sees elsewhere, or that may lie where the
    surface has no explanation; those that show least come first."""
    posture = search.kinematics.posture(found.state, 0)
    place = {name: k for k, name in enumerate(search.kinematics.body.joint_names)}
    shown: dict[str, float] = {}
    for side, kind in product(("left", "right"), _JOINTS):
        shares = {part: found.misfit.parts[f"{side} {part}"] for part in _PARTS[kind]}
        off = [
            float(np.linalg.norm(posture.joints[place[joint]] - point))
            for joint, point in _hints_of(side, kind, hints).items()
        ]
        hidden = any(share < _PARTS[kind][part] for part, share in shares.items())
        strays = kind == "arm" and found.misfit.covered < 1.0 - _UNEXPLAINED
        if hidden or strays or max(off, default=0.0) > _HINT_OFF:
            shown[f"{side} {kind}"] = min(shares.values())
    return sorted(shown, key=shown.__getitem__)


def _hints_of(
    side: str, kind: str, hints: Mapping[str, Float[np.ndarray, " 3"]] | None
) -> dict[str, Float[np.ndarray, " 3"]]:
    """Return a detector's points for the joints of a limb except its root, under the body's names."""
    seen = {} if hints is None else hints
    names = {f"{side}_{joint}": f"coco_{side}_{joint}" for joint in _JOINTS[kind][1:]}
    return {joint: np.asarray(seen[name]) for joint, name in names.items() if name in seen}


def _limb(search: Search, state: BodyState, name: str) -> _Limb:
    """Gather the points of a limb, and those of the surface in its reach with their distances to the rest."""
    kinematics, many, fine = search.kinematics, search.many, search.fine
    side, kind = name.split()
    names = list(kinematics.body.joint_names)
    joints = [names.index(f"{side}_{joint}") for joint in _JOINTS[kind]]
    own = kinematics.descends_from[many.limb, joints[0]]
    posture = kinematics.posture(state, 0)
    # At most about 300 points of the limb and 400 of the surface, so that a pose is compared in a millisecond or two.
    rows = np.flatnonzero(own)
    rest = cKDTree(position_normal_features(*many.select(np.flatnonzero(~own)).posed(kinematics, posture)))
    explained, _ = rest.query(fine.tree.data, distance_upper_bound=_CAP)
    near = np.linalg.norm(fine.points - posture.joints[joints[0]], axis=1) < _REACH[kind]
    # Surface that the rest explains to 3 cm needs no limb.
    open_rows = np.flatnonzero(near & (explained > 0.03))
    every = max(1, len(open_rows) // 400)
    kept = open_rows[::every] if len(open_rows) else np.flatnonzero(near)[:1]
    return _Limb(
        name,
        joints,
        many.select(rows[:: max(1, len(rows) // 300)]),
        fine.select(kept),
        np.minimum(explained[kept], _CAP),
        float(own.mean()),
        every / len(fine),
    )


def _searched(
    search: Search,
    found: Found,
    limb: _Limb,
    skin: np.ndarray | None,
    hints: Mapping[str, Float[np.ndarray, " 3"]] | None,
) -> Found:
    """Return the body of least cost with this limb as it is or in another pose."""
    side, kind = limb.name.split()
    # 1. The grid, and the pose that leads to the detector's keypoints from the nearest of its poses.
    tried, thin = list(_grid(found.state, limb)), limb.thinned(3)
    seen = _hints_of(side, kind, hints)
    proposals = _apart(search, limb, sorted(tried, key=lambda one: thin.score(search, one)), count=3)
    if seen:
        proposals.append(_led(search, limb, tried, seen))
    # 2. ICP of the limb alone, from where it is and from there; only what is nearer is worth a whole fit.
    now = limb.score(search, found.state)
    ends = [_refined(search, limb, one) for one in (found.state, *proposals)]
    scores = [limb.score(search, one) for one in ends]
    order = [k for k in np.argsort(scores) if scores[k] < now - _worth(limb)][:2]
    # 3. The best two are fitted as dressed bodies, with their hand in the place of an arm.
    best = found
    for k in order:
        state = ends[k]
        if kind == "arm":
            state = try_hand(search.kinematics, search.many, search.fine, state, side)
        other = search.polished(found.name, state, skin, steps=6)
        if other.cost < best.cost - 0.05:
            best = other
    return best


def _worth(limb: _Limb) -> float:
    """Return how much nearer a pose has to be, metres: three millimetres of the mean distance of the limb's own points.

    Less is a refinement, for which a fit of the whole body is too expensive.
    """
    return 0.003 * limb.size


def _grid(state: BodyState, limb: _Limb) -> Iterator[BodyState]:
    """Yield the body with its limb in every pose of the grid; fingers stay as they are."""
    for pose in _poses(*limb.name.split()):
        rotations = state.rotations.copy()
        rotations[0, limb.joints] = pose
        yield replace(state, rotations=rotations)


@cache
def _poses(side: str, kind: str) -> list[Float64[np.ndarray, "3 3 3"]]:
    """Return the rotations of the three joints of a limb in all poses of its grid."""
    mirror, out = np.ones(3) if side == "left" else MIRROR, []
    for pose in _arms() if kind == "arm" else _legs():
        rotations = np.tile(np.eye(3), (3, 1, 1))
        for k, rotvecs in enumerate(pose):
            for vector in rotvecs:
                rotations[k] = rotations[k] @ matrix_from_rotvec(np.radians(vector * mirror))
        out.append(rotations)
    return out


def _arms() -> Iterator[LimbPose]:
    """Yield arm poses: lowered from the T-pose, taken forwards, twisted, bent at the elbow; degrees."""
    for lowered, forwards, twisted, bent in product(
        (-85, -62, -38, -12, 20, 55, 85), (20, -15, -50, -85, -115), (-30, 20, 70), (-6, -45, -85, -125)
    ):
        if twisted != 20 and bent > -30:
            continue  # twisting a straight arm changes nothing
        shoulder = [np.array([0.0, forwards, 0.0]), np.array([0.0, 0.0, lowered]), np.array([twisted, 0.0, 0.0])]
        yield shoulder, [np.array([0.0, bent, 0.0])]


def _legs() -> Iterator[LimbPose]:
    """Yield leg poses: lifted forwards at the hip, spread, bent at the knee; degrees."""
    for lifted, spread, knee in product((30, 8, -15, -40, -70, -100), (-12, 4, 25), (4, 40, 80, 125)):
        yield [np.array([lifted, 0.0, 0.0]), np.array([0.0, 0.0, spread])], [np.array([knee, 0.0, 0.0])]


def _apart(search: Search, limb: _Limb, ranked: list[BodyState], *, count: int) -> list[BodyState]:
    """Return the first poses whose elbow and wrist (knee and ankle) differ by 10 cm on average."""
    least, kept, places = 0.10, list[BodyState](), list[np.ndarray]()
    for state in ranked:
        place = search.kinematics.posture(state, 0).joints[limb.joints[1:]]
        if all(np.linalg.norm(place - other, axis=1).mean() > least for other in places):
            kept.append(state)
            places.append(place)
        if len(kept) == count:
            break
    return kept


def _led(search: Search, limb: _Limb, tried: list[BodyState], seen: Mapping[str, Float[np.ndarray, " 3"]]) -> BodyState:
    """Return the limb in the pose that leads to a detector's keypoints: the nearest of the grid, then least squares."""
    pinned = PinnedLandmarks.of(search.kinematics.body, seen)

    def off(state: BodyState) -> float:
        return pinned.distance(search.kinematics, search.kinematics.posture(state, 0))

    state = min(tried, key=off)
    return _steps(search, limb, state, pinned, [np.inf] * 6)


def _refined(search: Search, limb: _Limb, state: BodyState) -> BodyState:
    """Refine the limb by eight ICP steps whose reach falls from 12 to 3 cm; the rest of the body is held in place."""
    term = IcpTerm(limb.proxy, limb.surface, sigma=0.010, count=150.0)
    return _steps(search, limb, state, term, np.geomspace(0.12, 0.03, 8).tolist())


def _steps(search: Search, limb: _Limb, state: BodyState, term: Term, reaches: list[float]) -> BodyState:
    """Take a Gauss-Newton step of the limb's joints on a term for each reach."""
    body = search.kinematics.body
    columns = Columns(np.array(limb.joints), body.joint_count, 0, body.num_expressions, body.num_betas)
    # A tight prior on translation (0.1 mm) and shape (0.001) holds the body.
    start = Start(state, np.inf, 1e-4, 1e-3)
    priors = Priors(columns, np.zeros(1, np.int64), search.anatomy, RegisterConfig(), start=start)
    for reach in reaches:
        if isinstance(term, IcpTerm):
            term.reach = reach
        state = gauss_newton_step(search.kinematics, columns, state, [term], priors)
    return state
