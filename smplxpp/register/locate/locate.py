"""Find the body in a bare surface: `locate_body`."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float, Integer, UInt8

from smplxpp.body import BodyModel
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.core.labels import SKIN
from smplxpp.core.mesh import MeshLike, TriangleMesh, as_mesh
from smplxpp.core.params import BodyParams
from smplxpp.register.kinematics import Kinematics
from smplxpp.register.locate.config import LocateConfig
from smplxpp.register.locate.judge import confidence_of, problems_of, refuse_what_is_no_person
from smplxpp.register.locate.located import Candidate, LocatedBody
from smplxpp.register.locate.pinned import Pinned
from smplxpp.register.locate.search import Found, Search

Labeller = Callable[[BodyParams], "Integer[np.ndarray, ' M'] | None"]
"""Labels every face of the surface, given the body in it; negative where it does not know. None: no labels."""


def locate_body(
    body: BodyModel,
    mesh: MeshLike,
    *,
    colors: UInt8[np.ndarray, "N 3"] | None = None,
    landmarks: Mapping[str, Float[np.ndarray, " 3"]] | None = None,
    labeller: Labeller | None = None,
    config: LocateConfig | None = None,
    progress: ProgressCallback = ignore_progress,
) -> LocatedBody:
    """Find pose, shape, facing and place of the one person in a surface that says nothing else.

    Poses of scanning are compared with the surface from all sides; the best of both facings are drawn onto it, have
    every limb tried, and are fitted as bodies that wear something. The one that explains hands, face and feet, turns no
    joint as none does, and leaves least unexplained is chosen; how far the best of the other facing is behind it says
    how sure that is.

    Args:
        mesh: of the whole person, metres, +Y up (`smplxpp.clean.find_scan_frame`); tilted by some 20 degrees at most.
        colors: of the vertices.
        landmarks: points of the body (`smplxpp.register.landmarks`) that are known, from a detector or by hand.
        labeller: tells what is skin once the body stands; the body is then fitted once more.
        progress: called with the work under way and its share done.

    Raises:
        InputError: a surface that is no person, or far from its size; landmarks that the body does not have.
    """
    mesh = as_mesh(mesh, subject="mesh")
    config = config or LocateConfig()
    _check(mesh, colors)
    mesh = _outward(mesh)
    pinned = Pinned.of(body, landmarks) if landmarks else None
    search = Search(Kinematics(body), mesh, config, pinned, progress)
    found = search.candidates()
    if pinned is not None:
        pinned.believed()
    best = search.finished(found[0])
    refuse_what_is_no_person(best)
    if labeller is not None:
        labels = labeller(best.state.to_params(body))
        if labels is not None:
            best = search.finished(best, np.asarray(labels)[search.fine.face] == SKIN.id)
    others = tuple(found[1:])
    return LocatedBody(
        best.state.to_params(body),
        confidence_of(best, others),
        problems_of(best, others),
        tuple(_candidate(one) for one in (best, *others)),
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
    """The surface with its faces outward, told by the volume that it encloses."""
    volume = np.einsum("ij,ij->", mesh.face_centers - mesh.face_centers.mean(axis=0), mesh.face_cross)
    return mesh if volume >= 0 else TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])
