"""PersonScan: a scan of a clothed person with its truth, and the changes that test what reads it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from smplxpp.body import BodyModel
from smplxpp.clean import METRES_PER_UNIT, convert_points, simplify
from smplxpp.core import BodyParams, InputError, TriangleMesh
from smplxpp.core.errors import one_line

_FLIP = np.array([-1.0, 1.0, 1.0])  # mirrors points at x = 0


@dataclass(frozen=True, eq=False)
class PersonScan:
    """A scan as its file would hold it, with its truth in metres, +Y up, whatever the units of the file.

    Attributes:
        name: name of the person, and of the variant if it is one.
        mesh: one outer surface, in `units` and with `up` upwards (metres and "y" but for variants).
        colors: sRGB colour of each vertex; None for a scan without colours.
        face_labels: id of `smplxpp.core.labels` of the layer that each face shows.
        seen: whether a face lies on a layer that the scanner saw; false on bridges and filled holes.
        params: one row that gives `body_vertices` with `body`.
        body_vertices: vertices of the body under the clothes, in the open body's order.
        joints: its joints.
        body: the body of this person: the open body, or one whose surface that cannot reach (`outside.outside_body`).
        units: unit of `mesh`, as in `smplxpp.clean.convert_points`.
        up: up axis of `mesh`, likewise.
    """

    name: str
    mesh: TriangleMesh
    colors: UInt8[np.ndarray, "N 3"] | None
    face_labels: Int[np.ndarray, " M"]
    seen: Bool[np.ndarray, " M"]
    params: BodyParams
    body_vertices: Float[np.ndarray, "V 3"]
    joints: Float[np.ndarray, "J 3"]
    body: BodyModel
    units: str = "m"
    up: str = "y"

    __repr__ = one_line

    @staticmethod
    def of(
        body: BodyModel,
        params: BodyParams,
        *,
        name: str,
        mesh: TriangleMesh,
        colors: UInt8[np.ndarray, "N 3"] | None,
        face_labels: Int[np.ndarray, " M"],
        seen: Bool[np.ndarray, " M"],
    ) -> PersonScan:
        """Return a scan in metres, +Y up, whose body one row of parameters gives."""
        posed = body.forward(params)
        return PersonScan(name, mesh, colors, face_labels, seen, params, posed.vertices[0], posed.joints[0], body)

    def as_read(self) -> PersonScan:
        """Return the same scan with its mesh in metres, +Y up."""
        vertices = convert_points(self.mesh.vertices, units=self.units, up=self.up)
        return replace(self, mesh=self.mesh.with_vertices(vertices), units="m", up="y")

    def changed(self, params: BodyParams, mesh: TriangleMesh) -> PersonScan:
        """Return the scan with another pose and other vertices; labels and colours stay."""
        posed = self.body.forward(params)
        return replace(self, params=params, mesh=mesh, body_vertices=posed.vertices[0], joints=posed.joints[0])


def face_majority(vertex_labels: Int[np.ndarray, " N"], faces: Int[np.ndarray, "M 3"]) -> Int[np.ndarray, " M"]:
    """Return the label of most corners of each face; that of the first corner where all differ."""
    corner = np.asarray(vertex_labels, dtype=np.int64)[faces]
    return np.where(corner[:, 1] == corner[:, 2], corner[:, 1], corner[:, 0])


def variant(scan: PersonScan, name: str) -> PersonScan:
    """Return the scan after one of the changes of `VARIANTS`, with its truth changed alike.

    Raises:
        InputError: no such variant.
    """
    if name not in VARIANTS:
        raise InputError("variant of a scan", expected=f"one of {', '.join(VARIANTS)}", received=name)
    changed = VARIANTS[name](scan)
    return scan if changed is scan else replace(changed, name=f"{scan.name} | {name}")


def turned(scan: PersonScan, degrees: float, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> PersonScan:
    """Turn the person about the vertical axis to her left, then move her."""
    turn = Rotation.from_euler("y", degrees, degrees=True)
    posed = scan.body.forward(scan.params)
    orient = (turn * Rotation.from_rotvec(scan.params.global_orient[0].copy())).as_rotvec()[None]
    # The body turns about its root joint, and `transl` comes last.
    root = posed.rest_joints[0, 0]
    transl = (turn.apply(root + scan.params.transl[0]) + shift - root)[None]
    moved = scan.mesh.with_vertices(scan.mesh.vertices @ turn.as_matrix().T + shift)
    return scan.changed(replace(scan.params, global_orient=orient, transl=transl), moved)


def mirrored(scan: PersonScan) -> PersonScan:
    """Mirror the person at x = 0. The body is symmetric to 0.4 mm, single vertices to 5 mm."""
    mesh = TriangleMesh(scan.mesh.vertices * _FLIP, scan.mesh.faces[:, ::-1])
    return scan.changed(mirrored_params(scan.body, scan.params), mesh)


def mirrored_params(body: BodyModel, params: BodyParams) -> BodyParams:
    """Exchange left and right of joints, rotations, expressions and translation."""
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
    """Simplify the scan to a share of its faces; a face takes the label of the nearest old one."""
    kept = simplify(scan.mesh, int(share * scan.mesh.face_count))
    near = cKDTree(scan.mesh.face_centers).query(kept.mesh.face_centers)[1]
    colors = None if scan.colors is None else scan.colors[kept.source_vertex]
    return replace(scan, mesh=kept.mesh, colors=colors, face_labels=scan.face_labels[near], seen=scan.seen[near])


def noisy(scan: PersonScan, metres: float) -> PersonScan:
    """Add independent normal noise of a standard deviation in metres to every coordinate."""
    noise = np.random.default_rng(2).normal(size=scan.mesh.vertices.shape)
    return replace(scan, mesh=scan.mesh.with_vertices(scan.mesh.vertices + metres * noise))


def filed(scan: PersonScan, *, units: str = "m", up: str = "y") -> PersonScan:
    """Return the scan with its mesh in other units and axes; `as_read` undoes it."""
    axes = convert_points(np.eye(3), up=up)  # row k: direction of the file's axis k
    vertices: Float[np.ndarray, "N 3"] = scan.mesh.vertices @ axes.T / METRES_PER_UNIT[units]
    return replace(scan, mesh=scan.mesh.with_vertices(vertices), units=units, up=up)


VARIANTS: dict[str, Callable[[PersonScan], PersonScan]] = {
    "as it is": lambda scan: scan,
    "turned": lambda scan: turned(scan, 137.0, (0.6, 0.0, -1.1)),
    "z up": lambda scan: filed(turned(scan, -60.0), up="z"),
    "in cm": lambda scan: filed(scan, units="cm"),
    "mirrored": mirrored,
    "80 % of the faces": lambda scan: decimated(scan, 0.8),
    "20 % of the faces": lambda scan: decimated(scan, 0.2),
    "3 mm noise": lambda scan: noisy(scan, 3e-3),
}
