"""Judge any mesh, rigged file or template: faults of its surface, weights, parts in each other, hard poses, a scan."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float64

from smplxpp.body import load_body
from smplxpp.body.named_poses import STRESS_POSES, stress_poses
from smplxpp.body.rest_pose import turned_rig
from smplxpp.body.retarget import Skeleton
from smplxpp.body.skeleton_match import Tree
from smplxpp.body.skeleton_motion import SkeletonMotion
from smplxpp.body.skeleton_params import named_joints
from smplxpp.core import (
    BodyParams,
    Check,
    InputError,
    MeshLike,
    SkinWeights,
    TriangleMesh,
    as_mesh,
    matrix_from_rotvec,
    read_mesh,
)
from smplxpp.core.errors import one_line
from smplxpp.core.mesh_files.raw_mesh import FileRig
from smplxpp.core.topology import component_labels
from smplxpp.metrics import (
    CompareConfig,
    compare,
    edge_stretch,
    faulty_faces,
    interpenetration,
    mesh_quality,
    penetration,
    point_to_surface,
    rig_report,
    weight_report,
)
from smplxpp.skinning import forward_kinematics
from smplxpp.template.template import BODY_PART, Template
from smplxpp.transfer.checks import welded

# Shares of a part's faces or vertices, %, at which a fault warns and fails; any other fault fails from the first face.
# Chosen on templates of two real scans: a right shirt has 0.2 % of cut faces, one that is torn 2 %.
_SHARES = {"faces that cut another": (0.0, 1.0), "needles": (0.1, 5.0)}
# Cloth whose weights are right still meets the body where limbs press on it, as a skirt does in a step: a build lets it
# pass with a warning, and so does this.
_INSIDE_REST, _INSIDE_POSED, _STRETCH = (0.0, 1.0), (2.0, 100.0), (3.0, 10.0)
_OFF = "weights off a sum of 1"
# Rounding to bytes leaves 0.01, and some engines do not divide by the sum; a joint twice is moved right by most.
_RIG = {_OFF: (0.01, 0.1), "a joint twice at a vertex": (0.0, np.inf)}
# Colours of regions, the later over the earlier where both are; grey is fine.
_GREY = (190, 190, 190)
_PALETTE = {
    "at a border": (150, 200, 255),
    "off the scan": (80, 120, 255),
    "a joint twice at a vertex": (200, 200, 120),
    "weights off a sum of 1": (180, 255, 180),
    "needles": (240, 220, 90),
    "stretched": (255, 170, 0),
    "seams that open": (120, 220, 60),
    "stretched as shown": (255, 110, 0),
    "inside the body in a pose": (255, 120, 160),
    "inside the body": (230, 30, 30),
    "faces that cut another": (150, 60, 200),
    "negative weights": (110, 0, 60),
    "vertices without weights": (255, 255, 255),
    "faces without area": (0, 0, 0),
    "faces wound the other way": (0, 160, 90),
    "faces that repeat another": (120, 70, 20),
    "faces at an edge of three": (0, 200, 220),
}


def check_mesh(
    subject: str | Path | MeshLike | Template,
    *,
    weights: SkinWeights | None = None,
    scan: MeshLike | None = None,
    params: BodyParams | None = None,
    unit: Literal["m", "cm", "mm"] = "m",
) -> MeshVerdict:
    """Judge a mesh with everything that a build checks, as `smplxpp check` does.

    Args:
        subject: a mesh; a file of one, rigged or not; or a template.
        weights: skin weights of a mesh, a row a vertex.
        scan: to compare with, in the pose of `params` for a template.
        params: pose of the scan, for a template; only the first frame is used.
        unit: of a mesh and of the scan.

    Returns:
        Checks against limits, with the faces of every fault.

    Raises:
        InputError: a file that is not read, or inputs that do not fit the subject.

    Example:
        >>> corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
        >>> faces = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 2, 3]]  # the last is wound the other way
        >>> [check.name for _, check in smplxpp.check_mesh((corners, faces)).checks if check.status == "fail"]
        ['faces wound the other way']
    """
    found = _subject(subject, unit)
    if found.template is None and params is not None:
        raise InputError("params", expected="a template, which has a pose", received="a mesh")
    if found.template is not None and weights is not None:
        raise InputError("weights", expected="a mesh", received="a template, which has its own weights")
    if found.template is not None and scan is not None and params is None:
        raise InputError("params", expected="the scan's pose, to compare a template", received="none")
    # The body of a template is the model's own.
    for name in found.parts:
        if found.template is None or name != BODY_PART:
            found._check_surface(name)
    if found.template is not None:
        found._check_template(found.template)
    if found.rig is not None:
        found._check_rig(found.rig, {"m": 1.0, "cm": 0.01, "mm": 0.001}[unit])
    if weights is not None:
        found._check_weights(weights)
    if scan is not None:
        posed = found.mesh
        if found.template is not None and params is not None:
            posed = posed.with_vertices(found.template.pose(params.frame(0))[0])
        found._check_scan(as_mesh(scan, unit=unit), posed)
    return found


def _subject(subject: str | Path | MeshLike | Template, unit: str) -> MeshVerdict:
    """Return the mesh of a subject with its parts, before any check."""
    if isinstance(subject, Template):
        parts = {name: subject.part_faces(name) for name in subject.part_names}
        return MeshVerdict(subject.mesh, {name: chosen for name, chosen in parts.items() if chosen.any()}, subject)
    if not isinstance(subject, str | Path):
        mesh = as_mesh(subject, unit=unit)
        return MeshVerdict(mesh, {"mesh": np.ones(mesh.face_count, dtype=bool)})
    file = read_mesh(subject)
    mesh = as_mesh(file.mesh, unit=unit)
    parts = {"mesh": np.ones(mesh.face_count, dtype=bool)}
    if file.face_part is not None and len(np.unique(file.face_part)) > 1:
        # Meshes of one name are distinguished by their numbers.
        names = [
            name if file.part_names.count(name) == 1 else f"{name} ({k})" for k, name in enumerate(file.part_names)
        ]
        parts = {names[k]: file.face_part == k for k in np.unique(file.face_part)}
    # glTF and STL cannot say that faces share a vertex where texture, normal or weights differ.
    copies = Path(subject).suffix.lower() in (".glb", ".gltf", ".vrm", ".stl")
    return MeshVerdict(mesh, parts, rig=file.rig, copies=copies)


@dataclass(eq=False)
class MeshVerdict:
    """What `check_mesh` found: checks against limits, and the faces of each kind of fault.

    Attributes:
        mesh: metres, M faces.
        parts: faces of each part by name, (M,) bool.
        template: that the mesh is of.
        rig: skeleton and skin weights of the mesh's file.
        copies: whether vertices of one place are one, as in files that cannot share them along seams.
        checks: pairs of part and check, in the order in which they were made.
        regions: (M,) bool faces at which a fault is, by its name.
        numbers: what else was measured, by what it is of.
    """

    mesh: TriangleMesh
    parts: dict[str, Bool[np.ndarray, " M"]]
    template: Template | None = None
    rig: FileRig | None = None
    copies: bool = False
    checks: list[tuple[str, Check]] = field(default_factory=list)
    regions: dict[str, Bool[np.ndarray, " M"]] = field(default_factory=dict)
    numbers: dict[str, Any] = field(default_factory=dict)

    def _check_surface(self, name: str) -> None:
        """Faults of a part's faces; borders are counted, because clothes have them."""
        chosen = np.flatnonzero(self.parts[name])
        part, pieces = self.mesh.submesh(chosen)[0], None
        if self.copies:
            once, index = welded(part)
            part = TriangleMesh(once.vertices, index[part.faces])
        # Of a character eyes, teeth and buttons cut the skin; a surface must not cut itself.
        if self.rig is not None or len(self.parts) > 1:
            pieces = component_labels(part.edges, part.vertex_count)[part.faces[:, 0]]
        self.numbers.setdefault("quality", {})[name] = mesh_quality(part).as_dict()
        borders = np.isin(part.faces, np.unique(part.border_edges)).sum(axis=1) > 1
        self.regions.setdefault("at a border", np.zeros(self.mesh.face_count, dtype=bool))[chosen[borders]] = True
        for fault, faces in faulty_faces(part, pieces=pieces).items():
            gate = _SHARES.get(fault)
            value, unit = (100 * float(faces.mean()), "%") if gate else (int(faces.sum()), "")
            self._add(name, fault, value, unit, gate or (0.0, 0.0), chosen[faces])

    def _check_weights(self, weights: SkinWeights) -> None:
        """Rows that are no weights, and jumps along edges."""
        if len(weights) != self.mesh.vertex_count:
            raise InputError("weights", expected=f"{self.mesh.vertex_count} rows", received=f"{len(weights)}")
        report = weight_report(weights, edges=self.mesh.edges)
        self.numbers["weights"] = report.as_dict()
        empty = weights.dense().sum(axis=1) < 0.5
        self._add("mesh", "vertices without weights", int(empty.sum()), "", (0, 0), self._at(empty))
        assert report.edges is not None
        self._add("mesh", "largest jump of weights along an edge", report.edges.max, "", (0.5, 0.9), None)

    def _check_template(self, template: Template) -> None:
        """Parts inside the body, at rest and in hard poses, stretched edges, and parts within each other."""
        posed = template.pose(stress_poses(BodyParams.rest(betas=len(template.betas))))
        for name in self.parts:
            if name != BODY_PART:
                self._check_inside(name, BODY_PART, posed)
                self._check_stretch(name, self.mesh, posed, "stretched")
        self._check_solids({name: np.unique(self.mesh.faces[faces]) for name, faces in self.parts.items()})
        self.numbers["weights"] = weight_report(template.weights, edges=self.mesh.edges).as_dict()

    def _check_rig(self, rig: FileRig, unit: float) -> None:
        """Weights and bind matrices of a file, and what stress poses make of its surface.

        Args:
            rig: as the file has it.
            unit: metres in the mesh for one unit of the file.
        """
        report, faults = rig_report(rig)
        self.numbers["rig"] = report
        self._add("rig", "bind matrices without an inverse", report["singular_binds"], "", (0, 0), None)
        for fault, vertices in faults.items():
            value = report["sum_error"] if fault == _OFF else int(vertices.sum())
            self._add("rig", fault, value, "", _RIG.get(fault, (0.0, 0.0)), self._at(vertices))
        if report["singular_binds"]:
            return
        # Files may show another pose than the one they are bound in; their scales may differ by a unit.
        for name in self.parts:
            self._check_stretch(
                name, self.mesh.with_vertices(rig.bound), self.mesh.vertices[None], "stretched as shown"
            )
        try:
            posed = unit * stress_posed_rig(rig)
        except InputError as error:
            report["not_posed"] = str(error)
            return
        report["poses"] = list(STRESS_POSES)
        body = next((name for name in self.parts if name.lower() == BODY_PART), None)
        for name in self.parts:
            if body is not None and name != body:
                self._check_inside(name, body, posed)
            self._check_stretch(name, self.mesh, posed, "stretched")
            self._check_seams(name, posed)

    def _check_inside(self, name: str, body: str, posed: Float64[np.ndarray, "T V 3"]) -> None:
        """Vertices of a part inside the body, at rest and in poses."""
        chosen = np.flatnonzero(self.parts[name])
        part, used = self.mesh.submesh(chosen)
        skin, skin_used = self.mesh.submesh(self.parts[body])
        ever = np.zeros(len(used), dtype=bool)
        for vertices in posed:
            ever |= penetration(vertices[used], skin.with_vertices(vertices[skin_used]), clearance=0.0).penetrating
        inside = penetration(part.vertices, skin).penetrating
        for fault, where, gate in (
            ("inside the body", inside, _INSIDE_REST),
            ("inside the body in a pose", ever, _INSIDE_POSED),
        ):
            faces = chosen[where[part.faces].any(axis=1)]
            self._add(name, fault, 100 * float(where.mean()), "%", gate, faces)

    def _check_stretch(self, name: str, rest: TriangleMesh, posed: Float64[np.ndarray, "T V 3"], fault: str) -> None:
        """Edges of a part that poses lengthen, against the part's own scale: 99.9th percentile, the worst pose."""
        chosen = np.flatnonzero(self.parts[name])
        part, used = rest.submesh(chosen)
        worst, stretched = 0.0, np.zeros(part.face_count, dtype=bool)
        for vertices in posed:
            ratio = np.nan_to_num(edge_stretch(part, part.with_vertices(vertices[used])), nan=1.0)
            # A file's bind pose may be in another unit; a pose changes the length of few edges.
            ratio /= float(np.median(ratio)) or 1.0
            worst = max(worst, float(np.percentile(ratio, 99.9)))
            longer = np.zeros(part.vertex_count, dtype=bool)
            longer[part.edges[ratio > _STRETCH[0]]] = True
            stretched |= longer[part.faces].all(axis=1)
        self._add(name, fault, worst, "x", _STRETCH, chosen[stretched])

    def _check_seams(self, name: str, posed: Float64[np.ndarray, "T V 3"]) -> None:
        """Copies of a vertex, as files have them along seams of their texture, that poses move apart."""
        part, used = self.mesh.submesh(self.parts[name])
        _, index = welded(part)
        first = used[np.unique(index, return_index=True)[1]][index]
        apart = np.linalg.norm(posed[:, used] - posed[:, first], axis=2).max(axis=0) * 1e3
        gate = (1.0, 5.0)  # mm between copies of a vertex: a slit of one is seen at arm's length
        wide = np.zeros(self.mesh.vertex_count, dtype=bool)
        wide[used[apart > gate[0]]] = True
        self._add(name, "seams that open", float(apart.max()), "mm", gate, self._at(wide))

    def _check_solids(self, members: dict[str, np.ndarray]) -> None:
        """Volumes that closed parts share; open ones have none."""
        solids = {name: self.mesh.submesh(faces)[0] for name, faces in self.parts.items()}
        solids = {name: part for name, part in solids.items() if not len(part.border_edges)}
        for one in solids:
            for other in solids:
                if one < other:
                    shared = interpenetration(solids[one], solids[other])
                    self._add(f"{one}, {other}", "volume in both", shared.volume_cm3, "cm3", (1.0, 50.0), None)

    def _check_scan(self, scan: TriangleMesh, posed: TriangleMesh) -> None:
        """Distance to the scan of what can be seen from outside."""
        far_mm = 10.0  # distance from which a face is coloured as off the scan: twice the threshold of the F-score
        result = compare(posed, scan, config=CompareConfig(visible_only=self.template is not None, certified=True))
        self.numbers["scan"] = result.as_dict()
        assert result.pred_to_gt is not None and result.gt_to_pred is not None
        far = point_to_surface(posed.face_centers, scan)[0] * 1e3 > far_mm
        self._add("all", "off the scan", result.pred_to_gt.mean, "mm", (2.0, 6.0), np.flatnonzero(far))
        self._add("all", "scan without a surface", result.gt_to_pred.mean, "mm", (2.0, 6.0), None)

    def _at(self, vertices: np.ndarray) -> np.ndarray:
        return np.flatnonzero(vertices[self.mesh.faces].any(axis=1))

    def _add(
        self, part: str, name: str, value: float, unit: str, gate: tuple[float, float], faces: np.ndarray | None
    ) -> None:
        self.checks.append((part, Check(name, value, unit, *gate)))
        if faces is not None:
            self.regions.setdefault(name, np.zeros(self.mesh.face_count, dtype=bool))[faces] = True

    def colors(self) -> np.ndarray:
        """A colour a vertex: grey, or that of the worst fault of a face at it."""
        out = np.tile(np.array(_GREY, dtype=np.uint8), (self.mesh.vertex_count, 1))
        for name, color in _PALETTE.items():
            if name in self.regions:
                out[self.mesh.faces[self.regions[name]]] = color
        return out

    @property
    def status(self) -> str:
        """The worst status of a check: "pass", "warn" or "fail"."""
        return max((check.status for _, check in self.checks), key=("pass", "warn", "fail").index, default="pass")

    __repr__ = one_line

    def as_dict(self) -> dict[str, Any]:
        """Return status, checks and numbers for JSON."""
        rows = [
            {
                "part": part,
                **check.as_dict(),
                "faces": int(self.regions[check.name].sum()) if check.name in self.regions else None,
                "color": _PALETTE.get(check.name),
            }
            for part, check in self.checks
        ]
        counts = {"vertices": self.mesh.vertex_count, "faces": self.mesh.face_count}
        return {**counts, "verdict": self.status, "checks": rows, **self.numbers}


def stress_posed_rig(rig: FileRig) -> Float64[np.ndarray, "T V 3"]:
    """Return a file's vertices in the poses of `STRESS_POSES`, in its own unit.

    Raises:
        InputError: joints that are no person's.
    """
    body = Skeleton.of(load_body())
    places = rig.world[:, :3, 3]
    has = rig.parents >= 0
    offsets = places - np.where(has[:, None], places[rig.parents], 0.0)
    still = np.tile(np.eye(3), (1, len(rig.names), 1, 1))
    joints = named_joints(SkeletonMotion(rig.names, rig.parents, offsets, still, places[:1], 1.0), subject="rig")
    # Turns of our joints in the world, then what they move the file's joints by.
    local = matrix_from_rotvec(stress_poses(BodyParams.rest()).full_pose)
    count = len(body.names)
    rest = np.repeat(body.places[None], len(local), axis=0)
    whole = forward_kinematics(rest, body.parents, local[:, :count])[0][..., :3, :3]
    turns = {name: whole[:, k] for k, name in enumerate(body.names)}
    moved = turned_rig(Tree(rig.names, rig.parents, places), joints, body, turns)
    return np.stack([rig.posed(step @ rig.world) for step in moved])
