"""Locate every face of a scan on the fitted body: region, place along the limb, azimuth, distance.

Places are in metres of a standard person whose joints have fixed heights, so that rules about clothes hold for every
size: a sleeve's length is a share of the arm.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, InputError, TriangleMesh, row_lengths
from smplxpp.core.mesh import cross_rows
from smplxpp.core.topology import face_adjacency
from smplxpp.segment.graph_cut import SmoothingConfig, edge_weights

HEAD, NECK, TRUNK, ARM, HAND, LEG, FOOT = range(7)
REGION_NAMES = ("head", "neck", "trunk", "arm", "hand", "leg", "foot")

# Heights of the standard person's joints; arms are measured outwards from the shoulder joint.
SOLE, ANKLE, KNEE, HIP, NECK_BASE, HEAD_BASE, TOP = 0.0, 0.08, 0.48, 0.90, 1.45, 1.54, 1.75
ELBOW, WRIST, FINGERTIP = 0.26, 0.50, 0.68
# Weight of normals in the search for the nearest body vertex, metres: opposite normals count as 12 cm of distance, so
# that an arm beside the trunk is not taken for it.
_NORMAL_WEIGHT = 0.06
_FINGERS = ("index", "middle", "pinky", "ring", "thumb", "_hand")


@dataclass(frozen=True, eq=False)
class BodyChart:
    """Places on a body, for its vertices or a scan's faces.

    Attributes:
        region: one of `HEAD` to `FOOT`.
        height: along the column of feet, legs, trunk, neck and head, standard metres (`SOLE` to `TOP`).
        reach: along the arm from the shoulder joint, standard metres (0 to `FINGERTIP`); negative on the trunk.
        azimuth: about the head's (and the trunk's) vertical axis, radians: 0 in front, pi at the back.
        turn: about the axis of the own limb, on the trunk the azimuth, radians.
        face_height: within the head: 0 at the chin, 1 at the top.
        distance: of a scan's faces to the body, metres along the body's normal, negative within; 0 on the body.
        side: +1 left, -1 right.
    """

    region: Int64[np.ndarray, " n"]
    height: Float64[np.ndarray, " n"]
    reach: Float64[np.ndarray, " n"]
    azimuth: Float64[np.ndarray, " n"]
    turn: Float64[np.ndarray, " n"]
    face_height: Float64[np.ndarray, " n"]
    distance: Float64[np.ndarray, " n"]
    side: Int64[np.ndarray, " n"]

    def __getitem__(self, index: np.ndarray) -> BodyChart:
        names = ("region", "height", "reach", "azimuth", "turn", "face_height", "distance", "side")
        return BodyChart(*(getattr(self, name)[index] for name in names))

    @property
    def face_core(self) -> Bool[np.ndarray, " n"]:
        """Return the places well within the face, between chin and brows."""
        inside = (self.face_height > 0.05) & (self.face_height < 0.62)
        return (self.region == HEAD) & (np.abs(self.azimuth) < 0.8) & inside

    @property
    def hand_core(self) -> Bool[np.ndarray, " n"]:
        """Return the places well within the hands, 4 cm from the wrist on."""
        return (self.region == HAND) & (self.reach > WRIST + 0.04)

    @property
    def skull_cap(self) -> Bool[np.ndarray, " n"]:
        """Return the places where hair grows: the top and the back of the head."""
        back = (np.abs(self.azimuth) > 2.0) & (self.face_height > 0.4)
        return (self.region == HEAD) & (back | (self.face_height > 0.9))


@lru_cache(maxsize=1)  # five steps of one labelling ask for the same
def chart_of_body(body: BodyModel, params: BodyParams) -> BodyChart:
    """Return the places of a body's own vertices, from its joints and weights in the rest pose of one frame's shape."""
    # The region of a vertex is that of the joints with the largest sum of skin weights.
    rest = body.forward(params)
    vertices, joints = rest.rest_vertices[0], rest.rest_joints[0]
    names = list(body.joint_names)
    at = {name: joints[k] for k, name in enumerate(names)}

    def share(*wanted: str) -> np.ndarray:
        chosen = [k for k, name in enumerate(names) if any(part in name for part in wanted)]
        return body.weights[:, chosen].sum(axis=1)

    shares = np.stack(
        [
            share("head", "jaw", "eye"),
            share("neck"),
            share("pelvis", "spine", "collar"),
            share("shoulder", "elbow"),
            share("wrist", *_FINGERS),
            share("hip", "knee"),
            share("ankle", "foot"),
        ]
    )
    region = shares.argmax(axis=0)
    x, y, z = (vertices - [at["pelvis"][0], 0.0, 0.0]).T
    head = region == HEAD
    if not head.any():
        raise InputError("body model", expected="vertices that follow a head", received=f"none in {body.name!r}")
    # Heights are interpolated between the joints' heights and the standard ones; so is the reach along each arm.
    mean = {name: 0.5 * (at[f"left_{name}"] + at[f"right_{name}"]) for name in ("hip", "knee", "ankle")}
    knots = [y.min(), mean["ankle"][1], mean["knee"][1], mean["hip"][1], at["neck"][1], at["head"][1], y.max()]
    height = np.interp(y, np.maximum.accumulate(knots), [SOLE, ANKLE, KNEE, HIP, NECK_BASE, HEAD_BASE, TOP])
    reach = np.empty(len(vertices))
    for sign, side in ((1, "left"), (-1, "right")):
        own = np.sign(x) * sign >= 0
        start = sign * (at[f"{side}_shoulder"][0] - at["pelvis"][0])
        elbow = start + float(np.linalg.norm(at[f"{side}_elbow"] - at[f"{side}_shoulder"]))
        wrist = elbow + float(np.linalg.norm(at[f"{side}_wrist"] - at[f"{side}_elbow"]))
        tip = max((sign * x).max(), wrist + 0.01)
        reach[own] = np.interp(sign * x[own], [0.0, start, elbow, wrist, tip], [-start, 0.0, ELBOW, WRIST, FINGERTIP])
    # Azimuth about the middle of the head, on the trunk about the spine; face height from the chin to the top.
    middle = 0.5 * (z[head].min() + z[head].max())
    azimuth = np.where(region >= TRUNK, np.arctan2(x, z - at["spine2"][2]), np.arctan2(x, z - middle))
    chin = y[head & (z > middle)].min()
    face_height = (y - chin) / (y.max() - chin)
    left = np.where(x >= 0, 1, -1)
    turn = _turns(vertices, region, azimuth, at)
    return BodyChart(region, height, reach, azimuth, turn, face_height, np.zeros(len(y)), left)


def _turns(
    vertices: np.ndarray, region: np.ndarray, azimuth: np.ndarray, at: dict[str, np.ndarray]
) -> Float64[np.ndarray, " V"]:
    """Return the angle of each vertex about the bones of its own limb, in the rest pose; elsewhere the azimuth."""
    out = azimuth.copy()
    x, y, z = vertices.T
    middle = at["pelvis"][0]
    for sign, side in ((1, "left"), (-1, "right")):
        own = sign * (x - middle) >= 0
        # Bones are polylines: of the leg over y, of the arm over the distance from the middle of the body.
        leg = own & np.isin(region, (LEG, FOOT))
        bones = np.stack([at[f"{side}_{name}"] for name in ("ankle", "knee", "hip")])
        center = [np.interp(y[leg], bones[:, 1], bones[:, axis]) for axis in (0, 2)]
        out[leg] = np.arctan2(x[leg] - center[0], z[leg] - center[1])
        arm = own & np.isin(region, (ARM, HAND))
        bones = np.stack([at[f"{side}_{name}"] for name in ("shoulder", "elbow", "wrist")])
        along = sign * (bones[:, 0] - middle)
        center = [np.interp(sign * (x[arm] - middle), along, bones[:, axis]) for axis in (1, 2)]
        out[arm] = np.arctan2(y[arm] - center[0], z[arm] - center[1])
    return out


def chart_of_scan(
    mesh: TriangleMesh, body: BodyModel, params: BodyParams, *, posed: TriangleMesh | None = None
) -> BodyChart:
    """Return the places of a scan's faces, from the body vertex that is nearest in position and normal.

    A hand that is hidden, in a pocket or under a coat, has no faces: what lies nearest to it is cloth of the trunk, the
    legs or the arm.

    Args:
        mesh: the scan, posed as `params` (one frame) poses the body, metres.
        posed: the body where it lies; as `params` pose it by default, see `settled_body`.

    Raises:
        InputError: more than one frame.
    """
    if len(params) != 1:
        raise InputError("body parameters", expected="one frame", received=f"{len(params)} frames")
    own = chart_of_body(body, params)
    posed = posed or body.mesh(body.forward(params).vertices[0])
    chart = _places(mesh, own, posed, np.ones(len(posed.vertices), dtype=bool))
    hidden = [side for side in (1, -1) if _hidden_hand(mesh, own, posed, chart, side)]
    if not hidden:
        return chart
    return _places(mesh, own, posed, ~((own.region == HAND) & np.isin(own.side, hidden)))


def settled_body(mesh: TriangleMesh, body: BodyModel, params: BodyParams) -> TriangleMesh:
    """Return the posed body, its limbs moved onto a clothed scan, so that no error of the pose passes for clothes.

    A limb that is turned by some degrees lies too deep on one side and off the cloth on the other, by more than cloth
    is thick. Every body part p moves rigidly by a small motion (t_p, w_p), and clothes have a thickness h_r in each
    ring of 6 cm along column and arms. Of the scan's faces at x with nearest body vertices v of normals n and skin
    weights W, the motion minimises

        sum_faces rho(n.(x - v) - n.sum_p W_p (t_p + w_p x (v - c_p)) - h_r) + sum_p |t_p|^2 / (15 mm)^2
        + |w_p|^2 / (4 degrees)^2 + sum_joints |gap between its two parts|^2 / (4 mm)^2 + sum_r h_r^2 / (10 mm)^2

    by iterated least squares with Tukey's weights rho, so that skirts, hair and things do not pull. The thickness keeps
    thick clothes from pulling, too, and what differs all round a limb is left to be found.

    Args:
        mesh: the scan, metres.
        body: the body model.
        params: one frame, in the pose of the scan.
    """
    own, frame = chart_of_body(body, params), body.forward(params).frame(0)
    start, weights, centers, joints = frame.vertices, *_parts(body, frame.joints)
    count = len(centers)
    # A sample of faces by area; 5000 are some 60 a ring.
    points, normals = mesh.face_centers, mesh.face_normals
    if len(points) > 5000:
        chosen = np.random.default_rng(0).choice(
            len(points), 5000, replace=False, p=mesh.face_areas / mesh.face_areas.sum()
        )
        points, normals = points[chosen], normals[chosen]
    # Rings of 6 cm: of the column, of the arms, hands and neck as one each; the head's face and hair have none.
    ring = np.zeros(len(start), dtype=np.int64)
    for mask, place, first in ((in_column(own), own.height, 1), (own.region == ARM, own.reach + 0.3, 31)):
        ring[mask] = first + np.clip(place[mask] / 0.06, 0, 25).astype(np.int64)
    ring[own.region == HAND], ring[own.region == NECK] = 57, 58
    # The terms that do not depend on faces.
    prior = np.diag([*np.tile([0.015**-2] * 3 + [np.radians(4.0) ** -2] * 3, count), *[0.01**-2] * 59])
    for child, parent in joints:
        gap = np.zeros((3, len(prior)))
        gap[:, 6 * child : 6 * child + 3] = np.eye(3)
        across = np.cross(np.eye(3), centers[parent] - centers[child])
        gap[:, 6 * parent : 6 * parent + 6] = -np.hstack([np.eye(3), across])
        prior += gap.T @ gap / 0.004**2
    # Correspondences, then the weights of the faces, in turn. Faces together count as 1000 of 6 mm of noise, because
    # neighbours err together; Tukey's weights end at 6 cm, then at 3.6 cm.
    found: np.ndarray = np.zeros(len(prior))
    moved = start
    for k in range(8):
        turned = body.mesh(moved).vertex_normals
        tree = cKDTree(np.concatenate([moved, _NORMAL_WEIGHT * turned], axis=1))
        at = tree.query(np.concatenate([points, _NORMAL_WEIGHT * normals], axis=1))[1]
        normal = turned[at]
        off = row_lengths(points - moved[at]) > 0.05
        target = np.einsum("ij,ij->i", points - start[at], normal)
        blocks = list(_motion_blocks(normal, start[at], weights[at], centers, ring[at]))
        for _ in range(2):
            matrix, right = prior.copy(), np.zeros(len(prior))
            for chosen, columns, rows in blocks:
                left = (target[chosen] - rows @ found[columns]) / (0.06 if k < 4 else 0.036)
                share = np.where(off[chosen], 0.0, np.maximum(1.0 - left**2, 0.0) ** 2) * (1000 / len(at) / 0.006**2)
                weighted = rows * share[:, None]
                matrix[np.ix_(columns, columns)] += rows.T @ weighted
                right[columns] += weighted.T @ target[chosen]
            found = np.linalg.solve(matrix, right)
        motion = found[: 6 * count].reshape(count, 6)
        # sum_p W_p (t_p + w_p x (v - c_p)).
        turn = weights @ motion[:, 3:]
        shift = weights @ (motion[:, :3] - np.cross(motion[:, 3:], centers))
        moved = start + shift + np.cross(turn, start)
    return body.mesh(moved)


def _motion_blocks(
    normal: Float64[np.ndarray, "N 3"],
    place: Float64[np.ndarray, "N 3"],
    weights: Float64[np.ndarray, "N P"],
    centers: Float64[np.ndarray, "P 3"],
    ring: Int64[np.ndarray, " N"],
) -> Iterator[tuple[Int64[np.ndarray, " n"], Int64[np.ndarray, " C"], Float64[np.ndarray, "n C"]]]:
    """Yield the linear system of `settled_body` in blocks of faces that one part leads: a tenth of its columns each.

    Columns are six of each part that has a weight in the block, then the block's rings.

    Args:
        normal: of the nearest vertices.
        place: of these, metres.
        weights: of the P parts there.
        centers: of the parts, metres.
        ring: of the vertices.

    Yields:
        The faces, the columns, and the rows of the faces in these columns.
    """
    lead = weights.argmax(axis=1)
    for part in np.unique(lead):
        chosen = np.flatnonzero(lead == part)
        used, own = np.flatnonzero(weights[chosen].any(axis=0)), np.unique(ring[chosen])
        along = np.broadcast_to(normal[chosen][:, None], (len(chosen), len(used), 3))
        about = cross_rows((place[chosen][:, None] - centers[used]).reshape(-1, 3), along.reshape(-1, 3))
        parts = np.concatenate([along, about.reshape(along.shape)], axis=2)
        moved = (weights[chosen][:, used, None] * parts).reshape(len(chosen), -1)
        rows = np.concatenate([moved, ring[chosen][:, None] == own], axis=1)
        columns = np.concatenate([(6 * used[:, None] + np.arange(6)).ravel(), 6 * weights.shape[1] + own])
        yield chosen, columns, rows


def _parts(
    body: BodyModel, joints: np.ndarray
) -> tuple[Float64[np.ndarray, "V P"], Float64[np.ndarray, "P 3"], list[tuple[int, int]]]:
    """Return skin weights of the rigid parts, their joints' places, and which part follows which.

    Fingers, jaw and eyes move with the hand and the head.
    """
    small = (*_FINGERS, "jaw", "eye")
    part = np.zeros(body.joint_count, dtype=np.int64)
    kept: list[int] = []
    follows = []
    for k, (name, parent) in enumerate(zip(body.joint_names, body.parents, strict=True)):
        if parent >= 0 and any(word in name for word in small):
            part[k] = part[parent]
            continue
        part[k] = len(kept)
        kept.append(k)
        if parent >= 0:
            follows.append((int(part[k]), int(part[parent])))
    weights = np.stack([body.weights[:, part == p].sum(axis=1) for p in range(len(kept))], axis=1)
    return weights, joints[kept], follows


def _places(mesh: TriangleMesh, own: BodyChart, posed: TriangleMesh, used: Bool[np.ndarray, " V"]) -> BodyChart:
    """Return the places of a scan's faces from the used vertices of the posed body, whose places are `own`."""
    normals, among = posed.vertex_normals, np.flatnonzero(used)
    tree = cKDTree(np.concatenate([posed.vertices, _NORMAL_WEIGHT * normals], axis=1)[among])
    points = mesh.face_centers
    nearest = among[tree.query(np.concatenate([points, _NORMAL_WEIGHT * mesh.face_normals], axis=1))[1]]
    offset = points - posed.vertices[nearest]
    along = np.einsum("ij,ij->i", offset, normals[nearest])
    # Near the body the distance is that to the vertex's tangent plane, farther than 4 cm that to the vertex.
    far = row_lengths(offset)
    distance = np.where(far < 0.04, along, np.copysign(far, along))
    # The body's vertices are centimetres apart along a shin, so that heights go on between them by their gradient.
    place = own[nearest]
    beside = offset - along[:, None] * normals[nearest]
    change = _between_vertices(posed, np.stack([own.height, own.reach]), nearest, beside)
    height, reach = own.height[nearest] + change[0], own.reach[nearest] + change[1]
    return replace(place, height=height, reach=reach, distance=distance)


