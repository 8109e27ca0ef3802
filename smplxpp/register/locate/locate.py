"""Find the body in a bare surface and decide how far to trust it: `locate_body`.

The package's docstring describes the search.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Integer, UInt8

from smplxpp.body import BodyModel
from smplxpp.body.named_poses import low_poses, rare_poses, standing_poses
from smplxpp.core import HAIR, OBJECT, SKIN, BodyParams, MeshLike, TriangleMesh, as_mesh
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.register.kinematics import Kinematics
from smplxpp.register.locate.decision import confidence_of, findings_of, is_doubtful, no_person, notes_of
from smplxpp.register.locate.heels import lift_heels, settle_feet
from smplxpp.register.locate.icp import PinnedLandmarks
from smplxpp.register.locate.persons import convex_share
from smplxpp.register.locate.search import Found, LocateConfig, Search
from smplxpp.register.locate.second_look import look_again, raise_head


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
        notes: sentences about evidence against it, with remedies.
        candidates: all that were fitted to the end, the winner first.
        moved: limbs that were found elsewhere when they were searched again.
        findings: what the surface shows that is not one whole person, in words.
    """

    params: BodyParams
    confidence: float
    notes: tuple[str, ...] = ()
    candidates: tuple[Candidate, ...] = field(default=())
    moved: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()


class BodyNotFoundError(InputError):
    """A scan in which no body was found, or none with enough confidence to build on.

    Attributes:
        confidence: of the best body that was found, from 0 to 1.
        params: that body, one row.
        findings: what the scan shows that is not one whole person, in words.
        picture: the scan, and the body within it from front and side; None where nothing was drawn.

    Example:
        >>> try:
        ...     smplxpp.build_template("two_people.obj")
        ... except smplxpp.BodyNotFoundError as error:  # doctest: +SKIP
        ...     print(error.confidence, error.findings)
    """

    def __init__(
        self,
        located: LocatedBody,
        *,
        received: str,
        remedy: str,
        picture: UInt8[np.ndarray, "H W 3"] | None = None,
    ) -> None:
        super().__init__("scan", expected="one whole person, standing about upright", received=received, remedy=remedy)
        self.confidence, self.params, self.findings = located.confidence, located.params, located.findings
        self.located, self.picture = located, picture


Labeller = Callable[[BodyParams], "Integer[np.ndarray, ' M'] | None"]
"""Labels every face of the surface, given the body in it, negative where unknown; None for no labels at all."""
_RARER = 0.5
"""Margin in millimetres that a body in a rare pose needs to win: such poses also bend into what is no person."""

