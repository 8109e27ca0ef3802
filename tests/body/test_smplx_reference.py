"""Our arithmetic against the `smplx` package's, on a synthetic file with all keys and shapes of SMPL-X.

`data/smplx_reference.npz` holds what smplx 0.1.28 answers (float64): some vertices and all 55 joints of each case.
Where that package is installed it is asked again, for all vertices; `write_reference()` makes the stored file.
"""

import warnings
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from smplxpp.body import load_body
from tests.body.synthetic_smplx import CASES, VERTICES, case_params, write_synthetic_smplx

REFERENCE = Path(__file__).parent / "data" / "smplx_reference.npz"
# The package adds 1e-8 to axis-angle vectors before it takes their length, so its rotations are off by about that;
# with exact rotations in their place the two agree to 3e-15.
TOLERANCE = 3e-8
STORED_VERTICES = np.arange(0, VERTICES, 149)


@pytest.fixture(scope="module")
def model_file(tmp_path_factory):
    return write_synthetic_smplx(tmp_path_factory.mktemp("model") / "SMPLX_NEUTRAL.npz")


@pytest.fixture(scope="module")
def body(model_file):
    return load_body(model_file)


def ask_smplx(path: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and joints of one case by the package."""
    import smplx
    import torch

    betas, expressions, hand, flat = CASES[name]
    params = case_params(name)
    # The package rounds a model's arrays to float32 on the way in, whatever precision is asked for: keep float64.
    as_float64 = mock.patch.object(smplx.body_models, "to_np", lambda array, dtype=None: np.asarray(array, np.float64))
    with warnings.catch_warnings(), as_float64:
        warnings.simplefilter("ignore")
        model = smplx.SMPLX(
            str(path),
            num_betas=betas,
            num_expression_coeffs=expressions,
            use_pca=hand < 45,
            num_pca_comps=hand,
            flat_hand_mean=flat,
            dtype=torch.float64,
        )
    tensors = {k: torch.tensor(v) for k, v in params.as_dict().items() if k != "flat_hand_mean"}
    with torch.no_grad():
        answer = model(**tensors)
    return answer.vertices.numpy(), answer.joints.numpy()[:, :55]


def write_reference(path: Path) -> None:
    out = {}
    for name in CASES:
        vertices, joints = ask_smplx(path, name)
        out |= {f"{name}_vertices": vertices[:, STORED_VERTICES], f"{name}_joints": joints}
    REFERENCE.parent.mkdir(exist_ok=True)
    np.savez_compressed(REFERENCE, **out)


@pytest.mark.parametrize("name", CASES)
def test_posed_vertices_and_joints_equal_the_stored_answers(body, name):
    posed = body.forward(case_params(name))
    with np.load(REFERENCE) as stored:
        np.testing.assert_allclose(
            posed.vertices[:, STORED_VERTICES], stored[f"{name}_vertices"], rtol=0, atol=TOLERANCE
        )
        np.testing.assert_allclose(posed.joints, stored[f"{name}_joints"], rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("name", CASES)
def test_all_vertices_equal_the_package(body, model_file, name):
    pytest.importorskip("smplx")
    vertices, joints = ask_smplx(model_file, name)
    posed = body.forward(case_params(name))
    np.testing.assert_allclose(posed.vertices, vertices, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(posed.joints, joints, rtol=0, atol=TOLERANCE)


def test_the_cases_differ_where_the_hands_do(body):
    params = case_params("pca_with_mean")
    moved = body.forward(params).vertices - body.forward(params, flat_hand_mean=True).vertices
    reach = np.abs(moved).max(axis=(0, 2))
    fingers = body.weights[:, 25:].sum(axis=1)
    assert reach[fingers > 0.5].min() > 1e-4


def test_the_file_is_read_as_smplx(body):
    assert (body.num_betas, body.num_expressions, body.joint_count) == (300, 100, 55)
    assert body.parents[0] == -1 and body.joint_names[22] == "jaw"
    assert body.posedirs.shape == (VERTICES, 3, 486)
