"""Files of splats read by programs that are not ours, as `Splats`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from avatar.formats import Splats
from avatar.runtime.splatting import WorldSplats

C0 = 0.28209479177387814
# Joints of WebAvatar's Unity package.
_PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15]
_PARENTS += [20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38]
_PARENTS += [21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53]


def gsply_splats(path: Path) -> Splats:
    """Read a PLY, an SPZ or a SOG by gsply."""
    import gsply
    from gsply.sog_reader import sogread

    data = {".ply": gsply.plyread, ".spz": gsply.read_spz, ".sog": sogread}[path.suffix](path)
    count = len(data.means)
    rest = np.zeros((count, 0, 3)) if data.shN is None else np.asarray(data.shN).reshape(count, -1, 3)
    return Splats(
        means=data.means,
        normals=np.zeros((count, 3)),
        f_dc=data.sh0,
        f_rest=rest,
        opacity_logits=data.opacities,
        log_scales=data.scales,
        quats=data.quats,
    )


def pygltflib_splats(path: Path) -> Splats:
    """Read a GLB by pygltflib and numpy, as KHR_gaussian_splatting says."""
    import pygltflib

    gltf = pygltflib.GLTF2.load(str(path))
    blob = gltf.binary_blob()
    primitive = gltf.meshes[gltf.nodes[gltf.scenes[gltf.scene].nodes[0]].mesh].primitives[0]

    def values(name: str) -> np.ndarray:
        accessor = gltf.accessors[getattr(primitive.attributes, name)]
        view = gltf.bufferViews[accessor.bufferView]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor.type]
        assert accessor.componentType == pygltflib.FLOAT
        begin = (view.byteOffset or 0) + (accessor.byteOffset or 0)
        return np.frombuffer(blob, "<f4", accessor.count * width, begin).reshape(-1, width)

    prefix = "KHR_gaussian_splatting:"
    names = [f"SH_DEGREE_{d}_COEF_{k}" for d in range(1, 4) for k in range(2 * d + 1)]
    rest = [values(prefix + name) for name in names if hasattr(primitive.attributes, prefix + name)]
    means, opacities = values("POSITION"), values(prefix + "OPACITY")[:, 0].astype(np.float64)
    return Splats(
        means=means,
        normals=np.zeros_like(means),
        f_dc=values(prefix + "SH_DEGREE_0_COEF_0"),
        f_rest=np.stack(rest, axis=1) if rest else np.zeros((len(means), 0, 3)),
        opacity_logits=_logits(opacities),
        log_scales=np.log(values(prefix + "SCALE")),
        quats=np.roll(values(prefix + "ROTATION"), 1, axis=1),
    )


def usd_splats(path: Path, code: float | None = None) -> Splats:
    """Read the particle field of a stage by usd-core, at a time code or where nothing moves."""
    from pxr import Usd, UsdVol

    stage = Usd.Stage.Open(str(path))
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert field
    at = Usd.TimeCode.Default() if code is None else Usd.TimeCode(code)

    def values(name: str) -> np.ndarray:
        return np.array(field.GetPrim().GetAttribute(name).Get(at))

    degree = int(values("radiance:sphericalHarmonicsDegree"))
    means = values("positions")
    harmonics = values("radiance:sphericalHarmonicsCoefficients").reshape(len(means), (degree + 1) ** 2, 3)
    quats = field.GetPrim().GetAttribute("orientations").Get(at)
    return Splats(
        means=means,
        normals=np.zeros_like(means),
        f_dc=harmonics[:, 0],
        f_rest=harmonics[:, 1:],
        opacity_logits=_logits(values("opacities").astype(np.float64)),
        log_scales=np.log(values("scales")),
        quats=np.array([[q.real, *q.imaginary] for q in quats]),
    )


def webavatar_played(
    arrays: dict[str, np.ndarray], pose: np.ndarray, transl: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Play an npz as the Unity package's shaders do: places and rotations (wxyz) in a pose (55, 3)."""
    joints = arrays["t_joints"].astype(float)

    def transforms(turns: np.ndarray) -> np.ndarray:
        out = np.tile(np.eye(4), (55, 1, 1))
        for j, parent in enumerate(_PARENTS):
            local = np.eye(4)
            local[:3, :3] = Rotation.from_rotvec(turns[j]).as_matrix()
            local[:3, 3] = joints[j] - (joints[parent] if parent >= 0 else 0)
            out[j] = local if parent < 0 else out[parent] @ local
        return out

    big = np.zeros((55, 3))
    big[1, 2], big[2, 2] = np.radians(25), -np.radians(25)
    G = transforms(pose) @ np.linalg.inv(transforms(big))
    weights = arrays["weights_val"] / 255.0
    own = G[arrays["weights_idx"]]
    blended = np.einsum("nk,nkij->nij", weights, own)
    places = np.einsum("nij,nj->ni", blended[:, :3, :3], arrays["_xyz"].astype(float)) + blended[:, :3, 3] + transl
    turns = Rotation.from_matrix(own[:, :, :3, :3].reshape(-1, 3, 3)).as_quat().reshape(-1, 4, 4)
    total = weights[:, :1] * turns[:, 0]
    for k in range(1, 4):
        sign = np.where(np.sum(total * turns[:, k], axis=1, keepdims=True) < 0, -1.0, 1.0)
        total = total + weights[:, k : k + 1] * sign * turns[:, k]
    mine = np.roll(arrays["_rotation"].astype(float), -1, axis=1)
    quats = (Rotation.from_quat(total) * Rotation.from_quat(mine)).as_quat()
    return places, np.roll(quats, 1, axis=1)


def webavatar_splats(path: Path, pose: np.ndarray, transl: np.ndarray) -> Splats:
    """Read an npz by numpy and play a pose of it."""
    with np.load(path) as stored:
        arrays = dict(stored)
    means, quats = webavatar_played(arrays, pose, transl)
    return Splats(
        means=means,
        normals=np.zeros_like(means),
        f_dc=arrays["_sh0"][:, 0] / C0,
        f_rest=np.zeros((len(means), 0, 3)),
        opacity_logits=_logits(arrays["opacity"] / 255.0),
        log_scales=arrays["_scaling"],
        quats=quats,
    )


def as_world(splats: Splats) -> WorldSplats:
    """Return splats as the runtime's rasteriser takes them, the harmonics' axes being the world's."""
    return WorldSplats(
        splats.means,
        splats.unit_quats,
        np.exp(splats.log_scales),
        splats.opacities.astype(np.float32),
        np.float32(0.5 + C0 * splats.f_dc),
        splats.f_rest,
        np.zeros(len(splats), np.int64),
        np.eye(3, dtype=np.float32)[None],
    )


def _logits(opacities: np.ndarray) -> np.ndarray:
    kept = np.clip(opacities, 1e-7, 1.0 - 1e-7)
    return np.log(kept / (1.0 - kept))
