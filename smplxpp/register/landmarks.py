"""Find named landmarks on a body as joints or weighted means of vertices; read and write landmarks placed by hand."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from jaxtyping import Float, Float64, Int64

from smplxpp.body import BodyModel
from smplxpp.core.errors import InputError, one_line
from smplxpp.core.files import as_numbers, as_object, atomic_write_text, read_json
from smplxpp.register.kinematics import BodyPoints, Kinematics, PointsMotion, Posture

FINGERS = ("index", "middle", "pinky", "ring", "thumb")
"""Parts of the names of the fingers' joints."""
# Substitutes for points whose place the body's file does not give.
_SUBSTITUTES = {"nose": "face_30", "left_eye": "left_eye_smplhf", "right_eye": "right_eye_smplhf"}

_Mean = tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, " n"]]


@dataclass(frozen=True, eq=False)
class LandmarkModel:
    """K named points on a body: point k is joint `joint_index[k]`, or, where that is -1, the mean of the vertices
    `vertex_index[k]` with the weights `vertex_weight[k]`.

    Attributes:
        names: of the points that the body has, in the order in which they were requested.
        unknown: requested names that the body does not have.
        vertex_index: padded with 0.
        vertex_weight: rows sum to 1 and are padded with 0; rows of joints are 0.
        joint_index: -1 where a point is a mean of vertices.
    """

    names: tuple[str, ...]
    unknown: tuple[str, ...]
    vertex_index: Int64[np.ndarray, "K M"]
    vertex_weight: Float64[np.ndarray, "K M"]
    joint_index: Int64[np.ndarray, " K"]

    __repr__ = one_line

    @staticmethod
    def of(body: BodyModel, names: Sequence[str]) -> LandmarkModel:
        """Find the named points on a body.

        Joints are found by their names; `coco_*`, nose, eyes, ears, toes, heels and `face_*` by the body's own
        landmarks. If the body has none, `coco_left_hip` and the like are the joints of that name (some centimetres off
        at hips and shoulders), the nose is `face_30`, and the eyes are their joints. The tip of a finger is the mean of
        the vertices farthest along its last bone.
        """
        # Look up every name: an index of a joint, or vertices with weights.
        joints = {name: k for k, name in enumerate(body.joint_names)}
        known, rows = [], []
        for name in names:
            found = _place(body, joints, name)
            if found is not None:
                known.append(name)
                rows.append(found)
        # Pad the vertices to one width.
        width = max((len(found[0]) for found in rows if not isinstance(found, int)), default=0)
        index, weight = np.zeros((len(rows), width), dtype=np.int64), np.zeros((len(rows), width))
        joint_index = np.full(len(rows), -1, dtype=np.int64)
        for k, found in enumerate(rows):
            if isinstance(found, int):
                joint_index[k] = found
            else:
                index[k, : len(found[0])], weight[k, : len(found[0])] = found
        unknown = tuple(name for name in names if name not in known)
        return LandmarkModel(tuple(known), unknown, index, weight, joint_index)

    def points(
        self, vertices: Float[np.ndarray, "V 3"], joints: Float[np.ndarray, "J 3"]
    ) -> Float64[np.ndarray, "K 3"]:
        """Return the points of a posed body.

        Args:
            vertices: of one frame, in world coordinates, metres.
            joints: of the same frame.
        """
        means = np.einsum("km,kmx->kx", self.vertex_weight, np.asarray(vertices, dtype=np.float64)[self.vertex_index])
        return np.where((self.joint_index >= 0)[:, None], np.asarray(joints)[self.joint_index], means)


@dataclass(frozen=True, eq=False)
class LandmarkPoints:
    """Landmarks as sparse linear combinations of skinned points, which makes their derivatives linear as well.

    Attributes:
        carriers: the N vertices and joints that the landmarks are made of.
        matrix: (K, N) weights of the carriers in each landmark.
    """

    carriers: BodyPoints
    matrix: sp.csr_matrix

    @staticmethod
    def of(body: BodyModel, landmarks: LandmarkModel) -> LandmarkPoints:
        """Collect the vertices and joints that landmarks use, each vertex once."""
        joints = np.flatnonzero(landmarks.joint_index >= 0)
        made = np.flatnonzero(landmarks.joint_index < 0)
        used, place = np.unique(landmarks.vertex_index[made], return_inverse=True)
        parts = [
            BodyPoints.of_vertices(body, used),
            BodyPoints.of_joints(body, landmarks.joint_index[joints]),
        ]
        # One row a landmark: its weights over the vertices, or a single 1 in the column of its joint. The columns of
        # the joints follow those of the vertices, in the order of the carriers.
        columns = np.concatenate([place.reshape(-1), len(used) + np.arange(len(joints))])
        rows = np.concatenate([np.repeat(made, landmarks.vertex_index.shape[1]), joints])
        values = np.concatenate([landmarks.vertex_weight[made].reshape(-1), np.ones(len(joints))])
        shape = (len(landmarks.names), len(used) + len(joints))
        return LandmarkPoints(BodyPoints.joined(parts), sp.csr_matrix((values, (rows, columns)), shape=shape))

    def points(self, kinematics: Kinematics, posture: Posture) -> Float64[np.ndarray, "K 3"]:
        """Return the posed landmarks, metres."""
        return self.matrix @ kinematics.points(self.carriers, posture)

    def motion(self, kinematics: Kinematics, posture: Posture) -> tuple[PointsMotion, Float64[np.ndarray, "K 3"]]:
        """Return the carriers with their derivatives, and the posed landmarks."""
        motion = kinematics.motion(self.carriers, posture)
        return motion, self.matrix @ motion.points

    def combined(self, jacobian: Float64[np.ndarray, "N 3 P"]) -> Float64[np.ndarray, "K 3 P"]:
        """Return the landmarks' derivatives from those of their carriers."""
        # The combination is constant, so that the derivatives of landmarks combine as their carriers do.
        flat = self.matrix @ jacobian.reshape(len(jacobian), -1)
        return np.asarray(flat).reshape(-1, *jacobian.shape[1:])


