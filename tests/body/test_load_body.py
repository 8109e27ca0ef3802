import pickle
import re
import sys
import types
from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse

from smplxpp.body import load_body
from smplxpp.core import BodyParams, InputError
from tests.body.synthetic_smplx import PARENTS


def small_model(joints: int, *, vertices: int = 60, directions: int = 20) -> dict:
    """The keys of a family's file with few vertices."""
    rng = np.random.default_rng(joints)
    parents = {55: PARENTS, 52: PARENTS[:22] + [p if p < 22 else p - 3 for p in PARENTS[25:]]}
    parents[24] = [*PARENTS[:22], 20, 21]
    weights = rng.random((vertices, joints))
    return {
        "v_template": rng.normal(size=(vertices, 3)),
        "f": rng.integers(0, vertices, (30, 3)).astype(np.uint32),
        "shapedirs": rng.normal(size=(vertices, 3, directions)),
        "posedirs": rng.normal(size=(vertices, 3, 9 * (joints - 1))) * 1e-2,
        "J_regressor": rng.dirichlet(np.ones(vertices), joints),
        "kintree_table": np.stack([parents[joints], np.arange(joints)]).astype(np.int64) % 2**32,
        "weights": weights / weights.sum(axis=1, keepdims=True),
    }


def write(path, values):
    np.savez(path, **values)
    return path


def test_the_embedded_body_is_whole(open_body):
    assert (open_body.joint_count, open_body.num_betas, open_body.num_expressions) == (55, 20, 52)
    assert open_body.posedirs is None and open_body.left_hand_components is None
    assert abs(open_body.weights.sum(axis=1) - 1).max() < 1e-15 and open_body.weights.min() >= 0
    assert set(open_body.part_label_names) >= {"body", "left_eye", "right_eye", "tongue"}
    assert open_body.mesh().vertex_count == len(open_body.part_labels)
    names = open_body.joint_names
    left, right = names.index("left_wrist"), names.index("right_wrist")
    joints = open_body.forward(BodyParams.rest()).joints[0]
    assert joints[left, 0] > 0 > joints[right, 0], "x points to the subject's left"
    assert not open_body.weights.flags.writeable


def test_the_embedded_body_can_be_cut():
    body = load_body(num_betas=5, num_expressions=0)
    assert (body.num_betas, body.num_expressions) == (5, 0)
    # Without directions of its own a body ignores expressions.
    np.testing.assert_allclose(body.forward(BodyParams.rest(betas=5)).vertices[0], body.v_template, atol=1e-15)
    with pytest.raises(InputError, match=r"at most 20 betas.*21 asked"):
        load_body(num_betas=21)


@pytest.mark.parametrize(
    ("joints", "directions", "shape", "expression"),
    [(55, 20, 10, 10), (55, 400, 300, 100), (52, 16, 16, 0), (24, 300, 300, 0)],
)
def test_families_and_their_bases(tmp_path, joints, directions, shape, expression):
    values = small_model(joints, directions=directions)
    body = load_body(write(tmp_path / "model.npz", values))
    assert (body.joint_count, body.num_betas, body.num_expressions) == (joints, shape, expression)
    np.testing.assert_array_equal(body.shapedirs, values["shapedirs"][..., :shape])
    np.testing.assert_array_equal(body.exprdirs, values["shapedirs"][..., shape : shape + expression])
    assert len(body.joint_names) == joints and body.parents[0] == -1
    np.testing.assert_array_equal(body.part_labels, body.weights.argmax(axis=1))
    assert body.part_label_names == body.joint_names


@pytest.mark.parametrize("joints", [52, 24])
def test_poses_of_joints_that_a_family_lacks_are_ignored(tmp_path, moving, joints):
    body = load_body(write(tmp_path / "model.npz", small_model(joints)))
    params = moving(2, betas=10, expressions=10)
    still = {name: np.zeros((2, 3)) for name in ("jaw_pose", "leye_pose", "reye_pose")}
    still["expression"] = np.zeros((2, 10))
    if joints == 24:
        still |= {f"{side}_hand_pose": np.zeros((2, 45)) for side in ("left", "right")}
    same = replace(params, **still)
    np.testing.assert_array_equal(body.forward(params).vertices, body.forward(same).vertices)
    if joints == 24:
        # The two hand joints follow their wrists.
        moved = body.forward(params).posed_from_rest
        np.testing.assert_allclose(moved[:, 22:], moved[:, 20:22], atol=1e-12)


