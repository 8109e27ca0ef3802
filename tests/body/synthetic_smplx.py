"""A body file with every key and shape of SMPL-X's, its numbers random but valid."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from smplxpp.core.params import BodyParams

VERTICES, FACES, JOINTS, BETAS, EXPRESSIONS = 10475, 20908, 55, 300, 100
PARENTS = [
    *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15),
    *(20, 25, 26, 20, 28, 29, 20, 31, 32, 20, 34, 35, 20, 37, 38),
    *(21, 40, 41, 21, 43, 44, 21, 46, 47, 21, 49, 50, 21, 52, 53),
]


def write_synthetic_smplx(path: Path, *, seed: int = 0) -> Path:
    """Write the file; the same seed gives the same numbers."""
    rng = np.random.default_rng(seed)
    weights = np.zeros((VERTICES, JOINTS))
    weights[np.arange(VERTICES)[:, None], rng.integers(0, JOINTS, (VERTICES, 4))] = rng.random((VERTICES, 4)) + 0.1
    regressor = np.zeros((JOINTS, VERTICES))
    regressor[np.arange(JOINTS)[:, None], rng.integers(0, VERTICES, (JOINTS, 30))] = 1.0
    parents = np.array(PARENTS)
    np.savez(
        path,
        v_template=rng.random((VERTICES, 3)) * [1.0, 1.8, 0.4],
        f=rng.integers(0, VERTICES, (FACES, 3)).astype(np.uint32),
        shapedirs=rng.random((VERTICES, 3, BETAS + EXPRESSIONS), dtype=np.float32) * 0.02 - 0.01,
        posedirs=rng.random((VERTICES, 3, 9 * (JOINTS - 1)), dtype=np.float32) * 0.002 - 0.001,
        J_regressor=regressor / regressor.sum(axis=1, keepdims=True),
        kintree_table=np.stack([np.where(parents < 0, 2**32 - 1, parents), np.arange(JOINTS)]),
        weights=weights / weights.sum(axis=1, keepdims=True),
        hands_componentsl=rng.normal(size=(45, 45)),
        hands_componentsr=rng.normal(size=(45, 45)),
        hands_meanl=rng.normal(size=45) * 0.2,
        hands_meanr=rng.normal(size=45) * 0.2,
        lmk_faces_idx=rng.integers(0, FACES, 51),
        lmk_bary_coords=np.full((51, 3), 1 / 3),
        dynamic_lmk_faces_idx=rng.integers(0, FACES, (79, 17)),
        dynamic_lmk_bary_coords=np.full((79, 17, 3), 1 / 3),
        joint2num=np.array({"Pelvis": 0}, dtype=object),
        part2num=np.array({"Global": 0}, dtype=object),
    )
    return path


# name -> numbers of betas, expressions, hand numbers; without the mean hand.
CASES: dict[str, tuple[int, int, int, bool]] = {
    "pca_with_mean": (10, 10, 12, False),
    "full_with_mean": (16, 50, 45, False),
    "full_flat": (300, 100, 45, True),
}


def case_params(name: str, *, frames: int = 2) -> BodyParams:
    """Random parameters of a case."""
    betas, expressions, hand, flat = CASES[name]
    rng = np.random.default_rng(sum(map(ord, name)))
    pose = {"global_orient": 3, "body_pose": 63, "jaw_pose": 3, "leye_pose": 3, "reye_pose": 3}
    return BodyParams(
        **{key: rng.normal(size=(frames, width)) * 0.4 for key, width in pose.items()},
        left_hand_pose=rng.normal(size=(frames, hand)) * 0.2,
        right_hand_pose=rng.normal(size=(frames, hand)) * 0.2,
        betas=rng.normal(size=(frames, betas)),
        expression=rng.normal(size=(frames, expressions)),
        transl=rng.normal(size=(frames, 3)),
        flat_hand_mean=flat,
    )