def is_finger(name: str) -> bool:
    """Return whether a joint or landmark belongs to a finger."""
    return any(finger in name for finger in FINGERS)


def visible_vertices(body: BodyModel) -> Int64[np.ndarray, " n"]:
    """Return the vertices that images and scans can show, which are all but those of eyes, teeth and tongue."""
    return np.flatnonzero(body.outer_skin)


def _place(body: BodyModel, joints: dict[str, int], name: str) -> int | _Mean | None:
    # From exact to approximate: a joint, a landmark of the body's file, a fingertip, and last a substitute.
    if name in joints:
        return joints[name]
    if name in body.landmarks:
        return _sparsified(body, *body.landmarks[name])
    if name.endswith("_tip"):
        return _fingertip(body, joints.get(f"{name.removesuffix('_tip')}3"))
    substitute = _SUBSTITUTES.get(name, name.removeprefix("coco_"))
    return None if substitute == name else _place(body, joints, substitute)


def _sparsified(body: BodyModel, index: Int64[np.ndarray, " n"], weight: Float64[np.ndarray, " n"]) -> _Mean:
    """Keep the vertices of largest weight and correct their weights so that the point on the mean shape stays.

    The correction is the weighted least-norm solution of `sum w = 1, sum w v = point`: large weights change most.
    """
    most = 64  # vertices; regressors of hundreds of vertices then agree to 0.2 mm in any pose and shape
    if len(index) <= most:
        return index, weight
    heavy = np.sort(np.argsort(-weight, kind="stable")[:most])
    points, kept = body.v_template[index[heavy]], weight[heavy]
    A = np.concatenate([np.ones((1, len(heavy))), points.T])
    target = np.concatenate([[1.0], weight @ body.v_template[index]])
    # With W = diag(w), minimise sum dw_i^2 / w_i so that A (w + dw) = target: dw = W A^T (A W A^T)^-1 (target - A w).
    scaled = A * kept
    kept = kept + scaled.T @ np.linalg.lstsq(scaled @ A.T, target - A @ kept, rcond=None)[0]
    return index[heavy], kept / kept.sum()


def _fingertip(body: BodyModel, joint: int | None) -> _Mean | None:
    """Return the mean of the vertices that lie farthest along a finger's last bone on the mean shape."""
    own_weight, count = 0.5, 4  # least skinning weight of a vertex of that bone; vertices that are averaged
    if joint is None:
        return None
    rest = body.joint_regressor[[joint, body.parents[joint]]] @ body.v_template
    own = np.flatnonzero(body.weights[:, joint] > own_weight)
    if not len(own):
        return None
    # Coordinate along the direction from the parent's joint to this one, which the last bone continues.
    along = (body.v_template[own] - rest[0]) @ (rest[0] - rest[1])
    far = np.sort(own[np.argsort(-along, kind="stable")[:count]])
    return far.astype(np.int64), np.full(len(far), 1.0 / len(far))


def read_landmarks(path: str | Path) -> dict[str, Float64[np.ndarray, " 3"]]:
    """Read points by name, metres, +Y up, from a JSON object: `{"nose": [0.01, 1.62, 0.11], ...}`.

    Names are those of `smplxpp.core.keypoints`: the name of a joint is its centre, inside the limb; `nose`, `left_ear`,
    `left_heel`, `left_big_toe`, `left_index_tip`, `face_30` and the like lie on the skin.

    Raises:
        InputError: no such file, another layout, more than 500 names, or points farther than a kilometre away.
    """
    most_landmarks, longest_name = 500, 64  # of a file that a person has written
    farthest = 1e3  # metres from the origin; files in millimetres exceed it
    subject = f"landmarks {path}"
    content = as_object(read_json(path, subject="landmarks"), subject=subject)
    if len(content) > most_landmarks or any(len(name) > longest_name for name in content):
        raise InputError(
            subject,
            expected=f"at most {most_landmarks} names of at most {longest_name} letters",
            received=f"{len(content)} names, the longest of {max(map(len, content))} letters",
        )
    points = {name: as_numbers(point, (3,), subject=f"{subject}: {name}") for name, point in content.items()}
    far = [name for name, point in points.items() if np.abs(point).max() > farthest]
    if far:
        raise InputError(
            f"{subject}: {far[0]}",
            expected="a point in metres, as the scan has them once it is read",
            received=f"{np.array2string(points[far[0]], precision=1)}",
            remedy="place it in `smplxpp label RUN`, or divide by the scan's units",
        )
    return points


def write_landmarks(path: str | Path, points: Mapping[str, Float[np.ndarray, " 3"]]) -> None:
    """Write points as `read_landmarks` reads them, rounded to 0.1 mm; the file is replaced whole or not at all."""
    rows = [f"{json.dumps(name)}: {json.dumps(np.round(point, 4).tolist())}" for name, point in points.items()]
    atomic_write_text(path, "{\n " + ",\n ".join(rows) + "\n}\n" if rows else "{}\n")
