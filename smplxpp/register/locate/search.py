"""The search: poses and directions first, then limbs, then the body within its clothes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from smplxpp.core.errors import ProgressCallback
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.rotations import rotvec_from_matrix
from smplxpp.core.surface_points import SurfacePoints
from smplxpp.register.anatomy import Anatomy
from smplxpp.register.config import RegisterConfig
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.locate.config import LocateConfig
from smplxpp.register.locate.descend import DrawnTogether, Term, descend
from smplxpp.register.locate.dressed import Dressed, OuterBody
from smplxpp.register.locate.hands import try_hands
from smplxpp.register.locate.limbs import state_distance, try_limbs
from smplxpp.register.locate.misfit import Misfit, misfit
from smplxpp.register.locate.pinned import Pinned
from smplxpp.register.locate.proxy import BodyProxy, Region
from smplxpp.register.locate.starts import centred, rank_starts
from smplxpp.register.normal_equations import Columns
from smplxpp.register.priors import Priors

# How far surface and body attract each other, metres, step by step.
_FIRST, _AFTER_LIMBS = np.geomspace(0.3, 0.15, 6), np.geomspace(0.2, 0.08, 8)
_NEARER, _DRESSING = np.geomspace(0.1, 0.04, 6), (0.04, 0.02)
# Millimetres that a squared deviation of the pose from the prior counts as.
_POSE_COST = 0.05
_LIMBS = ("wrist", "ankle", "elbow", "knee")
# Two candidates whose limbs are within this of each other on average are one, metres.
_SAME = 0.06


@dataclass(frozen=True, eq=False)
class Found:
    """One candidate.

    Attributes:
        name: of the pose that it began with. misfit: between body and surface. pose_cost: squared deviations.
        landmarks: mean distance of given landmarks, metres.
    """

    name: str
    state: BodyState
    misfit: Misfit
    pose_cost: float
    landmarks: float

    @property
    def cost(self) -> float:
        """About millimetres."""
        return 1e3 * (self.misfit.total + self.landmarks) + _POSE_COST * self.pose_cost

    @property
    def facing(self) -> Float64[np.ndarray, " 2"]:
        """Where the pelvis faces: x and z of its front."""
        return facing_of(self.state)


class Search:
    """A search in one surface.

    Args:
        mesh: metres, +Y up, outward. pinned: landmarks, None without.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        mesh: TriangleMesh,
        config: LocateConfig,
        pinned: Pinned | None,
        progress: ProgressCallback,
    ) -> None:
        body = kinematics.body
        self.kinematics, self.config, self.pinned, self.progress = kinematics, config, pinned, progress
        self.outer = OuterBody(kinematics)
        names = list(body.joint_names)
        fingers = [k for k, name in enumerate(names) if k > 21 and "eye" not in name and name != "jaw"]
        self.columns = self._columns(list(range(22)))
        self.columns_with_fingers = self._columns(list(range(22)) + fingers)
        self.anatomy = Anatomy.of(body.joint_count)
        self.coarse = SurfacePoints.sample(mesh, config.coarse_points, seed=config.seed)
        self.middle = SurfacePoints.sample(mesh, 2 * config.coarse_points, seed=config.seed + 1)
        self.fine = SurfacePoints.sample(mesh, config.fine_points, seed=config.seed + 2)
        self.few = BodyProxy.of(body, config.coarse_points // 2, seed=config.seed)
        self.more = BodyProxy.of(body, config.coarse_points, seed=config.seed)
        many = BodyProxy.of(body, 4000, seed=config.seed)
        self.many, self.bare = many, many.select(np.flatnonzero(np.isin(many.region, (Region.HAND, Region.FACE))))

    def candidates(self) -> list[Found]:
        """The best candidates of both facings, dressed, best first."""
        starts = rank_starts(
            self.kinematics, self.few, self.coarse, directions=self.config.directions, keep=self.config.starts
        )
        followed = []
        for k, start in enumerate(starts):
            state = self._drawn(centred(self.kinematics, self.few, start), self.few, self.coarse, _FIRST)
            followed.append((self._distance(state), start.name, state))
            self.progress("poses", (k + 1) / len(starts))
        followed.sort(key=lambda one: one[0])
        chosen, tried = _of_both_facings(followed, self.config.limbs_tried), []
        for k, (_, name, state) in enumerate(chosen):
            state = try_limbs(self.kinematics, self.few, self.coarse, state)
            state = self._drawn(state, self.few, self.coarse, _AFTER_LIMBS)
            tried.append((self._distance(state), name, state))
            self.progress("limbs", (k + 1) / len(chosen))
        tried.sort(key=lambda one: one[0])
        distinct = self._distinct(tried)
        out = []
        for k, (_, name, state) in enumerate(distinct):
            out.append(self._measured(name, self._dressed(state)))
            self.progress("candidates", (k + 1) / len(distinct))
        return sorted(out, key=lambda found: found.cost)

    def finished(self, found: Found, skin: np.ndarray | None = None) -> Found:
        """A candidate with its fingers, among all points.

        Args:
            skin: which of the points of `fine` are bare, None: not known.
        """
        skin = np.zeros(len(self.fine), dtype=bool) if skin is None else skin
        term = Dressed(self.outer, self.bare, self.fine, skin)
        state, steps = try_hands(self.kinematics, self.many, self.fine, found.state), self.config.finish_steps
        for k, reach in enumerate(np.geomspace(0.03, 0.015, steps)):
            term.reach = float(reach)
            state = self._step(state, term, self.config.pose_prior, fingers=True)
            self.progress("fit", (k + 1) / steps)
        return self._measured(found.name, state)

    def _columns(self, joints: Sequence[int]) -> Columns:
        body = self.kinematics.body
        return Columns(np.array(joints), body.joint_count, 0, body.num_expressions, body.num_betas)

    def _step(self, state: BodyState, term: Term, pose_prior: float = 1.0, *, fingers: bool = False) -> BodyState:
        columns = self.columns_with_fingers if fingers else self.columns
        priors = Priors(columns, np.zeros(1, dtype=np.int64), self.anatomy, RegisterConfig(pose_prior=pose_prior))
        terms = [term] if self.pinned is None else [term, self.pinned]
        return descend(self.kinematics, columns, state, terms, priors)

    def _drawn(
        self, state: BodyState, proxy: BodyProxy, surface: SurfacePoints, reaches: np.ndarray, **options: float
    ) -> BodyState:
        term = DrawnTogether(proxy, surface, **options)
        for reach in reaches:
            term.reach = float(reach)
            state = self._step(state, term)
        return state

    def _dressed(self, state: BodyState) -> BodyState:
        state = self._drawn(state, self.more, self.middle, _NEARER, sigma=0.015, count=600.0)
        half = self.fine.select(np.arange(0, len(self.fine), 2))
        term = Dressed(self.outer, self.bare, half, np.zeros(len(half), dtype=bool))
        for reach in np.geomspace(*_DRESSING, self.config.dress_steps):
            term.reach = float(reach)
            state = self._step(state, term)
        return state

    def _measured(self, name: str, state: BodyState) -> Found:
        posture = self.kinematics.posture(state, 0)
        found = misfit(self.kinematics, self.outer, self.many, self.fine, posture)
        vectors = rotvec_from_matrix(state.rotations[0, 1:22]) / self.anatomy.spread[1:22]
        off = 0.0 if self.pinned is None else self.pinned.distance(self.kinematics, posture)
        return Found(name, state, found, float((vectors**2).sum()), off)

    def _distance(self, state: BodyState) -> float:
        off = 0.0
        if self.pinned is not None:
            off = self.pinned.distance(self.kinematics, self.kinematics.posture(state, 0))
        return state_distance(self.kinematics, self.few, self.coarse, state) + off

    def _distinct(self, tried: list[tuple[float, str, BodyState]]) -> list[tuple[float, str, BodyState]]:
        """The best, the best that faces the other way, and the next ones that stand otherwise."""
        names = self.kinematics.body.joint_names
        index = [k for k, name in enumerate(names) if name.split("_")[-1] in _LIMBS]

        def limbs(state: BodyState) -> np.ndarray:
            return self.kinematics.posture(state, 0).joints[index]

        first = facing_of(tried[0][2])
        other = [one for one in tried if facing_of(one[2]) @ first < 0]
        chosen = [tried[0], *other[:1]]
        for one in tried[1:]:
            if len(chosen) >= max(2, self.config.candidates):
                break
            near = [np.linalg.norm(limbs(one[2]) - limbs(kept[2]), axis=1).mean() < _SAME for kept in chosen]
            if not any(near):
                chosen.append(one)
        return chosen[: max(1, self.config.candidates)]


def facing_of(state: BodyState) -> Float64[np.ndarray, " 2"]:
    """x and z of the pelvis' front."""
    return state.rotations[0, 0][[0, 2], 2]


def _of_both_facings(followed: list[tuple[float, str, BodyState]], count: int) -> list[tuple[float, str, BodyState]]:
    """The best that face as the best one does, and as many that face the other way."""
    first = facing_of(followed[0][2])
    same = [one for one in followed if facing_of(one[2]) @ first >= 0]
    other = [one for one in followed if facing_of(one[2]) @ first < 0]
    return same[: count - count // 2] + other[: count // 2]