_RUNS_ON, _HAND_SHOWN, _SHOWN_WITHIN = 50.0, 0.4, 0.012
"""Centimetres of smooth border with trunk and legs from which the faces at a hand are cloth that runs on, three times
round a wrist; the share of a hand that the scan shows, and within how many metres. Hands in a pocket or under a cape
show 0.26 to 0.32 and less, hands beside a jacket, or with a folder in them, 0.46 to 0.56."""


def _hidden_hand(mesh: TriangleMesh, own: BodyChart, posed: TriangleMesh, chart: BodyChart, side: int) -> bool:
    """Return whether the faces charted at a hand are cloth: they go on smoothly into trunk and legs."""
    here = (chart.region == HAND) & (chart.side == side)
    if not here.any():
        return False
    pairs, ends = face_adjacency(mesh.faces)
    border = here[pairs[:, 0]] != here[pairs[:, 1]]
    outer = chart.region[np.where(here[pairs[:, 0]], pairs[:, 1], pairs[:, 0])]
    border &= np.isin(outer, (TRUNK, LEG))
    # A hand on a hip lies in a concave fold, across which a border costs little of its length.
    length = np.linalg.norm(np.diff(mesh.vertices[ends], axis=1)[:, 0], axis=1)
    smooth = edge_weights(mesh, pairs, ends, SmoothingConfig(smoothness=1.0, floor=0.0, eta_convex=0.0))
    if 100.0 * length.mean() * smooth[border].sum() < _RUNS_ON:
        return False
    # The share of the hand's vertices with a face near that looks the same way.
    hand = np.flatnonzero((own.region == HAND) & (own.side == side) & (own.reach > WRIST + 0.02))
    points, normals = posed.vertices[hand], posed.vertex_normals[hand]
    near = cKDTree(mesh.face_centers).query_ball_point(points, _SHOWN_WITHIN)
    shown = [bool((mesh.face_normals[found] @ normal > 0.5).any()) for found, normal in zip(near, normals, strict=True)]
    return float(np.mean(shown)) < _HAND_SHOWN


