"""Each layout is written from known numbers; the parameters read from it must pose the body as its formula says."""

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smplxpp.body import detect_layout, load_body, load_motion, load_params
from smplxpp.core import ARRAY_NAMES, BodyParams, GeometryWarning, InputError, matrix_from_rotvec

FRAMES = 3


@pytest.fixture(scope="module")
def pca_body(open_body):
    """The open body with a hand PCA and a mean hand, so that the layouts differ where they should."""
    rng = np.random.default_rng(5)
    hands = {f"{side}_hand_components": rng.normal(size=(45, 45)) * 0.3 for side in ("left", "right")}
    hands |= {f"{side}_hand_mean": rng.normal(size=45) * 0.1 for side in ("left", "right")}
    return replace(open_body, **hands)


@pytest.fixture
def params(moving) -> BodyParams:
    return moving(FRAMES, betas=10, expressions=10)


@pytest.fixture
def outer():
    """(T, 3) axis-angle and (T, 3) shifts of the posed body."""
    rng = np.random.default_rng(9)
    return rng.normal(size=(FRAMES, 3)), rng.normal(size=(FRAMES, 3))


def assert_same(read: BodyParams, expected: BodyParams) -> None:
    for name in ARRAY_NAMES:
        np.testing.assert_allclose(getattr(read, name), getattr(expected, name), atol=1e-15, err_msg=name)


