"""The inside of the mouth: what no photograph of closed lips shows, and an open mouth does."""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from jaxtyping import Bool, Float, Float64

from smplxpp.core import BodyParams, Camera, TriangleMesh
from smplxpp.core.rotations import rotation_between
from smplxpp.raster import rasterize_mesh
from smplxpp.template.template import Template

MOUTH_COLOR = (72, 32, 30)
"""sRGB of the inside of a mouth that no view shows: what lies in its shade."""

_OPEN = (0.15, 0.3, 0.45)  # radians of the jaw
_INSIDE = ("teeth", "tongue", "gum", "mouth")  # in names of a body's parts
# Towards the viewer, in the frame of a head that looks along z.
_VIEWS = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0], [-0.5, 0.0, 1.0], [0.0, 0.4, 1.0], [0.0, -0.4, 1.0]])
_HALF_EXTENT, _PIXELS = 0.16, 400  # of a view, metres; a pixel is 0.8 mm


# Results by template, because five steps of a training ask for the same, which takes a third of a second.
_INSIDE_OF: WeakKeyDictionary[Template, Bool[np.ndarray, " V"]] = WeakKeyDictionary()


def inside_of_mouth(template: Template) -> Bool[np.ndarray, " V"]:
    """Mark the vertices inside the mouth: teeth and tongue by name, and what views from ahead see of the head if its
    jaw hangs down and do not see if it does not.

    A body without joints "head" and "jaw", and one whose jaw uncovers nothing, has none that is not named. The array
    is read-only.
    """
    if template not in _INSIDE_OF:
        inside = _inside_of_mouth(template)
        inside.flags.writeable = False
        _INSIDE_OF[template] = inside
    return _INSIDE_OF[template]


def _inside_of_mouth(template: Template) -> Bool[np.ndarray, " V"]:
    mouth_radius = 0.04  # metres about its middle
    body, inside = template.body, np.zeros(template.vertex_count, dtype=bool)
    named = [k for k, name in enumerate(body.part_label_names) if any(word in name for word in _INSIDE)]
    inside[: body.vertex_count] = np.isin(body.part_labels, named)
    if not {"head", "jaw"} <= set(body.joint_names):
        return inside
    naked = template.naked()
    rest = BodyParams.rest(betas=body.num_betas, expressions=body.num_expressions)
    closed, *opened = (
        _seen_from_ahead(naked, naked.pose(replace(rest, jaw_pose=np.array([[angle, 0.0, 0.0]])))[0])
        for angle in (0.0, *_OPEN)
    )
    uncovered = np.any(opened, axis=0) & ~closed & (_weight(naked, "head", "jaw") > 0.5)
    if uncovered.any():  # a jaw uncovers folds below the ears too
        middle = np.median(naked.vertices[uncovered], axis=0)
        uncovered &= np.linalg.norm(naked.vertices - middle, axis=1) < mouth_radius
    inside[: body.vertex_count] |= uncovered
    return inside


def shown_mouth(
    template: Template, inside: Bool[np.ndarray, " V"], posed: Float[np.ndarray, "V 3"]
) -> Bool[np.ndarray, " V"]:
    """Mark what a viewer ahead of a posed head could see of the inside of the mouth.

    Args:
        template: the person.
        inside: its `inside_of_mouth`.
        posed: its vertices, metres.
    """
    seen, count = np.zeros_like(inside), template.body.vertex_count
    if inside.any() and "head" in template.body.joint_names:
        seen[:count] = _seen_from_ahead(template.naked(), posed[:count])
    return seen & inside


def _seen_from_ahead(naked: Template, posed: Float[np.ndarray, "V 3"]) -> Bool[np.ndarray, " V"]:
    """Mark the vertices of the faces that views from ahead of the head see."""
    of_head = 0.95  # weight of the head from which a vertex moves with it alone
    seen = np.zeros(naked.vertex_count, dtype=bool)
    head = _weight(naked, "head") > of_head
    if not head.any():
        return seen
    mesh = TriangleMesh(np.asarray(posed, dtype=np.float64), naked.faces)
    rest, center = naked.vertices[head].mean(axis=0), mesh.vertices[head].mean(axis=0)
    turn = rotation_between(naked.vertices[head] - rest, mesh.vertices[head] - center)
    shown = np.zeros(len(naked.faces) + 1, dtype=bool)  # the last is the background, face -1
    for direction in _VIEWS @ turn:
        camera = Camera.orthographic_view(center=center, direction=direction, half_extent=_HALF_EXTENT, size=_PIXELS)
        shown[rasterize_mesh(mesh, camera).face_id] = True
    seen[naked.faces[shown[:-1]]] = True
    return seen


def _weight(naked: Template, *joints: str) -> Float64[np.ndarray, " V"]:
    return naked.body.weights[:, [naked.body.joint_names.index(joint) for joint in joints]].sum(axis=1)