def _between_vertices(
    posed: TriangleMesh, values: Float64[np.ndarray, "K V"], nearest: np.ndarray, beside: Float64[np.ndarray, "M 3"]
) -> Float64[np.ndarray, "K M"]:
    """Return by how much functions of the vertices change from the nearest vertex over an offset along the surface.

    The gradient g at a vertex minimises sum_j (value_j - value - g (x_j - x))^2 over its neighbours j; the change is
    bounded by half of the largest difference to a neighbour, where the next vertex begins.
    """
    count = len(posed.vertices)
    ends = np.concatenate([posed.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    start, end = np.concatenate([ends, ends[:, ::-1]]).T
    step = posed.vertices[end] - posed.vertices[start]
    matrix = np.empty((count, 3, 3))
    for i, j in np.ndindex(3, 3):
        matrix[:, i, j] = np.bincount(start, step[:, i] * step[:, j], count)
    # The normal direction, in which the neighbours do not lie, is kept from the gradient by a small regularisation.
    matrix += 1e-3 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
    out = np.empty((len(values), len(nearest)))
    for row, value in zip(out, values, strict=True):
        rise = value[end] - value[start]
        right = np.stack([np.bincount(start, step[:, i] * rise, count) for i in range(3)], axis=1)
        gradient = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
        bound = np.zeros(count)
        np.maximum.at(bound, start, 0.5 * np.abs(rise))
        row[:] = np.clip(np.einsum("ij,ij->i", gradient[nearest], beside), -bound[nearest], bound[nearest])
    return out


def in_column(chart: BodyChart) -> np.ndarray:
    """Return the faces of feet, legs and trunk."""
    return np.isin(chart.region, (FOOT, LEG, TRUNK))


def in_arm(chart: BodyChart) -> np.ndarray:
    """Return the faces of arms and hands."""
    return np.isin(chart.region, (ARM, HAND))
