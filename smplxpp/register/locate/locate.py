"""Find the body in a bare surface and decide how far to trust it: `locate_body`.

The package's docstring describes the search.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Integer, UInt8

from smplxpp.body import BodyModel
from smplxpp.core import SKIN, BodyParams, MeshLike, TriangleMesh, as_mesh
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.register.kinematics import Kinematics
from smplxpp.register.locate.heels import lift_heels
from smplxpp.register.locate.icp import PinnedLandmarks
from smplxpp.register.locate.search import Found, LocateConfig, Search
from smplxpp.register.locate.second_look import look_again

Labeller = Callable[[BodyParams], "Integer[np.ndarray, ' M'] | None"]
"""Labels every face of the surface, given the body in it, negative where unknown; None for no labels at all."""


@dataclass(frozen=True)
class Candidate:
    """A body that was fitted to the surface to the end.

    Attributes:
        pose: name of the pose of its start.
        facing_degrees: direction in which it faces, about +Y from +Z.
        cost: misfit with the cost of the pose, millimetres; lower is better.
        covered: share of the surface that it explains.
        shown: share of its hands, face and feet that the surface shows.
    """

    pose: str
    facing_degrees: float
    cost: float
    covered: float
    shown: float


@dataclass(frozen=True, eq=False)
class LocatedBody:
    """The body that was found in a bare surface.

    Attributes:
        params: one row.
        confidence: from 0 to 1; a result below 0.5 should be inspected.
        notes: sentences about what speaks against it and what to do.
        candidates: all that were fitted to the end, the winner first.
        moved: limbs that were found elsewhere when they were searched again.
    """

    params: BodyParams
    confidence: float
    notes: tuple[str, ...] = ()
    candidates: tuple[Candidate, ...] = field(default=())
    moved: tuple[str, ...] = ()


@dataclass(frozen=True)
class LocateBounds:
    """Bounds by which a located body is refused or loses confidence. They
    trade people that are refused against chairs, boxes and half a person that are taken for one; how both fare is
    measured by `python -m benchmarks scan_alone`.

    Attributes:
        least_covered: smallest share of the surface that a body must explain.
        least_shown: smallest share of hands, face and feet that the surface must show.
        largest_shape: mean square of betas above which no person exists; they have unit variance.
        doubtful_covered: share of the surface below which the confidence falls.
        doubtful_shape: mean square of betas above which the confidence falls.
        margin: difference of cost, millimetres, from which two facings are clearly distinct.
        good_cost: cost that good fits stay below, millimetres.
    """

    least_covered: float = 0.5
    least_shown: float = 0.25
    largest_shape: float = 30.0
    doubtful_covered: float = 0.8
    doubtful_shape: float = 6.0
    margin: float = 4.0
    good_cost: float = 18.0


_BOUNDS = LocateBounds()


def locate_body(
    body: BodyModel,
    mesh: MeshLike,
    *,
    colors: UInt8[np.ndarray, "N 3"] | None = None,
    landmarks: Mapping[str, Float[np.ndarray, " 3"]] | None = None,
    hints: Mapping[str, Float[np.ndarray, " 3"]] | None = None,
    labeller: Labeller | None = None,
    config: LocateConfig | None = None,
    progress: ProgressCallback = ignore_progress,
) -> LocatedBody:
    """Find pose, shape, facing and place of the one person in a surface.

    The candidate that best explains hands, face and feet within joint limits wins. Its margin over the best candidate
    that faces the other way is most of the confidence.

    Args:
        body: the body model.
        mesh: of the whole person, metres, +Y up (`smplxpp.clean.find_scan_frame`), tilted by at most 20 degrees.
        colors: of the vertices.
        landmarks: known positions of points of the body (`smplxpp.register.landmarks`), from a detector or by hand.
        hints: points of the body that a detector sees, under their `coco_*` names. They propose poses of single limbs,
            which are kept only where the surface prefers them.
        labeller: labels the surface once the body is known; the body is then fitted again with what is skin.
        config: options.
        progress: called with the running step and its share done.

    Raises:
        InputError: a surface that is no person or far from a person's size, or landmarks that the body does not have.
    """
    mesh = as_mesh(mesh, subject="mesh")
    config = config or LocateConfig()
    _check(mesh, colors)
    mesh = _outward(mesh)
    pinned = PinnedLandmarks.of(body, landmarks) if landmarks else None
    search = Search(Kinematics(body), mesh, config, pinned, progress)
    # Landmarks pull without limit during the search, and are robust afterwards.
    found = search.candidates()
    if pinned is not None:
        pinned.make_robust()
    # Limbs that the dressed body's surface does not show are searched once more before labels depend on them.
    best, moved = look_again(search, search.finished(found[0]), hints=hints)
    best = lift_heels(search, best)
    refuse_non_persons(best)
    if labeller is not None:
        labels = labeller(best.state.to_params(body))
        if labels is not None:
            best = search.finished(best, np.asarray(labels)[search.fine.face] == SKIN.id)
    others = tuple(found[1:])
    return LocatedBody(
        best.state.to_params(body),
        confidence_of(best, others),
        notes_of(best, others),
        tuple(_candidate(one) for one in (best, *others)),
        moved,
    )


def _candidate(found: Found) -> Candidate:
    x, z = found.facing
    return Candidate(
        found.name, float(np.degrees(np.arctan2(x, z))), found.cost, found.misfit.covered, found.misfit.shown
    )


def _check(mesh: TriangleMesh, colors: np.ndarray | None) -> None:
    if not mesh.face_count or not mesh.face_areas.sum() > 0:
        raise InputError("scan", expected="a surface with faces that have an area", received="none")
    if colors is not None and len(colors) != mesh.vertex_count:
        raise InputError(
            "scan: colours", expected=f"one for each of {mesh.vertex_count} vertices", received=f"{len(colors)}"
        )
    height = float(np.ptp(mesh.vertices[mesh.referenced, 1]))
    if not 0.7 <= height <= 2.8:
        raise InputError(
            "scan: size",
            expected="a whole person, 0.7 to 2.8 m high, +Y up",
            received=f"{height:.3g} m from the lowest to the highest point",
            remedy="state units and upward axis (--units, --up), and remove stray geometry far from the person",
        )


def _outward(mesh: TriangleMesh) -> TriangleMesh:
    """Return the surface with outward faces, decided by the sign of the volume that it encloses."""
    volume = np.einsum("ij,ij->", mesh.face_centers - mesh.face_centers.mean(axis=0), mesh.face_cross)
    return mesh if volume >= 0 else TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])


def refuse_non_persons(found: Found) -> None:
    """Refuse a surface with which the body has too little in common.

    Raises:
        InputError: no person, or less than a whole one.
    """
    fit = found.misfit
    if fit.covered < _BOUNDS.least_covered or fit.shown < _BOUNDS.least_shown or _shape(found) > _BOUNDS.largest_shape:
        raise InputError(
            "scan",
            expected="one whole person, standing about upright",
            received=f"a surface of which a body explains {fit.covered:.0%}, with {fit.shown:.0%} of its hands, face "
            f"and feet{', and a body unlike any person' if _shape(found) > _BOUNDS.doubtful_shape else ''}",
            remedy="cut away everything but the person, check --up and --units, or place landmarks by hand",
        )


def confidence_of(best: Found, others: Sequence[Found]) -> float:
    """Return the confidence of the best candidate, from 0 to 1, as a product of five factors.

    A logistic function of its margin over the other facing (1/2 at half of the margin that is clearly distinct), one of
    its cost against the surface alone, the share of the surface that it explains, 0.2 for an unlikely shape, and 0.4
    for missing parts.
    """
    rival = [one.cost - best.cost for one in others if one.facing @ best.facing < 0]
    apart = min(rival) if rival else _BOUNDS.margin
    distinct = 1.0 / (1.0 + np.exp(-(apart - _BOUNDS.margin / 2) / (_BOUNDS.margin / 4)))
    good = 1.0 / (1.0 + np.exp((best.surface_cost - _BOUNDS.good_cost) / 1.5))
    whole = np.clip(
        (best.misfit.covered - _BOUNDS.least_covered) / (_BOUNDS.doubtful_covered - _BOUNDS.least_covered), 0.0, 1.0
    )
    likely = 1.0 if _shape(best) <= _BOUNDS.doubtful_shape else 0.2
    return float(distinct * good * whole * likely * (0.4 if missing_parts(best) else 1.0))


def missing_parts(found: Found) -> list[str]:
    """Return the parts of the body of which the surface shows less than 0.4, or 0.3 of the head (hair hides it).

    Skirts hide lower legs, which are therefore never missing.
    """
    least = {"head": 0.3, "left lower leg": 0.0, "right lower leg": 0.0}
    return [part for part, share in found.misfit.parts.items() if share < least.get(part, 0.4)]


def notes_of(best: Found, others: Sequence[Found]) -> tuple[str, ...]:
    """Return sentences about what a user should inspect and how to correct it."""
    out = []
    rival = [one for one in others if one.facing @ best.facing < 0]
    if rival and min(one.cost for one in rival) - best.cost < _BOUNDS.margin:
        out.append(
            "the person may face the other way: both facings fit about equally well; place the landmarks nose, "
            "left_wrist and right_wrist by hand (`smplxpp label`)"
        )
    if best.misfit.covered < _BOUNDS.doubtful_covered:
        out.append(
            f"a body explains only {best.misfit.covered:.0%} of the surface; if it shows something besides one person, "
            "cut that away"
        )
    missing = missing_parts(best)
    if missing:
        out.append(
            f"not found in the scan: {', '.join(missing)}. If it is cut off or hidden, its place is a guess; if it is "
            "there, place a landmark on it (`smplxpp label`)"
        )
    if _shape(best) > _BOUNDS.doubtful_shape:
        out.append("the body that fits is unlike people: check --units and --up, and that the scan is whole")
    return tuple(out)


def _shape(found: Found) -> float:
    """Return the mean square of a candidate's betas."""
    betas = found.state.betas
    return float((betas**2).mean()) if len(betas) else 0.0
