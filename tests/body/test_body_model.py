from dataclasses import replace

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core import BodyParams, InputError, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.skinning import skin

FIELDS = ("vertices", "joints", "rest_vertices", "rest_joints", "posed_from_rest")


def with_hands(body, **changes):
    """The open body with a random hand PCA, mean and pose correctives."""
    rng = np.random.default_rng(5)
    extra = {
        "left_hand_components": rng.normal(size=(45, 45)),
        "right_hand_components": rng.normal(size=(45, 45)),
        "left_hand_mean": rng.normal(size=45) * 0.1,
        "right_hand_mean": rng.normal(size=45) * 0.1,
    }
    return replace(body, **extra | changes)


def test_the_rest_pose_is_the_shaped_template(open_body):
    betas = np.random.default_rng(0).normal(size=20)
    posed = open_body.forward(BodyParams.rest(betas=betas, expressions=52)).frame(0)
    shaped = open_body.v_template + open_body.shapedirs @ betas
    np.testing.assert_allclose(posed.vertices, shaped, atol=1e-12)
    np.testing.assert_allclose(posed.joints, open_body.joint_regressor @ shaped, atol=1e-12)
    np.testing.assert_allclose(posed.posed_from_rest, np.broadcast_to(np.eye(4), (55, 4, 4)), atol=1e-14)
    assert posed.pose_offsets is None


def test_vertices_are_the_skinned_rest_vertices_exactly(open_body, moving):
    posed = open_body.forward(moving(3))
    again = skin(posed.rest_vertices, open_body.weights, posed.posed_from_rest)
    np.testing.assert_array_equal(again, posed.vertices)
    one = posed.frame(1)
    np.testing.assert_array_equal(one.vertices, posed.vertices[1])
    assert one.posed_from_rest.shape == (55, 4, 4) and len(posed) == 3


def test_vertices_are_skinned_when_they_are_asked_for_first(open_body, moving):
    """Poses of an avatar and steps of cloth take the transforms, and waited for a product over all vertices."""
    posed = open_body.forward(moving(1))
    assert len(posed) == 1 and "13,886" not in repr(posed) and "vertices" not in vars(posed)
    assert posed.vertices is posed.vertices


def test_a_frame_alone_is_the_frame_of_the_batch(open_body, moving):
    params = moving(3)
    np.testing.assert_allclose(
        open_body.forward(params.frame(2)).vertices[0], open_body.forward(params).vertices[2], atol=1e-12
    )


def test_a_rigid_motion_about_the_root_moves_everything_rigidly(open_body, moving):
    params = moving(1)
    before = open_body.forward(params).frame(0)
    rotation = matrix_from_rotvec(np.array([0.3, -1.2, 0.8]))
    shift = np.array([0.1, 2.0, -0.5])
    turned = replace(
        params,
        global_orient=rotvec_from_matrix(rotation @ matrix_from_rotvec(params.global_orient)),
        transl=params.transl + shift,
    )
    after = open_body.forward(turned).frame(0)
    pivot = before.joints[0]
    np.testing.assert_allclose(after.vertices, (before.vertices - pivot) @ rotation.T + pivot + shift, atol=1e-12)
    np.testing.assert_allclose(after.joints, (before.joints - pivot) @ rotation.T + pivot + shift, atol=1e-12)


def test_fewer_coefficients_are_padded_with_zeros(open_body, moving):
    short = moving(1, betas=7, expressions=5)
    padded = replace(
        short, betas=np.pad(short.betas, ((0, 0), (0, 13))), expression=np.pad(short.expression, ((0, 0), (0, 47)))
    )
    np.testing.assert_allclose(open_body.forward(short).vertices, open_body.forward(padded).vertices, atol=1e-13)


@pytest.mark.parametrize(("name", "known"), [("betas", 20), ("expression", 52)])
def test_more_coefficients_than_directions_are_an_error(open_body, moving, name, known):
    with pytest.raises(InputError, match=f"{name}.*at most {known}.*received {known + 1}"):
        open_body.forward(replace(moving(1), **{name: np.zeros((1, known + 1))}))


