"""What may happen to a scan before it is read: turned, z upwards, in centimetres, mirrored, decimated, noisy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.people.person_scan import PersonScan
from smplxpp.body import BodyModel, load_body
from smplxpp.clean.simplify import simplify
from smplxpp.clean.units import METRES_PER_UNIT, convert_points
from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams

_TURN, _SHIFT = 137.0, (0.6, 0.0, -1.1)  # degrees about the vertical; metres
_FLIP = np.array([-1.0, 1.0, 1.0])


def variant(scan: PersonScan, name: str) -> PersonScan:
    """The scan after one of `VARIANTS` has happened to it, with the truth that goes with it.

    Raises:
        InputError: no such variant.
    """
    if name not in VARIANTS:
        raise InputError("variant of a scan", expected=f"one of {', '.join(VARIANTS)}", received=name)
    changed = VARIANTS[name](scan)
    return scan if changed is scan else replace(changed, name=f"{scan.name} | {name}")


def turned(scan: PersonScan, degrees: float, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> PersonScan:
    """The person turned about the vertical axis to her left, then moved."""
    body = load_body()
    turn = Rotation.from_euler("y", degrees, degrees=True)
    posed = body.forward(scan.params)
    orient = (turn * Rotation.from_rotvec(scan.params.global_orient[0].copy())).as_rotvec()[None]
    # The body turns about its root joint, and `transl` comes last.
    root = posed.rest_joints[0, 0]
    transl = (turn.apply(root + scan.params.transl[0]) + shift - root)[None]
    return _of(
        body,
        scan,
        replace(scan.params, global_orient=orient, transl=transl),
        scan.mesh.with_vertices(scan.mesh.vertices @ turn.as_matrix().T + shift),
    )


def mirrored(scan: PersonScan) -> PersonScan:
    """The person's mirror image at x = 0: the body is symmetric (to .4 mm, single vertices 5 mm), so it is a body."""
    body = load_body()
    mesh = TriangleMesh(scan.mesh.vertices * _FLIP, scan.mesh.faces[:, ::-1])
    return _of(body, scan, mirrored_params(body, scan.params), mesh)


def mirrored_params(body: BodyModel, params: BodyParams) -> BodyParams:
    """Left and right exchanged: joints, rotations, expressions and place."""
    pose = params.full_pose[:, _other_side(body.joint_names, "left", "right")] * [1.0, -1.0, -1.0]
    faces = _other_side(body.expression_names, "Left", "Right")[: params.expression.shape[1]]
    return BodyParams.from_full_pose(
        pose, betas=params.betas, expression=params.expression[:, faces], transl=params.transl * _FLIP
    )


def _other_side(names: tuple[str, ...], left: str, right: str) -> list[int]:
    def other(name: str) -> str:
        return name.replace(left, right) if left in name else name.replace(right, left)

    return [names.index(other(name)) for name in names]


def decimated(scan: PersonScan, share: float) -> PersonScan:
    """The scan simplified to a share of its faces; a face takes the label of the nearest old one."""
    kept = simplify(scan.mesh, int(share * scan.mesh.face_count))
    near = cKDTree(scan.mesh.face_centers).query(kept.mesh.face_centers)[1]
    colors = None if scan.colors is None else scan.colors[kept.source_vertex]
    return replace(scan, mesh=kept.mesh, colors=colors, face_labels=scan.face_labels[near], seen=scan.seen[near])


def noisy(scan: PersonScan, metres: float) -> PersonScan:
    """Independent normal noise of that deviation on every coordinate."""
    noise = np.random.default_rng(2).normal(size=scan.mesh.vertices.shape)
    return replace(scan, mesh=scan.mesh.with_vertices(scan.mesh.vertices + metres * noise))


def filed(scan: PersonScan, *, units: str = "m", up: str = "y") -> PersonScan:
    """The scan with its mesh in other units and axes: `as_read` undoes it."""
    axes = convert_points(np.eye(3), up=up)  # row k: where the file's axis k points to
    vertices: Float[np.ndarray, "N 3"] = scan.mesh.vertices @ axes.T / METRES_PER_UNIT[units]
    return replace(scan, mesh=scan.mesh.with_vertices(vertices), units=units, up=up)


def _of(body: BodyModel, scan: PersonScan, params: BodyParams, mesh: TriangleMesh) -> PersonScan:
    return PersonScan.of(
        body,
        params,
        name=scan.name,
        mesh=mesh,
        colors=scan.colors,
        face_labels=scan.face_labels,
        seen=scan.seen,
    )


VARIANTS: dict[str, Callable[[PersonScan], PersonScan]] = {
    "as it is": lambda scan: scan,
    "turned": lambda scan: turned(scan, _TURN, _SHIFT),
    "z up": lambda scan: filed(turned(scan, -60.0), up="z"),
    "in cm": lambda scan: filed(scan, units="cm"),
    "mirrored": mirrored,
    "80 % of the faces": lambda scan: decimated(scan, 0.8),
    "20 % of the faces": lambda scan: decimated(scan, 0.2),
    "3 mm noise": lambda scan: noisy(scan, 3e-3),
}