_MOST_CONVEX = 0.9
"""Share of a surface on its convex hull from which it is no person; people have at most 0.3 (18 scans of 11 people)."""
_REMEDY = "cut away everything but the person, check --up and --units, or place landmarks by hand"


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

    The candidate that best explains hands, face and feet within joint limits wins. The confidence is
    mainly its margin over the best candidate of the opposite facing.

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
        BodyNotFoundError: a surface that is no person, or much more or less than one.
        InputError: a surface far from a person's size, or landmarks that the body does not have.
    """
    mesh = as_mesh(mesh, subject="mesh")
    config = config or LocateConfig()
    _check(mesh, colors)
    mesh = _outward(mesh)
    _refuse_convex(body, mesh, config)
    pinned = PinnedLandmarks.of(body, landmarks) if landmarks else None
    search = Search(Kinematics(body), mesh, config, pinned, progress)
    # Standing poses first; rare ones, then low ones, where none explains the surface: these have to explain it better.
    found = search.candidates(standing_poses(body.joint_count))
    best, moved = _settled(search, found[0], hints)
    for poses in (rare_poses, low_poses):
        if not is_doubtful(best):
            break
        rare = search.candidates(poses(body.joint_count))
        other, its = _settled(search, rare[0], hints)
        if other.cost < best.cost - _RARER:
            best, moved, found = other, its, [*rare, *found]
        else:
            found += rare
    reason = no_person(best)
    if labeller is not None and not reason:
        best = _labelled(search, best, labeller, colored=colors is not None and np.ptp(colors, axis=0).max() > 0)
    if not reason:
        best = settle_feet(search, best)
    others = tuple(found[1:])
    findings, trust = findings_of(mesh, search.fine, best, search.outer.mesh(search.kinematics.posture(best.state, 0)))
    located = LocatedBody(
        best.state.to_params(body),
        0.0 if reason else trust * confidence_of(best, others),
        (*findings, *notes_of(best, others)),
        tuple(_candidate(one) for one in (best, *others)),
        moved,
        findings,
    )
    if reason:
        raise BodyNotFoundError(
            located,
            received="; ".join((reason, *findings)),
            remedy=_REMEDY,
        )
    return located


def _settled(
    search: Search, found: Found, hints: Mapping[str, Float[np.ndarray, " 3"]] | None
) -> tuple[Found, tuple[str, ...]]:
    """Fit a candidate to the end; search limbs that its surface does not show once more, before labels depend on them.

    Returns:
        the body; the limbs that moved.
    """
    best, moved = search.finished(found), tuple[str, ...]()
    if not no_person(best):
        best, moved = look_again(search, best, hints=hints)
        best = raise_head(search, best)
        best = lift_heels(search, best)
    return best, moved


def _labelled(search: Search, best: Found, labeller: Labeller, *, colored: bool) -> Found:
    """Fit a body with what is bare skin, with colours without things that it holds or wears, and once more where the
    labels of the fitted body call something else skin or a thing.

    A body that was fitted as clothed stays a centimetre or two within a person who is not, and what lies that far off
    it looks like clothes. Without colours it is therefore also fitted to the whole surface as skin: clothes show their
    hems then all the more, and who has none stays unclothed.
    """
    body = search.kinematics.body

    def labels_of(found: Found) -> np.ndarray | None:
        labels = labeller(found.state.to_params(body))
        return None if labels is None else np.asarray(labels)[search.fine.face]

    if not colored:
        bare = search.polished(best.name, best.state, np.ones(len(search.fine), bool), steps=search.config.finish_steps)
        labels = labels_of(bare)
        if labels is None:
            return best
        known = labels[labels >= 0]
        if len(known) > _KNOWN * len(labels) and np.isin(known, (SKIN.id, HAIR.id)).all():
            return bare
    skin, thing = np.zeros((2, len(search.fine)), bool)
    for _ in range(2):
        labels = labels_of(best)
        if labels is None:
            break
        found = labels == SKIN.id, (labels == OBJECT.id) & colored
        if np.mean((skin != found[0]) | (thing != found[1])) < _SAME:
            break
        # Hands and forearms were drawn onto the thing, and shape and shoulders after them. Without colours its borders
        # are unsure: a body that was fitted without a part of it made sleeves of the rest, and of bare forearms.
        skin, thing = found
        rest = search.without(thing)
        best = rest.finished(rest.measured(best.name, best.state), skin[~thing])
    # Candidates are compared by what they explain of the whole surface.
    return search.measured(best.name, best.state) if thing.any() else best


_KNOWN, _SAME = 0.6, 0.03
"""Shares of the surface: what has to be labelled for a person to be unclothed; what may change without another fit."""


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


def _refuse_convex(body: BodyModel, mesh: TriangleMesh, config: LocateConfig) -> None:
    """Refuse a box or a ball before the search, which would take as long as for a person.

    The error carries the body at rest in the middle of the surface, so that a picture shows both.
    """
    share = convex_share(mesh)
    if share < _MOST_CONVEX:
        return
    placed = Search(Kinematics(body), mesh, config, None, ignore_progress).at_rest()
    finding = f"{share:.0%} of the surface lies on its convex hull, as of a box or a ball"
    raise BodyNotFoundError(
        LocatedBody(placed.state.to_params(body), 0.0, (finding,), (_candidate(placed),), (), (finding,)),
        received=f"a convex surface: {finding}",
        remedy=_REMEDY,
    )


def _outward(mesh: TriangleMesh) -> TriangleMesh:
    """Return the surface with outward faces, decided by the sign of the volume that it encloses."""
    volume = np.einsum("ij,ij->", mesh.face_centers - mesh.face_centers.mean(axis=0), mesh.face_cross)
    return mesh if volume >= 0 else TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])