def test_hand_coefficients_are_the_same_as_their_full_pose(open_body, moving):
    body, params = with_hands(open_body), moving(2)
    rng = np.random.default_rng(2)
    pca = {side: rng.normal(size=(2, 6)) * 0.2 for side in ("left", "right")}
    narrow = replace(params, **{f"{side}_hand_pose": value for side, value in pca.items()})
    full = {f"{side}_hand_pose": value @ getattr(body, f"{side}_hand_components")[:6] for side, value in pca.items()}
    absolute = {name: value + getattr(body, name.replace("pose", "mean")) for name, value in full.items()}
    expected = body.forward(replace(params, **absolute), flat_hand_mean=True).vertices
    np.testing.assert_allclose(body.forward(narrow).vertices, expected, atol=1e-12)
    np.testing.assert_allclose(body.forward(replace(params, **full)).vertices, expected, atol=1e-12)
    # The parameters can say themselves that the mean hand is in.
    said = replace(params, **absolute, flat_hand_mean=True)
    np.testing.assert_allclose(body.forward(said).vertices, expected, atol=1e-12)
    assert np.abs(body.forward(narrow, flat_hand_mean=True).vertices - expected).max() > 1e-3


def test_hand_coefficients_need_a_model_that_has_them(open_body, moving):
    with pytest.raises(InputError, match=r"no hand PCA.*12 PCA coefficients"):
        open_body.forward(moving(1, left_hand_pose=np.zeros((1, 12))))


def test_pose_correctives_are_linear_in_the_rotations(open_body, moving):
    rng = np.random.default_rng(4)
    posedirs = np.zeros((open_body.vertex_count, 3, 486))
    posedirs[:500] = rng.normal(size=(500, 3, 486)) * 1e-3
    body, params = replace(open_body, posedirs=posedirs), moving(2)
    posed = body.forward(params)
    feature = (matrix_from_rotvec(params.full_pose[:, 1:]) - np.eye(3)).reshape(2, -1)
    np.testing.assert_allclose(posed.pose_offsets, np.einsum("vip,tp->tvi", posedirs, feature), atol=1e-13)
    plain = open_body.forward(params)
    np.testing.assert_allclose(posed.rest_vertices - posed.pose_offsets, plain.rest_vertices, atol=1e-13)
    np.testing.assert_allclose(posed.joints, plain.joints, atol=1e-13)


@pytest.mark.parametrize("features", ["plain", "hands and correctives"])
def test_torch_equals_numpy(open_body, moving, features):
    torch = pytest.importorskip("torch")
    body, params = open_body, moving(2)
    if features != "plain":
        posedirs = np.zeros((open_body.vertex_count, 3, 486))
        posedirs[::7] = 1e-3
        body = with_hands(open_body, posedirs=posedirs)
        params = replace(params, left_hand_pose=params.left_hand_pose[:, :9])
    tensors = {name: torch.tensor(value) for name, value in params.as_dict().items()}
    expected, posed = body.forward(params), body.forward(tensors)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(posed, name).numpy(), getattr(expected, name), atol=1e-12)
    single = body.forward({name: value.float() for name, value in tensors.items()})
    assert single.vertices.dtype == torch.float32
    np.testing.assert_allclose(single.vertices.numpy(), expected.vertices, atol=2e-5)


def test_torch_gradients_are_right_at_the_rest_pose(open_body):
    torch = pytest.importorskip("torch")
    few = np.arange(0, open_body.vertex_count, 1000)
    names = {"global_orient": 3, "body_pose": 63, "betas": 3, "expression": 3, "transl": 3}
    inputs = [torch.zeros(1, width, dtype=torch.float64, requires_grad=True) for width in names.values()]
    # Correctives with all rows would dominate the time: they are tested against numpy.
    assert torch.autograd.gradcheck(
        lambda *values: open_body.forward(dict(zip(names, values, strict=True))).vertices[:, few],
        inputs,
        fast_mode=True,
    )