def test_a_pickle_of_python_2_equals_its_npz(tmp_path, monkeypatch, moving):
    values = small_model(24)
    expected = load_body(write(tmp_path / "model.npz", values))
    module = types.ModuleType("chumpy.ch")
    module.Ch = type("Ch", (), {"__module__": "chumpy.ch"})
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    monkeypatch.setitem(sys.modules, "chumpy.ch", module)
    pickled = dict(values, J_regressor=scipy.sparse.csc_matrix(values["J_regressor"]))
    for key in ("shapedirs", "posedirs"):
        pickled[key] = module.Ch()
        pickled[key].__dict__ = {"x": values[key]}
    data = pickle.dumps(pickled, protocol=0).replace(b"copyreg", b"copy_reg")
    (tmp_path / "model.pkl").write_bytes(data.replace(b"scipy.sparse._csc", b"scipy.sparse.csc"))
    params = moving(1, betas=10)
    np.testing.assert_array_equal(
        load_body(tmp_path / "model.pkl").forward(params).vertices, expected.forward(params).vertices
    )


def test_float32_weights_are_normalised_in_float64(tmp_path):
    values = small_model(55)
    values["weights"] = values["weights"].astype(np.float32)
    assert abs(load_body(write(tmp_path / "model.npz", values)).weights.sum(axis=1) - 1).max() < 1e-15


def spoil(values, key, change):
    values[key] = change(values[key].astype(float))
    return values


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("weights", lambda w: w * 1.1, "sum to 1"),
        ("weights", lambda w: w - 0.5, "non-negative"),
        ("weights", lambda w: w[:, :40], "40 columns"),
        ("v_template", lambda v: v[:-1], r"shape \(60, 3\).*\(59, 3\)"),
        ("v_template", lambda v: v * np.nan, "finite"),
        ("f", lambda f: f + 1000, "indices in"),
        ("J_regressor", lambda r: r.T, r"shape \(55, 60\)"),
        ("posedirs", lambda p: p[..., :459], "486"),
        ("kintree_table", lambda k: k[:, ::-1], "one root first"),
    ],
)
def test_a_wrong_array_is_named_with_its_file(tmp_path, key, change, message):
    path = write(tmp_path / "broken.npz", spoil(small_model(55), key, change))
    with pytest.raises(InputError, match=rf"broken\.npz: {key}") as error:
        load_body(path)
    assert re.search(message, str(error.value))


@pytest.mark.parametrize("key", ["num_betas", "num_expressions"])
@pytest.mark.parametrize("value", [np.nan, 1e300, 3.7, -5, 10**6, "ten", [1, 2], b"\0", True])
def test_counts_that_are_none_are_named(tmp_path, key, value):
    path = write(tmp_path / "body.npz", small_model(55) | {"num_betas": 10, "num_expressions": 10} | {key: value})
    with pytest.raises(InputError, match=rf"body\.npz: {key}.*whole number"):
        load_body(path)


def test_files_that_are_no_bodies(tmp_path):
    params = tmp_path / "params.npz"
    BodyParams.rest().save(params)
    with pytest.raises(InputError, match=r"params\.npz.*without v_template.*Give a model file"):
        load_body(params)
    with pytest.raises(InputError, match="suffix"):
        load_body(tmp_path / "body.obj")
    with pytest.raises(InputError, match=r"none\.npz"):
        load_body(tmp_path / "none.npz")
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(InputError, match="pickled dict"):
        load_body(tmp_path / "list.pkl")


def test_expressions_have_the_files_names_or_numbers(tmp_path):
    named = load_body()
    assert named.expression_names[named.expression_names.index("jawOpen")] == "jawOpen"
    assert len(load_body(num_expressions=5).expression_names) == 5
    assert replace(named, expression_names=()).expression_names[:2] == ("expression_00", "expression_01")
