"""A procedural person in more kinds of clothes than the built-in labels have, as one labelled scan."""

from __future__ import annotations

from typing import Any

import numpy as np

from smplxpp.body import load_body
from smplxpp.core import BodyParams, TriangleMesh, concatenate_meshes
from smplxpp.people.cloth_mesh import ClothMesh, lift_outside
from smplxpp.people.garments.mannequin import Mannequin, lowered
from smplxpp.people.garments.wardrobe import all_garments
from smplxpp.segment import LabelSet
from smplxpp.skinning import skin

CLASSES: list[dict[str, Any]] = [
    {"name": "skin", "ids": 0},
    {"name": "dress", "ids": 10, "kind": "upper", "faces": 1200, "color": "#c81e5a"},
    {"name": "coat", "ids": 11, "faces": 1200, "color": [60, 90, 150]},
    {"name": "socks", "ids": [12, 13], "layer": 0.5, "fit": "tight", "faces": 800},
    {"name": "glasses", "ids": 14, "rule": "rigid:head", "faces": 400},
    {"name": "hat", "ids": 15, "layer": 6, "rule": "rigid:head", "faces": 500},
    {"name": "bag", "ids": 16, "faces": 300},
    {"name": "hair", "ids": 17, "faces": 800},
]


def many_classes() -> LabelSet:
    """The label set of the person: dress, coat, socks, glasses, hat, bag and hair."""
    return LabelSet.of({"name": "wardrobe", "classes": CLASSES})


def dressed_scan() -> tuple[TriangleMesh, np.ndarray, BodyParams]:
    """The scan in an A pose, ids of its faces as files have them, and the body's parameters."""
    body = load_body()
    mannequin = Mannequin.of(body, np.zeros(body.num_betas))
    garments = all_garments(mannequin)
    pieces: list[tuple[int, ClothMesh]] = [
        (0, mannequin.skin),
        (10, garments["dress"].cloth),
        (11, garments["open jacket"].cloth),
        *((12 + k, _sock(mannequin, side)) for k, side in enumerate(("left", "right"))),
        (14, _rigid(mannequin, _glasses(mannequin), "head")),
        (15, _rigid(mannequin, _hat(mannequin), "head")),
        (16, _rigid(mannequin, bag_on_the_back(mannequin), "spine3")),
        (17, garments["short hair"].cloth),
    ]
    # The coat is worn over the dress.
    under, over = pieces[1][1], pieces[2][1]
    outside = lift_outside(over.mesh, under.mesh, clearance=0.004, solid=False)
    pieces[2] = (11, over.with_vertices(outside))
    params = lowered(mannequin, 45.0)
    moved = body.forward(params).posed_from_rest[0]
    meshes = [cloth.mesh.with_vertices(skin(cloth.vertices, cloth.weights, moved)) for _, cloth in pieces]
    ids = np.repeat([number for number, _ in pieces], [mesh.face_count for mesh in meshes])
    return concatenate_meshes(meshes), ids, params


def _rigid(mannequin: Mannequin, mesh: TriangleMesh, joint: str) -> ClothMesh:
    return ClothMesh(mesh.vertices, mesh.faces, mannequin.rigid(joint, mesh.vertex_count))


def _sock(mannequin: Mannequin, side: str) -> ClothMesh:
    """The skin of a foot and half of the shin, 3 mm outwards."""
    mesh, knee, ankle = mannequin.skin.mesh, mannequin.joints[f"{side}_knee"], mannequin.joints[f"{side}_ankle"]
    own = (mesh.vertices[:, 1] < 0.5 * (knee + ankle)[1]) & (np.sign(mesh.vertices[:, 0]) == np.sign(ankle[0]))
    part, used = mesh.submesh(own[mesh.faces].all(axis=1))
    return ClothMesh(part.vertices + 0.003 * mesh.vertex_normals[used], part.faces, mannequin.skin.weights[used])