def test_tensors_cached_under_inference_mode_still_take_gradients(open_body):
    torch = pytest.importorskip("torch")
    body = replace(open_body)
    with torch.inference_mode():
        body.forward({"betas": torch.zeros(1, 2)})
    betas = torch.zeros(1, 2, requires_grad=True)
    body.forward({"betas": betas}).vertices.sum().backward()
    assert torch.isfinite(betas.grad).all() and betas.grad.any()


def test_missing_tensors_are_zero_and_single_rows_stand_for_all(open_body):
    torch = pytest.importorskip("torch")
    pose = torch.zeros(3, 63, dtype=torch.float64)
    posed = open_body.forward({"body_pose": pose, "transl": torch.ones(1, 3, dtype=torch.float64)})
    np.testing.assert_allclose(posed.vertices[2].numpy(), open_body.v_template + 1, atol=1e-12)
    with pytest.raises(InputError, match=r"transl.*1 or 3 frames"):
        open_body.forward({"body_pose": pose, "transl": torch.zeros(2, 3)})
    with pytest.raises(InputError, match=r"jaw_pose.*\(T, 3\)"):
        open_body.forward({"jaw_pose": torch.zeros(1, 4)})
    with pytest.raises(InputError, match="poses"):
        open_body.forward({"poses": pose})


@pytest.mark.long
def test_importing_and_posing_do_not_import_torch():
    import subprocess
    import sys

    code = (
        "import sys; from smplxpp.body import load_body; from smplxpp.core.params import BodyParams; "
        "load_body().forward(BodyParams.rest()); sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize(("capture", "step"), [("woman_casual", 12), ("man_casual", 1)])
def test_posed_open_body_is_the_capture_s_body(captures, open_body, capture, step):
    folder = captures / capture
    with np.load(folder / "params" / "params.npz") as file:
        params = BodyParams.from_mapping(file)
    # The captures' own copy of the body is exact; the shipped one was fitted anew, its joints are 0.01 mm away.
    original = load_body(captures.parent / "body" / "open_body_smplx55.npz")
    for body, millimetres in ((original, 0.01), (open_body, 0.02)):
        for index in range(0, len(params), step):
            with np.load(folder / "geometry" / f"frame_{index:06d}.npz") as file:
                truth = file["verts"][: body.vertex_count]
            posed = body.forward(params.frame(index)).frame(0).vertices
            assert 1e3 * np.abs(posed - truth).max() < millimetres


@pytest.mark.parametrize("wrong", ["circle", "late", "two roots", "beyond", "none first"])
def test_a_skeleton_that_is_no_tree_in_order_is_refused(open_body, wrong):
    parents = open_body.parents.copy()
    child = int(np.flatnonzero(parents == 3)[0])
    changes = {"circle": (3, child), "late": (2, 5), "two roots": (4, -1), "beyond": (4, 1000), "none first": (0, 0)}
    joint, parent = changes[wrong]
    parents[joint] = parent
    with pytest.raises(InputError, match="parents"):
        replace(open_body, parents=parents)


def test_joints_are_those_that_the_regressor_finds_on_the_shaped_vertices(open_body):
    """They are computed from the coefficients; the vertices' own columns say what they have to be."""
    rng = np.random.default_rng(0)
    params = {"betas": rng.normal(size=(2, 5)), "expression": rng.normal(size=(2, open_body.num_expressions))}
    shaped = open_body.v_template + np.einsum("vcn,tn->tvc", open_body.shapedirs[..., :5], params["betas"])
    shaped += np.einsum("vcn,tn->tvc", open_body.exprdirs, params["expression"])
    posed = open_body.forward(params)
    np.testing.assert_allclose(posed.rest_vertices, shaped, atol=1e-12)
    np.testing.assert_allclose(posed.rest_joints, open_body.joint_regressor @ shaped, atol=1e-12)
