"""Search for the body in a surface: poses and directions first, then limbs, then the body within its clothes."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from smplxpp.core import ProgressCallback, TriangleMesh, require_at_least, rotvec_from_matrix
from smplxpp.core.surface_points import SurfacePoints
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.locate.dressed import Dressed, Misfit, OuterBody, misfit
from smplxpp.register.locate.icp import IcpTerm, PinnedLandmarks, Term, gauss_newton_step
from smplxpp.register.locate.limbs import state_distance, try_hands, try_limbs
from smplxpp.register.locate.proxy import BodyProxy, Region
from smplxpp.register.locate.starts import Poses, centred, rank_starts
from smplxpp.register.normal_equations import Columns
from smplxpp.register.observations import RegisterConfig
from smplxpp.register.priors import Anatomy, Priors

# Joints of the SMPL body without hands and face; they come first.
_BODY_JOINTS = 22
# Largest increase of cost during a fit, millimetres; known bare skin raises the weights.
_DIVERGED = 3.0
_Ranked = tuple[float, str, BodyState]
"""Distance to the surface, metres; name of the pose of the start; the body."""


@dataclass(frozen=True)
class LocateConfig:
    """Options of the search for a body in a bare surface.

    Attributes:
        directions: number of directions that the person may face at the start, evenly about the vertical axis.
        starts: number of starts (pose and direction) that ICP refines.
        limbs_tried: number of the best of these whose arms and legs are searched on a grid.
        candidates: number of the best of these that are fitted as dressed bodies.
        coarse_points: points drawn from the surface for the search.
        fine_points: points drawn from the surface for the fit.
        dress_steps: Gauss-Newton steps of every candidate's fit.
        finish_steps: Gauss-Newton steps of the winner's fit.
        pose_prior: weight of the pose prior during the winner's fit; above 1 because clothes hide joints more than the
            number of surface points suggests.
        seed: of the drawn points.
    """

    directions: int = 12
    starts: int = 24
    limbs_tried: int = 8
    candidates: int = 3
    coarse_points: int = 600
    fine_points: int = 6000
    dress_steps: int = 8
    finish_steps: int = 12
    pose_prior: float = 3.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("directions", "starts", "limbs_tried", "candidates", "dress_steps", "finish_steps"):
            require_at_least(f"search for a body: {name}", getattr(self, name), 1)
        for name in ("coarse_points", "fine_points"):
            require_at_least(f"search for a body: {name}", getattr(self, name), 100)
        for name in ("pose_prior", "seed"):
            require_at_least(f"search for a body: {name}", getattr(self, name), 0)


@dataclass(frozen=True, eq=False)
class Found:
    """A fitted candidate of the search.

    Attributes:
        name: of the pose of its start.
        state: the body, one frame.
        misfit: between body and surface.
        pose_cost: sum of squared rotation vectors in standard deviations of the pose prior.
        landmarks: mean distance of the given landmarks, metres; 0 without any.
    """

    name: str
    state: BodyState
    misfit: Misfit
    pose_cost: float
    landmarks: float

    @property
    def cost(self) -> float:
        """The cost against the surface and the distance of the landmarks, in millimetres: what ranks candidates."""
        return self.surface_cost + 1e3 * self.landmarks

    @property
    def surface_cost(self) -> float:
        """The misfit with the cost of the pose, in millimetres; a squared deviation of the pose costs 0.05 mm.

        Landmarks do not count: a hand is centimetres off, which says nothing against the surface.
        """
        return 1e3 * self.misfit.total + 0.05 * self.pose_cost

    @property
    def facing(self) -> Float64[np.ndarray, " 2"]:
        """The direction in which the pelvis faces, x and z."""
        return facing_of(self.state)


class Search:
    """A search for the body in one surface, with samples of both at several densities.

    Args:
        kinematics: of the body.
        mesh: the surface, metres, +Y up, faces outwards.
        config: options.
        pinned: landmarks of known position; None without any.
        progress: called with the running step and its share done.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        mesh: TriangleMesh,
        config: LocateConfig,
        pinned: PinnedLandmarks | None,
        progress: ProgressCallback,
    ) -> None:
        body = kinematics.body
        self.kinematics, self.config, self.pinned, self.progress = kinematics, config, pinned, progress
        self.outer = OuterBody(kinematics)
        names = list(body.joint_names)
        fingers = [k for k, name in enumerate(names) if k >= _BODY_JOINTS and "eye" not in name and name != "jaw"]
        self.columns = self._columns(list(range(_BODY_JOINTS)))
        self.columns_with_fingers = self._columns(list(range(_BODY_JOINTS)) + fingers)
        self.anatomy = Anatomy.of(body.joint_count)
        self.coarse = SurfacePoints.sample(mesh, config.coarse_points, seed=config.seed)
        self.middle = SurfacePoints.sample(mesh, 2 * config.coarse_points, seed=config.seed + 1)
        self.fine = SurfacePoints.sample(mesh, config.fine_points, seed=config.seed + 2)
        self.few = BodyProxy.of(body, config.coarse_points // 2, seed=config.seed)
        self.more = BodyProxy.of(body, config.coarse_points, seed=config.seed)
        many = BodyProxy.of(body, 4000, seed=config.seed)
        self.many, self.bare = many, many.select(np.flatnonzero(np.isin(many.region, (Region.HAND, Region.FACE))))

    def candidates(self, poses: Poses) -> list[Found]:
        """Return the best candidates of both facings, fitted as dressed bodies, best first.

        Landmarks pull without limit during the search, and are robust afterwards.

        Args:
            poses: to start from.
        """
        if self.pinned is not None:
            self.pinned.cutoff = np.inf
        # 1. Start poses in all directions, refined by ICP whose reach falls from 30 to 15 cm.
        starts = rank_starts(
            self.kinematics, self.few, self.coarse, poses, directions=self.config.directions, keep=self.config.starts
        )
        followed = []
        for k, start in enumerate(starts):
            state = self._icp(
                centred(self.kinematics, self.few, start), self.few, self.coarse, np.geomspace(0.3, 0.15, 6)
            )
            followed.append((self._distance(state), start.name, state))
            self.progress("poses", (k + 1) / len(starts))
        # 2. Arms and legs of the best of both facings are searched on a grid, then refined by ICP from 20 to 8 cm.
        followed.sort(key=lambda one: one[0])
        chosen, tried = _of_both_facings(followed, self.config.limbs_tried), []
        for k, (_, name, state) in enumerate(chosen):
            state = try_limbs(self.kinematics, self.few, self.coarse, state)
            state = self._icp(state, self.few, self.coarse, np.geomspace(0.2, 0.08, 8))
            tried.append((self._distance(state), name, state))
            self.progress("limbs", (k + 1) / len(chosen))
        # 3. The best distinct ones, one of the other facing among them, are fitted as dressed bodies.
        tried.sort(key=lambda one: one[0])
        distinct = self._distinct(tried)
        out = []
        for k, (_, name, state) in enumerate(distinct):
            out.append(self.measured(name, self._dressed(state)))
            self.progress("candidates", (k + 1) / len(distinct))
        if self.pinned is not None:
            self.pinned.make_robust()
        return sorted(out, key=lambda found: found.cost)

    def at_rest(self) -> Found:
        """Return the body at rest in the middle of the surface, as it is before any search."""
        body, center = self.kinematics.body, self.fine.points.mean(axis=0)
        rotations = np.tile(np.eye(3), (1, body.joint_count, 1, 1))
        center = center - body.v_template.mean(axis=0)
        state = BodyState(rotations, center[None], np.zeros(body.num_betas), np.zeros((1, body.num_expressions)))
        return self.measured("rest", state)

    def finished(self, found: Found, skin: np.ndarray | None = None) -> Found:
        """Fit a candidate with its fingers to all points.

        Args:
            found: the candidate.
            skin: whether a point of `fine` is bare skin; None if unknown.
        """
        # Hands from a grid first, then the whole body.
        state = try_hands(self.kinematics, self.many, self.fine, found.state)
        out = self.polished(found.name, state, skin, steps=self.config.finish_steps)
        # A fit that diverges, as through a second person's arms, is worth less than its start.
        return out if out.cost < found.cost + _DIVERGED else found

    def polished(self, name: str, state: BodyState, skin: np.ndarray | None, *, steps: int) -> Found:
        """Fit a state with its fingers to all points; the reach of skin falls from 30 to 15 mm.

        Args:
            name: of the pose of its start.
            state: the body.
            skin: whether a point of `fine` is bare skin; None if unknown.
            steps: number of Gauss-Newton steps.
        """
        skin = np.zeros(len(self.fine), dtype=bool) if skin is None else skin
        term = Dressed(self.outer, self.bare, self.fine, skin)
        for k, reach in enumerate(np.geomspace(0.03, 0.015, steps)):
            term.reach = float(reach)
            state = self._step(state, term, self.config.pose_prior, fingers=True)
            self.progress("fit", (k + 1) / steps)
        return self.measured(name, state)

    def without(self, rows: Bool[np.ndarray, " N"]) -> Search:
        """Return the search in which some of the points of `fine` do not exist, as those of a thing in a hand."""
        rest = copy(self)
        rest.fine = self.fine.select(np.flatnonzero(~rows)) if rows.any() else self.fine
        return rest

    def measured(self, name: str, state: BodyState) -> Found:
        """Return a state as a candidate with its costs."""
        posture = self.kinematics.posture(state, 0)
        found = misfit(self.kinematics, self.outer, self.many, self.fine, posture)
        vectors = rotvec_from_matrix(state.rotations[0, 1:_BODY_JOINTS]) / self.anatomy.spread[1:_BODY_JOINTS]
        off = 0.0 if self.pinned is None else self.pinned.distance(self.kinematics, posture)
        return Found(name, state, found, float((vectors**2).sum()), off)

    def _columns(self, joints: Sequence[int]) -> Columns:
        body = self.kinematics.body
        return Columns(np.array(joints), body.joint_count, 0, body.num_expressions, body.num_betas)

    def _step(self, state: BodyState, term: Term, pose_prior: float = 1.0, *, fingers: bool = False) -> BodyState:
        """Take one Gauss-Newton step on a term, the landmarks and the priors."""
        columns = self.columns_with_fingers if fingers else self.columns
        priors = Priors(columns, np.zeros(1, dtype=np.int64), self.anatomy, RegisterConfig(pose_prior=pose_prior))
        terms = [term] if self.pinned is None else [term, self.pinned]
        return gauss_newton_step(self.kinematics, columns, state, terms, priors)

    def _icp(
        self, state: BodyState, proxy: BodyProxy, surface: SurfacePoints, reaches: np.ndarray, **options: float
    ) -> BodyState:
        """Take one ICP step for each reach."""
        term = IcpTerm(proxy, surface, **options)
        for reach in reaches:
            term.reach = float(reach)
            state = self._step(state, term)
        return state

    def _dressed(self, state: BodyState) -> BodyState:
        """Fit the dressed body to half of the points, after ICP from 10 to 4 cm at a higher density."""
        state = self._icp(state, self.more, self.middle, np.geomspace(0.1, 0.04, 6), sigma=0.015, count=600.0)
        half = self.fine.select(np.arange(0, len(self.fine), 2))
        term = Dressed(self.outer, self.bare, half, np.zeros(len(half), dtype=bool))
        for reach in np.geomspace(0.04, 0.02, self.config.dress_steps):
            term.reach = float(reach)
            state = self._step(state, term)
        return state

    def _distance(self, state: BodyState) -> float:
        """Return the mean distance between body and surface, with that of the landmarks, metres."""
        off = 0.0
        if self.pinned is not None:
            off = self.pinned.distance(self.kinematics, self.kinematics.posture(state, 0))
        return state_distance(self.kinematics, self.few, self.coarse, state) + off

    def _distinct(self, tried: list[_Ranked]) -> list[_Ranked]:
        """Return the best, the best of the other facing, and the next ones whose limbs differ by 6 cm on average."""
        names = self.kinematics.body.joint_names
        index = [k for k, name in enumerate(names) if name.split("_")[-1] in ("wrist", "ankle", "elbow", "knee")]

        def limbs(state: BodyState) -> np.ndarray:
            return self.kinematics.posture(state, 0).joints[index]

        first = facing_of(tried[0][2])
        other = [one for one in tried if facing_of(one[2]) @ first < 0]
        chosen = [tried[0], *other[:1]]
        for one in tried[1:]:
            if len(chosen) >= max(2, self.config.candidates):
                break
            near = [np.linalg.norm(limbs(one[2]) - limbs(kept[2]), axis=1).mean() < 0.06 for kept in chosen]
            if not any(near):
                chosen.append(one)
        return chosen[: max(1, self.config.candidates)]


def facing_of(state: BodyState) -> Float64[np.ndarray, " 2"]:
    """Return the direction in which the pelvis of a state faces, x and z."""
    return state.rotations[0, 0][[0, 2], 2]


def _of_both_facings(followed: list[_Ranked], count: int) -> list[_Ranked]:
    """Return the best of the facing of the first, and as many of the other facing."""
    first = facing_of(followed[0][2])
    same = [one for one in followed if facing_of(one[2]) @ first >= 0]
    other = [one for one in followed if facing_of(one[2]) @ first < 0]
    return same[: count - count // 2] + other[: count // 2]