def _grid(points: np.ndarray, *, closed: bool = True) -> TriangleMesh:
    """Rows of points (R, C, 3) as a surface, the last column joined to the first; `closed` joins the rows, too."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns).reshape(rows, columns)
    here = index if closed else index[:-1]
    below = np.roll(index, -1, axis=0) if closed else index[1:]
    right, corner = np.roll(here, -1, axis=1), np.roll(below, -1, axis=1)
    faces = [np.stack([here, right, corner], axis=-1), np.stack([here, corner, below], axis=-1)]
    return TriangleMesh(points.reshape(-1, 3), np.concatenate(faces).reshape(-1, 3))


def _outward(mesh: TriangleMesh) -> TriangleMesh:
    arm = mesh.face_centers - mesh.vertices.mean(axis=0)
    turned = np.einsum("ij,ij->", arm, mesh.face_cross) < 0
    return TriangleMesh(mesh.vertices, mesh.faces[:, ::-1]) if turned else mesh


def _head(mannequin: Mannequin) -> tuple[np.ndarray, np.ndarray]:
    """Centre and half extents of the head above the chin's height."""
    points = mannequin.skin.vertices
    own = points[points[:, 1] > mannequin.joints["head"][1] + 0.05]
    return 0.5 * (own.min(axis=0) + own.max(axis=0)), 0.5 * np.ptp(own, axis=0)


def _glasses(mannequin: Mannequin) -> TriangleMesh:
    """Two rings in front of the eyes and a bar between them, three closed pieces."""
    eyes = [
        mannequin.joints[f"{side}_eye_smplhf"] for side in ("left", "right") if f"{side}_eye_smplhf" in mannequin.joints
    ]
    eyes = eyes or [mannequin.joints[name] for name in ("left_eye", "right_eye")]
    front = mannequin.skin.vertices[:, 2].max() if not eyes else max(eye[2] for eye in eyes) + 0.03
    u, v = np.meshgrid(
        np.linspace(0, 2 * np.pi, 28, endpoint=False), np.linspace(0, 2 * np.pi, 8, endpoint=False), indexing="ij"
    )

    def ring(centre: np.ndarray, radius: float, thick: float) -> TriangleMesh:
        r = radius + thick * np.cos(v)
        points = np.stack([centre[0] + r * np.cos(u), centre[1] + r * np.sin(u), front + thick * np.sin(v)], axis=-1)
        return _outward(_grid(points))

    middle = 0.5 * (eyes[0] + eyes[1])
    return concatenate_meshes([*(ring(eye, 0.024, 0.003) for eye in eyes), ring(middle, 0.006, 0.002)])


def _hat(mannequin: Mannequin) -> TriangleMesh:
    """A crown with a brim, open below."""
    centre, half = _head(mannequin)
    height = centre[1] + 0.25 * half[1]
    turns = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    profile = [(1.9, 0.0), (1.3, 0.0), (1.22, 0.2), (1.2, 0.7), (1.1, 1.0), (0.5, 1.1), (0.02, 1.12)]
    rings = [
        np.stack(
            [
                centre[0] + k * half[0] * np.cos(turns),
                0 * turns + height + up * half[1],
                centre[2] + k * half[2] * np.sin(turns),
            ],
            axis=-1,
        )
        for k, up in profile
    ]
    mesh = _grid(np.stack(rings), closed=False)
    upwards = mesh.face_normals[:, 1].mean() > 0
    return mesh if upwards else TriangleMesh(mesh.vertices, mesh.faces[:, ::-1])


def bag_on_the_back(mannequin: Mannequin) -> TriangleMesh:
    """A closed box, rounded, that touches the back."""
    spine, points = mannequin.joints["spine3"], mannequin.skin.vertices
    near = (np.abs(points[:, 0]) < 0.05) & (np.abs(points[:, 1] - spine[1]) < 0.05)
    back = points[near, 2].min()
    u, v = np.meshgrid(
        np.linspace(0.04, np.pi - 0.04, 14), np.linspace(0, 2 * np.pi, 24, endpoint=False), indexing="ij"
    )
    ball = np.stack([np.sin(u) * np.cos(v), np.cos(u), np.sin(u) * np.sin(v)], axis=-1)
    box = np.sign(ball) * np.abs(ball) ** 0.5 * [0.14, 0.17, 0.06]
    mesh = _grid(box + [0.0, spine[1] - 0.05, back - 0.085], closed=False)
    # Close the poles by fans.
    count = mesh.vertex_count
    poles = np.array([[0.0, spine[1] - 0.05 + 0.17, back - 0.085], [0.0, spine[1] - 0.05 - 0.17, back - 0.085]])
    first, last = np.arange(24), count - 24 + np.arange(24)
    fans = [
        np.stack([np.roll(first, -1), first, np.full(24, count)], axis=1),
        np.stack([last, np.roll(last, -1), np.full(24, count + 1)], axis=1),
    ]
    return _outward(TriangleMesh(np.concatenate([mesh.vertices, poles]), np.concatenate([mesh.faces, *fans])))