def moved(vertices: np.ndarray, rotvec: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """x = R X + t about the origin."""
    return vertices @ Rotation.from_rotvec(rotvec).as_matrix().swapaxes(1, 2) + shift[:, None]


def write_json(path, content):
    path.write_text(json.dumps(content, default=lambda array: np.asarray(array).tolist()))
    return path


def test_our_own_file(tmp_path, params):
    params = replace(params, fps=25.0)
    params.save(tmp_path / "params.npz")
    read = load_params(tmp_path / "params.npz")
    assert_same(read, params)
    assert read.fps == 25.0 and not read.flat_hand_mean
    assert detect_layout(tmp_path / "params.npz") == "smplx"


def test_a_folder_of_frames_in_the_order_of_their_numbers(tmp_path, params):
    for index, number in enumerate((2, 10, 100)):
        arrays = {name: value[0] for name, value in params.frame(index).as_dict().items()}
        np.savez(tmp_path / f"{number}.npz", **arrays)
    # Neither numbered nor a file of parameters: left aside.
    (tmp_path / "params_noisy.npz").write_bytes(b"")
    (tmp_path / "notes1.txt").write_text("x")
    assert_same(load_params(tmp_path), params)


def test_4d_dress_pickles(tmp_path, params, pca_body):
    params = replace(
        params, left_hand_pose=params.left_hand_pose[:, :12], right_hand_pose=params.right_hand_pose[:, :12]
    )
    for index in range(FRAMES):
        arrays = {name: value[0].astype(np.float32) for name, value in params.frame(index).as_dict().items()}
        (tmp_path / f"mesh-f{index:05d}_smplx.pkl").write_bytes(pickle.dumps(arrays, protocol=4))
    read = load_params(tmp_path)
    expected = pca_body.forward(params, flat_hand_mean=False).vertices
    np.testing.assert_allclose(pca_body.forward(read).vertices, expected, atol=1e-5)


def test_blocks_by_joint_are_flattened(tmp_path, params):
    arrays = params.as_dict()
    arrays["body_pose"] = params.body_pose.reshape(FRAMES, 21, 3)
    arrays["global_orient"] = params.global_orient.reshape(FRAMES, 1, 3)
    np.savez(tmp_path / "x.npz", **arrays)
    assert_same(load_params(tmp_path / "x.npz"), params)


@pytest.mark.parametrize("kind", ["smplh", "smplx"])
def test_amass(tmp_path, params, pca_body, kind):
    face = [params.jaw_pose, params.leye_pose, params.reye_pose] if kind == "smplx" else []
    blocks = [params.global_orient, params.body_pose, *face, params.left_hand_pose, params.right_hand_pose]
    rate = {"mocap_frame_rate": 120.0} if face else {"mocap_framerate": 120.0}
    np.savez(
        tmp_path / "walk_poses.npz",
        poses=np.concatenate(blocks, axis=1),
        trans=params.transl,
        betas=params.betas[0],
        gender="male",
        dmpls=np.zeros((FRAMES, 8)),
        **rate,
    )
    read = load_params(tmp_path / "walk_poses.npz", body=pca_body, up="y")
    expected = replace(params, expression=np.zeros((FRAMES, 10)), flat_hand_mean=True)
    if not face:
        expected = replace(expected, **{name: np.zeros((FRAMES, 3)) for name in ("jaw_pose", "leye_pose", "reye_pose")})
    assert_same(read, expected)
    assert read.fps == 120.0 and detect_layout(tmp_path / "walk_poses.npz") == "amass"
    np.testing.assert_allclose(
        pca_body.forward(read).vertices, pca_body.forward(expected, flat_hand_mean=True).vertices, atol=1e-12
    )


def test_z_up_becomes_y_up(tmp_path, params, pca_body):
    params.save(tmp_path / "z.npz")
    up_z = pca_body.forward(params).vertices
    up_y = pca_body.forward(load_params(tmp_path / "z.npz", body=pca_body, up="z")).vertices
    np.testing.assert_allclose(up_y, np.stack([up_z[..., 0], up_z[..., 2], -up_z[..., 1]], axis=-1), atol=1e-11)


@pytest.mark.parametrize(("up", "axis"), [("x", 0), ("-x", 0), ("y", 1), ("-y", 1), ("z", 2), ("-z", 2)])
def test_every_axis_can_be_turned_up(tmp_path, params, pca_body, up, axis):
    params.save(tmp_path / "a.npz")
    before = pca_body.forward(params).vertices[0]
    after = pca_body.forward(load_params(tmp_path / "a.npz", body=pca_body, up=up)).vertices[0]
    np.testing.assert_allclose(after[:, 1], (-1 if up[0] == "-" else 1) * before[:, axis], atol=1e-11)
    turn = np.linalg.lstsq(before - before[0], after - after[0], rcond=None)[0]
    np.testing.assert_allclose([turn @ turn.T, np.eye(3) * np.linalg.det(turn)], [np.eye(3)] * 2, atol=1e-9)
    with pytest.raises(InputError, match="axis that points up"):
        load_params(tmp_path / "a.npz", body=pca_body, up="w")


def test_avatarrex(tmp_path, params, pca_body):
    arrays = {name: value for name, value in params.as_dict().items() if name not in ("leye_pose", "reye_pose")}
    np.savez(tmp_path / "smpl_params.npz", **arrays | {"betas": params.betas[:1]})
    read = load_params(tmp_path / "smpl_params.npz")
    expected = replace(params, leye_pose=np.zeros((FRAMES, 3)), reye_pose=np.zeros((FRAMES, 3)))
    assert_same(read, expected)
    assert detect_layout(tmp_path / "smpl_params.npz") == "avatarrex"
    np.testing.assert_allclose(
        pca_body.forward(read).vertices, pca_body.forward(expected, flat_hand_mean=True).vertices, atol=1e-12
    )
    assert not load_params(tmp_path / "smpl_params.npz", flat_hand_mean=False).flat_hand_mean


@pytest.mark.parametrize("as_folder", [True, False])
def test_talkbody4d(tmp_path, params, outer, pca_body, as_folder):
    for index in range(FRAMES):
        record = {name: value for name, value in params.frame(index).as_dict().items()}
        record |= {"Rh": outer[0][index : index + 1], "Th": outer[1][index : index + 1]}
        write_json(tmp_path / f"{index:06d}.json", record)
    inner = pca_body.forward(params, flat_hand_mean=True).vertices
    expected = moved(inner, *outer)
    assert detect_layout(tmp_path) == "talkbody4d"
    if as_folder:
        read = load_params(tmp_path, body=pca_body)
    else:
        read, expected = load_params(tmp_path / "000001.json", body=pca_body), expected[1:2]
    # Its world has y down.
    np.testing.assert_allclose(pca_body.forward(read).vertices, expected * [1, -1, -1], atol=1e-11)
    as_it_is = load_params(tmp_path / "000001.json", body=pca_body, up="y")
    np.testing.assert_allclose(pca_body.forward(as_it_is).vertices, moved(inner, *outer)[1:2], atol=1e-11)


def test_v_shape_is_added_to_the_shaped_template_and_moves_the_joints(tmp_path, params, outer, pca_body):
    """As TalkBody4D's (1, V, 3); the order is its authors': template, betas, v_shape, then joints and pose."""
    rng = np.random.default_rng(2)
    offsets = rng.normal(size=(1, pca_body.vertex_count, 3)) * 0.003
    for index in range(FRAMES):
        record = params.frame(index).as_dict() | {"v_shape": offsets}
        record |= {"Rh": outer[0][index : index + 1], "Th": outer[1][index : index + 1]}
        write_json(tmp_path / f"{index:06d}.json", record)
    read = load_params(tmp_path, body=pca_body)
    assert read.v_shape.shape == offsets.shape, "what is the same in all frames is kept once"
    person = replace(pca_body, v_template=pca_body.v_template + offsets[0])
    expected = moved(person.forward(params, flat_hand_mean=True).vertices, *outer) * [1, -1, -1]
    np.testing.assert_allclose(pca_body.forward(read).vertices, expected, atol=1e-11)
    assert np.abs(pca_body.forward(replace(read, v_shape=None)).vertices - expected).max() > 0.005
    with pytest.raises(InputError, match=r"v_shape: expected \d+ vertices.*received 7"):
        pca_body.forward(replace(read, v_shape=np.zeros((7, 3))))
    read.save(tmp_path / "params.npz")
    np.testing.assert_array_equal(load_params(tmp_path / "params.npz").v_shape, offsets)


def test_what_talkbody4d_adds_in_an_unknown_place_is_said(tmp_path, params, outer, pca_body):
    record = params.frame(0).as_dict() | {"Rh": outer[0][:1], "Th": outer[1][:1], "v_pose": np.ones((1, 9, 3))}
    with pytest.warns(GeometryWarning, match="v_pose. is not read"):
        load_params(write_json(tmp_path / "0.json", record), body=pca_body)


def test_more_betas_than_the_body_has_can_be_cut(tmp_path, params, outer, pca_body):
    betas = np.r_[np.full(pca_body.num_betas, 3.0), np.full(80, 1.5)][None]
    record = params.frame(0).as_dict() | {"betas": betas, "Rh": outer[0][:1], "Th": outer[1][:1]}
    path = write_json(tmp_path / "000000.json", record)
    with pytest.raises(InputError, match=r"betas: expected at most .*--betas"):
        load_params(path, body=pca_body)
    kept = pca_body.num_betas
    lost = 100 * np.sqrt(80 * 1.5**2 / (80 * 1.5**2 + kept * 9))
    with pytest.warns(GeometryWarning, match=rf"{kept + 80} betas are cut to {kept}: {lost:.1f} % of their length"):
        cut = load_params(path, body=pca_body, max_betas=kept)
    assert cut.betas.shape == (1, kept)
    pca_body.forward(cut)
    with pytest.raises(InputError, match="betas to keep"):
        load_params(path, body=pca_body, max_betas=-1)


def easymocap_record(params: BodyParams, outer, index: int, *, person: int = 0) -> dict:
    """SMPL-X: 3 zeros, body, hands as 6 + 6 PCA numbers, then the face."""
    frame = params.frame(index)
    blocks = [np.zeros((1, 3)), frame.body_pose, frame.left_hand_pose[:, :6], frame.right_hand_pose[:, :6]]
    poses = np.concatenate([*blocks, frame.jaw_pose, frame.leye_pose, frame.reye_pose], axis=1)
    assert poses.shape == (1, 87)
    return {
        "id": person,
        "Rh": outer[0][index : index + 1],
        "Th": outer[1][index : index + 1],
        "poses": poses,
        "shapes": frame.betas,
        "expression": frame.expression,
    }


def easymocap_truth(params: BodyParams, outer, body) -> np.ndarray:
    inner = replace(
        params,
        global_orient=np.zeros((FRAMES, 3)),
        transl=np.zeros((FRAMES, 3)),
        left_hand_pose=params.left_hand_pose[:, :6],
        right_hand_pose=params.right_hand_pose[:, :6],
    )
    return moved(body.forward(inner, flat_hand_mean=False).vertices, *outer)


@pytest.mark.parametrize("wrapped", [False, True])
def test_easymocap(tmp_path, params, outer, pca_body, wrapped):
    for index in range(FRAMES):
        records = [easymocap_record(params, outer, index)]
        write_json(tmp_path / f"{index:06d}.json", {"annots": records} if wrapped else records)
    assert detect_layout(tmp_path) == "easymocap"
    read = load_params(tmp_path, body=pca_body)
    np.testing.assert_allclose(pca_body.forward(read).vertices, easymocap_truth(params, outer, pca_body), atol=1e-11)
    # With a zero root of its own the orientation is the outer one, whatever the body.
    np.testing.assert_allclose(
        matrix_from_rotvec(read.global_orient), Rotation.from_rotvec(outer[0]).as_matrix(), atol=1e-12
    )


def test_easymocap_of_smpl_and_of_smplh(tmp_path, params, outer, pca_body):
    record = easymocap_record(params, outer, 1)
    full = record["poses"]
    del record["expression"]
    still = {name: np.zeros((FRAMES, 3)) for name in ("jaw_pose", "leye_pose", "reye_pose")}
    still["expression"] = np.zeros((FRAMES, 10))
    hands = replace(params, **still)
    record["poses"] = full[:, :78]
    smplh = load_params(write_json(tmp_path / "h.json", [record]), body=pca_body)
    np.testing.assert_allclose(
        pca_body.forward(smplh).vertices[0], easymocap_truth(hands, outer, pca_body)[1], atol=1e-11
    )
    record["poses"] = full[:, :72]
    with pytest.warns(GeometryWarning, match="two hand joints"):
        smpl = load_params(write_json(tmp_path / "s.json", [record]), body=pca_body)
    np.testing.assert_allclose(smpl.body_pose, params.body_pose[1:2], atol=1e-15)
    record["poses"] = full[:, :70]
    with pytest.raises(InputError, match=r"s\.json: poses.*70"):
        load_params(write_json(tmp_path / "s.json", [record]), body=pca_body)
    record["poses"] = full[:, :32]
    with pytest.raises(InputError, match=r"poses.*received 32.*embedding"):
        load_params(write_json(tmp_path / "s.json", [record]), body=pca_body)


@pytest.mark.parametrize("hand", [6, 12, 45])
def test_easymocap_with_the_root_apart_and_hands_of_their_own(tmp_path, params, outer, pca_body, hand):
    """SMPL-H as `easymocap.bodymodel` writes it: 63 numbers, `handl`, `handr`; mean hands are added to either kind."""
    frame = params.frame(1)
    record = {"id": 0, "Rh": outer[0][1:2], "Th": outer[1][1:2], "poses": frame.body_pose, "shapes": frame.betas}
    record |= {"handl": frame.left_hand_pose[:, :hand], "handr": frame.right_hand_pose[:, :hand]}
    read = load_params(write_json(tmp_path / "0.json", [record]), body=pca_body)
    inner = BodyParams.rest(betas=frame.betas[0])
    inner = replace(inner, body_pose=frame.body_pose, left_hand_pose=record["handl"], right_hand_pose=record["handr"])
    expected = moved(pca_body.forward(inner, flat_hand_mean=False).vertices, outer[0][1:2], outer[1][1:2])
    np.testing.assert_allclose(pca_body.forward(read).vertices, expected, atol=1e-11)
    del record["handl"], record["handr"]
    bare = load_params(write_json(tmp_path / "0.json", [record]), body=pca_body)
    assert not bare.left_hand_pose.any() and not bare.flat_hand_mean
    record["poses"] = np.pad(frame.body_pose, ((0, 0), (0, 6)))  # SMPL's 69
    np.testing.assert_array_equal(
        load_params(write_json(tmp_path / "0.json", [record]), body=pca_body).body_pose, bare.body_pose
    )
    record["poses"] = np.full((1, 69), 0.1)
    with pytest.warns(GeometryWarning, match="two hand joints"):
        load_params(write_json(tmp_path / "0.json", [record]), body=pca_body)


def test_easymocap_complete_poses_of_smplh(tmp_path, params, outer, pca_body):
    """156 numbers hold a root of zeros and hands with their mean; `handl` beside them counts no more."""
    frame = params.frame(1)
    poses = np.concatenate([np.zeros((1, 3)), frame.body_pose, frame.left_hand_pose, frame.right_hand_pose], axis=1)
    record = {"id": 0, "Rh": outer[0][1:2], "Th": outer[1][1:2], "poses": poses, "shapes": frame.betas}
    record |= {"handl": np.ones((1, 6)), "handr": np.ones((1, 6))}
    read = load_params(write_json(tmp_path / "0.json", [record]), body=pca_body)
    inner = replace(
        BodyParams.rest(betas=frame.betas[0]),
        body_pose=frame.body_pose,
        left_hand_pose=frame.left_hand_pose,
        right_hand_pose=frame.right_hand_pose,
    )
    expected = moved(pca_body.forward(inner, flat_hand_mean=True).vertices, outer[0][1:2], outer[1][1:2])
    np.testing.assert_allclose(pca_body.forward(read).vertices, expected, atol=1e-11)


def test_easymocap_with_several_people(tmp_path, params, outer, pca_body):
    for index in range(FRAMES):
        records = [easymocap_record(params, outer, index, person=4)]
        if index != 1:
            records.insert(0, easymocap_record(params, outer, 1, person=2))
        write_json(tmp_path / f"{index:06d}.json", records)
    with pytest.raises(InputError, match=r"000000\.json: people.*\[2, 4\].*--person"):
        load_params(tmp_path, body=pca_body)
    read = load_params(tmp_path, body=pca_body, person=4)
    np.testing.assert_allclose(pca_body.forward(read).vertices, easymocap_truth(params, outer, pca_body), atol=1e-11)
    with pytest.warns(GeometryWarning, match=r"missing in 1 of 3 frames.*000001\.json"):
        assert len(load_params(tmp_path, body=pca_body, person=2)) == 2
    with pytest.raises(InputError, match="person 7"):
        load_params(tmp_path, body=pca_body, person=7)


def test_unknown_and_ambiguous_layouts_say_what_was_seen(tmp_path, params):
    np.savez(tmp_path / "a.npz", pose=np.zeros(72), trans=np.zeros(3))
    with pytest.raises(InputError, match=r"a\.npz.*keys pose, trans, which fit none"):
        load_params(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", **params.as_dict(), poses=np.zeros((FRAMES, 156)), trans=np.zeros((FRAMES, 3)))
    with pytest.raises(InputError, match=r"smplx and amass.*--layout"):
        load_params(tmp_path / "b.npz")
    assert_same(load_params(tmp_path / "b.npz", layout="smplx"), params)
    with pytest.raises(InputError, match=r"a\.npz.*layout amass.*betas"):
        np.savez(tmp_path / "a.npz", poses=np.zeros((1, 156)), trans=np.zeros(3))
        load_params(tmp_path / "a.npz", layout="amass")
    with pytest.raises(InputError, match="received vhap"):
        load_params(tmp_path / "b.npz", layout="vhap")


def test_unreadable_inputs_are_named(tmp_path, params):
    with pytest.raises(InputError, match=r"none\.json"):
        load_params(tmp_path / "none.json")
    with pytest.raises(InputError, match=r"suffix '\.c3d'"):
        load_params(tmp_path / "walk.c3d")
    (tmp_path / "x.json").write_text("{")
    with pytest.raises(InputError, match=r"x\.json: expected JSON"):
        load_params(tmp_path / "x.json")
    with pytest.raises(InputError, match="no such file"):
        load_params(tmp_path)
    for name in ("a1.npz", "b1.npz"):
        params.save(tmp_path / name)
    with pytest.raises(InputError, match=r"a#\.npz, b#\.npz"):
        load_params(tmp_path)
    bad = params.as_dict() | {"body_pose": np.full((FRAMES, 63), np.nan)}
    np.savez(tmp_path / "bad.npz", **bad)
    for read in (load_params, lambda path: load_motion(path, load_body())):  # nothing can stand in for all of them
        with pytest.raises(InputError, match=r"bad\.npz: parameter body_pose"):
            read(tmp_path / "bad.npz")


def test_frames_without_a_pose_are_told_where_that_is_asked_for(params, tmp_path):
    assert FRAMES == 3
    for bad, stand in (((0,), (1, 1, 2)), ((1, 2), (0, 0, 0)), ((), (0, 1, 2))):
        arrays = {name: np.array(value) for name, value in params.as_dict().items()}
        for row in bad:
            arrays["body_pose"][row, 5] = np.nan
        np.savez(tmp_path / "holes.npz", **arrays)
        read, family, holes = load_motion(tmp_path / "holes.npz", load_body())
        assert_same(read, params.select(list(stand)))
        assert tuple(holes) == bad and family is None
        if bad:
            with pytest.raises(InputError, match="body_pose"):
                load_params(tmp_path / "holes.npz")


def test_the_capture_s_frames_equal_its_stacked_file(captures):
    folder = captures / "woman_casual" / "params"
    assert_same(load_params(folder), load_params(folder / "params.npz"))


@pytest.mark.parametrize("name", ["expression", "expressions"])
def test_speech_motion_beside_amass_keys_keeps_its_face(tmp_path, name):
    rows, rng = 4, np.random.default_rng(0)
    face = rng.normal(size=(rows, 10)).astype(np.float32)
    poses = rng.normal(0, 0.1, (rows, 165))
    place = np.zeros((rows, 3))
    np.savez(tmp_path / "a.npz", poses=poses, trans=place, betas=np.zeros(10), mocap_frame_rate=30, **{name: face})
    np.testing.assert_array_equal(load_params(tmp_path / "a.npz", whose="body", up="y").expression, face)


def test_parts_of_amass_poses_alone_are_read(tmp_path):
    """Retargeting tools write `root_orient` and `pose_body` without `poses`, often without hands: it was refused."""
    rows, rng = 4, np.random.default_rng(0)
    parts = {name: rng.normal(0, 0.1, (rows, n)) for name, n in (("root_orient", 3), ("pose_body", 63))}
    others = dict(trans=np.zeros((rows, 3)), betas=np.zeros(10), mocap_frame_rate=50.0)
    hands = rng.normal(0, 0.1, (rows, 90))
    np.savez(tmp_path / "a.npz", **parts, **others)
    np.savez(tmp_path / "b.npz", **parts, **others, pose_hand=hands)
    for name, hand in (("a.npz", np.zeros((rows, 45))), ("b.npz", hands[:, 45:])):
        read = load_params(tmp_path / name, whose="body", up="y")
        np.testing.assert_array_equal(read.body_pose, parts["pose_body"])
        np.testing.assert_array_equal(read.right_hand_pose, hand)
        assert read.fps == 50.0
    np.savez(tmp_path / "c.npz", **parts, **others, pose_hand=hands[1:])
    with pytest.raises(InputError, match="as many frames in each"):
        load_params(tmp_path / "c.npz")


def test_arrays_that_nobody_reads_are_named_once(tmp_path):
    rows = 3
    poses, place = np.zeros((rows, 165)), np.zeros((rows, 3))
    content = dict(poses=poses, trans=place, betas=np.zeros(10), mocap_frame_rate=30, dmpls=np.zeros((rows, 8)))
    # What is zero moves nothing, a copy of the poses says nothing new, a single number describes the file.
    np.savez(tmp_path / "a.npz", **content, pose_body=np.ones((rows, 63)), mocap_time_length=4.0)
    load_params(tmp_path / "a.npz", whose="body", up="y")
    np.savez(tmp_path / "b.npz", **content | {"dmpls": np.ones((rows, 8)), "soft": np.ones(4)})
    with pytest.warns(GeometryWarning, match=r"not read in the layout amass: dmpls, soft$") as found:
        load_params(tmp_path / "b.npz", whose="body", up="y")
    assert len(found) == 1


def test_dances_of_aist_are_amass_in_other_names_and_units(tmp_path):
    """`smpl_scaling` units make a metre, and the dancer stands on y."""
    rng = np.random.default_rng(5)
    poses, trans = np.pad(rng.normal(scale=0.1, size=(4, 66)), ((0, 0), (0, 6))), rng.normal(size=(4, 3))
    path = tmp_path / "gBR_sBM_cAll_d04_mBR0_ch01.pkl"
    path.write_bytes(pickle.dumps({"smpl_poses": poses, "smpl_trans": 95.0 * trans, "smpl_scaling": np.array([95.0])}))
    plain = tmp_path / "plain.npz"
    np.savez(plain, poses=poses, trans=trans, betas=np.zeros(10))
    with pytest.warns(GeometryWarning, match="parameters of SMPL,"):
        read, expected = load_params(path), load_params(plain)
    assert read.fps == 60.0
    np.testing.assert_allclose(read.transl, expected.transl, atol=1e-12)
    np.testing.assert_allclose(read.body_pose, expected.body_pose, atol=1e-12)


def test_people_in_lists_are_chosen_by_their_place(tmp_path):
    """3DPW's records: arrays of each person in lists, and what is not of the body beside them."""
    rng = np.random.default_rng(6)
    poses = np.pad(rng.normal(scale=0.1, size=(2, 5, 66)), ((0, 0), (0, 0), (0, 6)))
    people = [{"poses": one, "trans": rng.normal(size=(5, 3))} for one in poses]
    record = {key: [one[key] for one in people] for key in ("poses", "trans")}
    record |= {"betas": [np.zeros(10)] * 2, "genders": ["m", "f"], "cam_poses": np.ones((5, 4, 4)), "sequence": "walk"}
    path = tmp_path / "walk.pkl"
    path.write_bytes(pickle.dumps(record))
    with pytest.raises(InputError, match=r"walk\.pkl: people: expected one of 2 people.*0 to 1"):
        load_params(path)
    for place, one in enumerate(people):
        alone = tmp_path / f"{place}.npz"
        np.savez(alone, **one, betas=np.zeros(10))
        with pytest.warns(GeometryWarning, match="parameters of SMPL,"):
            read, expected = load_params(path, person=place), load_params(alone)
        np.testing.assert_array_equal(read.transl, expected.transl)
        np.testing.assert_array_equal(read.body_pose, expected.body_pose)


@pytest.mark.parametrize("key", ["poses", "trans"])
def test_a_single_number_in_the_place_of_rows_is_named(tmp_path, key):
    record = {"poses": np.zeros((1, 4, 72)), "trans": np.zeros((1, 4, 3)), "betas": np.zeros(10)} | {key: np.zeros(())}
    np.savez(tmp_path / "walk.npz", **record)
    with pytest.raises(InputError, match=r"walk\.npz"):
        load_params(tmp_path / "walk.npz")
