import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smplxpp.core import ARRAY_NAMES, POSE_BLOCKS, BodyParams, InputError


def random_params(frames=3, seed=0, **changes) -> BodyParams:
    rng = np.random.default_rng(seed)
    widths = {name: 3 * joints for name, joints in POSE_BLOCKS} | {"betas": 20, "expression": 52, "transl": 3}
    return BodyParams(**{name: rng.normal(size=(frames, width)) for name, width in widths.items()} | changes)


def test_save_and_load_are_exact(tmp_path):
    params = random_params(fps=20.0, flat_hand_mean=True)
    params.save(tmp_path / "params.npz")
    with np.load(tmp_path / "params.npz") as file:
        back = BodyParams.from_mapping(file)
    for name in ARRAY_NAMES:
        np.testing.assert_array_equal(getattr(back, name), getattr(params, name))
    assert (back.fps, back.flat_hand_mean) == (20.0, True)
    assert [p.name for p in tmp_path.iterdir()] == ["params.npz"]


def test_full_pose_and_back():
    params = random_params()
    back = BodyParams.from_full_pose(
        params.full_pose, betas=params.betas, expression=params.expression, transl=params.transl
    )
    for name in ARRAY_NAMES:
        np.testing.assert_array_equal(getattr(back, name), getattr(params, name))


def test_hand_coefficients_have_no_full_pose():
    with pytest.raises(InputError, match="left_hand_pose: expected 45"):
        _ = random_params(left_hand_pose=np.zeros((3, 12))).full_pose


def test_frames_selected_and_joined_again_are_the_same():
    params = random_params(frames=5)
    joined = BodyParams.concatenate([params.frame(0), params.select(slice(1, 4)), params.frame(-1)])
    for name in ARRAY_NAMES:
        np.testing.assert_array_equal(getattr(joined, name), getattr(params, name))


def test_offsets_of_vertices_follow_the_frames(tmp_path):
    rng = np.random.default_rng(1)
    own, shared = rng.normal(size=(3, 5, 3)), rng.normal(size=(5, 3))
    by_frame, once = random_params(v_shape=own), random_params(v_shape=shared)
    np.testing.assert_array_equal(by_frame.frame(1).v_shape, own[1:2])
    np.testing.assert_array_equal(once.frame(2).v_shape, shared[None])
    assert once.without_shape().v_shape is None and once.without_shape().betas.shape == (3, 0)
    np.testing.assert_array_equal(BodyParams.concatenate([once, once]).v_shape, shared[None])
    mixed = BodyParams.concatenate([once, by_frame])
    np.testing.assert_array_equal(mixed.v_shape, np.concatenate([np.tile(shared, (3, 1, 1)), own]))
    assert random_params().offsets_by_row([4, 0, 2]) == {} and len(once.offsets_by_row([4, 0, 2])["v_shape"]) == 1
    rows = by_frame.offsets_by_row([4, 0, 2])["v_shape"]
    np.testing.assert_array_equal(rows[[4, 0, 2]], own)
    assert len(rows) == 5 and np.isnan(rows[[1, 3]]).all()
    by_frame.save(tmp_path / "p.npz")
    with np.load(tmp_path / "p.npz") as file:
        np.testing.assert_array_equal(BodyParams.from_mapping(file).v_shape, own)
    with pytest.raises(InputError, match=r"v_shape of parts to join.*none"):
        BodyParams.concatenate([once, random_params()])


def test_one_row_stands_for_all_frames():
    params = random_params(betas=np.arange(10.0))
    np.testing.assert_array_equal(params.betas, np.tile(np.arange(10.0), (3, 1)))


def test_the_rest_pose_is_zero():
    rest = BodyParams.rest(betas=np.ones(4), expressions=52)
    assert len(rest) == 1 and rest.betas.sum() == 4 and rest.expression.shape == (1, 52)
    assert not rest.full_pose.any()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"body_pose": np.zeros((3, 60))}, r"body_pose.*\(T, 63\).*\(3, 60\)"),
        ({"transl": np.zeros((2, 3))}, "transl: expected 3 frames, received 2"),
        ({"betas": np.array([[0, np.nan]])}, "betas.*first in frame 0"),
        ({"left_hand_pose": np.zeros((3, 46))}, "left_hand_pose"),
        ({"expression": "smile"}, "expression: expected numbers"),
        ({"v_shape": np.zeros((2, 5, 3))}, r"v_shape: expected shape .*\(3, V, 3\), received shape \(2, 5, 3\)"),
        ({"v_shape": np.full((5, 3), np.nan)}, "v_shape: expected finite"),
        ({"v_shape": [[1, 2, 3], "x"]}, "v_shape: expected numbers"),
        ({"jaw_pose": [[1, 2, 3], [1, 2]]}, "jaw_pose: expected numbers"),
    ],
)
def test_bad_arrays_are_named(changes, message):
    with pytest.raises(InputError, match=message):
        random_params(**changes)


def test_parts_that_do_not_fit_are_not_joined():
    for other, name in ((random_params(betas=np.zeros(10)), "betas"), (random_params(fps=30.0), "fps")):
        with pytest.raises(InputError, match=f"parameter {name} of part 1"):
            BodyParams.concatenate([random_params(), other])
    with pytest.raises(InputError, match="at least one"):
        BodyParams.concatenate([])


def test_missing_keys_and_frames_are_named():
    with pytest.raises(InputError, match="global_orient"):
        BodyParams.from_mapping({"poses": np.zeros(72)})
    with pytest.raises(InputError, match="below 3"):
        random_params().frame(3)


@given(st.integers(1, 50))
def test_narrow_hands_are_pca_and_kept(width):
    hand = np.zeros((3, width))
    if width <= 45:
        assert random_params(left_hand_pose=hand).left_hand_pose.shape == (3, width)
    else:
        with pytest.raises(InputError):
            random_params(left_hand_pose=hand)
