"""Locate every face of a scan on the fitted body: region, place along the limb, azimuth, distance.

Places are in metres of a standard person whose joints have fixed heights, so that rules about clothes hold for every
size: a sleeve's length is a share of the arm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, InputError, TriangleMesh, row_lengths
from smplxpp.core.topology import face_adjacency
from smplxpp.segment.smoothing import SmoothingConfig, edge_weights

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


def chart_of_scan(mesh: TriangleMesh, body: BodyModel, params: BodyParams) -> BodyChart:
    """Return the places of a scan's faces, from the body vertex that is nearest in position and normal.

    A hand that is hidden, in a pocket or under a coat, has no faces: what lies nearest to it is cloth of the trunk, the
    legs or the arm.

    Args:
        mesh: the scan, posed as `params` (one frame) poses the body, metres.

    Raises:
        InputError: more than one frame.
    """
    if len(params) != 1:
        raise InputError("body parameters", expected="one frame", received=f"{len(params)} frames")
    own = chart_of_body(body, params)
    posed = body.mesh(body.forward(params).vertices[0])
    chart = _places(mesh, own, posed, np.ones(len(posed.vertices), dtype=bool))
    hidden = [side for side in (1, -1) if _hidden_hand(mesh, own, posed, chart, side)]
    if not hidden:
        return chart
    return _places(mesh, own, posed, ~((own.region == HAND) & np.isin(own.side, hidden)))


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
    height, reach = (
        value[nearest] + _between_vertices(posed, value, nearest, beside) for value in (own.height, own.reach)
    )
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
    posed: TriangleMesh, value: Float64[np.ndarray, " V"], nearest: np.ndarray, beside: Float64[np.ndarray, "M 3"]
) -> Float64[np.ndarray, " M"]:
    """Return by how much a function of the vertices changes from the nearest vertex over an offset along the surface.

    The gradient g at a vertex minimises sum_j (value_j - value - g (x_j - x))^2 over its neighbours j; the change is
    bounded by half of the largest difference to a neighbour, where the next vertex begins.
    """
    ends = np.concatenate([posed.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    start, end = np.concatenate([ends, ends[:, ::-1]]).T
    step, rise = posed.vertices[end] - posed.vertices[start], value[end] - value[start]
    matrix, right = np.zeros((len(value), 3, 3)), np.zeros((len(value), 3))
    np.add.at(matrix, start, step[:, :, None] * step[:, None, :])
    np.add.at(right, start, step * rise[:, None])
    # The normal direction, in which the neighbours do not lie, is kept from the gradient by a small regularisation.
    damping = 1e-3 * np.trace(matrix, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 1e-12 * np.eye(3)
    gradient = np.linalg.solve(matrix + damping, right[:, :, None])[:, :, 0]
    bound = np.zeros(len(value))
    np.maximum.at(bound, start, 0.5 * np.abs(rise))
    return np.clip(np.einsum("ij,ij->i", gradient[nearest], beside), -bound[nearest], bound[nearest])


def in_column(chart: BodyChart) -> np.ndarray:
    """Return the faces of feet, legs and trunk."""
    return np.isin(chart.region, (FOOT, LEG, TRUNK))


def in_arm(chart: BodyChart) -> np.ndarray:
    """Return the faces of arms and hands."""
    return np.isin(chart.region, (ARM, HAND))
