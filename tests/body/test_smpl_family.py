"""Parameters of SMPL, SMPL-H and SMPL-X are told from the open body's, and their turns mean the same on it."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.commands.driving import Driving
from smplxpp.body import family_of_params, load_body, load_params, smpl_joints, with_smpl_joints
from smplxpp.body.retarget import FEET, Skeleton
from smplxpp.body.smpl_joints import BODY_JOINTS, smpl_joint_regressor, smpl_offsets
from smplxpp.body.smpl_params import from_smpl, rests_like_smpl, smpl_places, smpl_skeleton
from smplxpp.core import BodyParams, GeometryWarning, InputError, matrix_from_rotvec
from smplxpp.export.motion_files import write_amass
from tests.body.walks import shaped, walk

Z_UP = np.array([np.pi / 2, 0.0, 0.0])  # SMPL's rest pose, upright in a world with z up


def sideways(frames: int = 4) -> BodyParams:
    """Hips bent and spread, an arm down, a turn about the vertical: turns in which pivots and rest poses matter."""
    pose = np.zeros((frames, 55, 3))
    names = list(load_body().joint_names)
    pose[:, 0, 1] = np.linspace(0.0, 1.2, frames)
    for name, turn in {"left_hip": (-0.9, 0, 0.3), "right_knee": (1.0, 0, 0), "left_shoulder": (0, 0, -1.1)}.items():
        pose[:, names.index(name)] = turn
    transl = np.stack([np.zeros(frames), np.full(frames, 1.1), np.linspace(0, 0.5, frames)], axis=1)
    return BodyParams.from_full_pose(
        pose, betas=np.full((1, 10), 0.5), expression=np.zeros((1, 10)), transl=transl, flat_hand_mean=True
    )


def row(params: BodyParams, width: int) -> np.ndarray:
    """Poses as the family's files have them: 72 of SMPL, 156 of SMPL-H, 165 of SMPL-X."""
    face = [params.jaw_pose, params.leye_pose, params.reye_pose] if width == 165 else []
    hands = [np.zeros((len(params), 6))] if width == 72 else [params.left_hand_pose, params.right_hand_pose]
    return np.concatenate([params.global_orient, params.body_pose, *face, *hands], axis=1)


def write(path: Path, kind: str, params: BodyParams) -> Path:
    """A file as other programs write it."""
    shape = {"betas": params.betas[0]}
    values = {
        "amass smplh": {"poses": row(params, 156), "trans": params.transl, "gender": "male", "mocap_framerate": 60.0},
        "amass smplx": {"poses": row(params, 165), "trans": params.transl, "mocap_frame_rate": 60.0},
        "poses smpl": {"poses": row(params, 72), "trans": params.transl},
        "pose smpl": {"pose": row(params, 72), "trans": params.transl, "shape": params.betas},
        "names smpl": {
            "global_orient": params.global_orient,
            "body_pose": row(params, 72)[:, 3:],
            "transl": params.transl,
        },
        "names": {"global_orient": params.global_orient, "body_pose": params.body_pose, "transl": params.transl},
    }[kind]
    np.savez(path, **(shape | values if "shape" not in values else values))
    return path


KINDS = ["amass smplh", "amass smplx", "poses smpl", "pose smpl", "names smpl"]


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_of_the_family_are_recognised_and_told(tmp_path, kind):
    """They were posed as the open body's: .42 m too high, its legs 7 degrees too far apart, without a word."""
    family = kind.split()[1]
    path = write(tmp_path / "p.npz", kind, sideways())
    assert family_of_params(path) == family
    words = {"smpl": "SMPL,", "smplh": "SMPL-H,", "smplx": "SMPL-X,"}[family]
    with pytest.warns(GeometryWarning, match=f"parameters of {words} not of the open body.*--body.*--whose body"):
        found = load_params(path, up="y")
    assert found.betas.shape[1] == 0
    # The pelvis is where SMPL's is: its place at rest and the translation.
    pelvis = smpl_joints(load_body(), found)[:, 0]
    np.testing.assert_allclose(pelvis, smpl_skeleton(family).places[0] + sideways().transl, atol=1e-6)
    # Who says that they are the open body's, or a family's, is obeyed without a warning.
    with warnings.catch_warnings():
        warnings.simplefilter("error", GeometryWarning)
        np.testing.assert_array_equal(load_params(path, up="y", whose="body").body_pose, sideways().body_pose)
        load_params(write(tmp_path / "n.npz", "names", sideways()), whose="smplx")
    with pytest.raises(InputError, match="option whose"):
        load_params(path, whose="mine")


def test_names_alone_tell_nothing(tmp_path):
    assert family_of_params(write(tmp_path / "n.npz", "names", sideways())) is None


def test_bones_point_where_smpls_do():
    """Against SMPL's own skeleton: a bone's direction by its published places and the turns, in every frame."""
    params, body = sideways(), load_body()
    theirs, ours = smpl_skeleton("smpl").pose(params), smpl_joints(body, from_smpl(params, "smpl", body))
    plain = smpl_joints(body, replace(params, betas=np.zeros((4, 0)), expression=np.zeros((4, 0))))
    at = {name: k for k, name in enumerate(BODY_JOINTS)}

    def degrees(found: np.ndarray, begin: str, end: str) -> float:
        a, b = (one[:, at[end]] - one[:, at[begin]] for one in (found, theirs))
        cosine = (a * b).sum(1) / np.linalg.norm(a, axis=1) / np.linalg.norm(b, axis=1)
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))).max())

    # Proportions differ, so that a few degrees stay; copied turns leave nine.
    for side in ("left", "right"):
        assert degrees(ours, f"{side}_hip", f"{side}_knee") < 4.0 < degrees(plain, f"{side}_hip", f"{side}_knee")
        assert degrees(ours, f"{side}_knee", f"{side}_ankle") < 4.0
        assert degrees(ours, f"{side}_shoulder", f"{side}_elbow") < 9.0
    assert np.linalg.norm(ours[:, at["left_ankle"]] - theirs[:, at["left_ankle"]], axis=1).max() < 0.14


def test_smpls_joints_on_the_open_body():
    body = load_body()
    rows = smpl_joint_regressor(body)
    np.testing.assert_allclose(rows.sum(axis=1), 1.0, atol=1e-9)
    assert (np.count_nonzero(rows, axis=1) < 800).all() and np.abs(rows).sum(axis=1).max() < 1.2
    own = (body.joint_regressor @ body.v_template)[:22]
    np.testing.assert_allclose(rows @ body.v_template, own + smpl_offsets(), atol=1e-9)
    # Lengths as SMPL's, in the body's size: the open body's mean is 5 % longer in the legs.
    place, theirs = rows @ body.v_template, smpl_skeleton().places
    for begin, end in ((1, 4), (4, 7), (16, 18), (18, 20), (1, 2)):
        ours, published = (np.linalg.norm(p[end] - p[begin]) for p in (place, theirs))
        assert ours == pytest.approx(published, rel=0.12), (BODY_JOINTS[begin], BODY_JOINTS[end])
    # The joints move with the body: a shift of all vertices shifts them, a tall shape carries them along.
    tall = body.v_template + body.shapedirs[..., 0]
    moved = rows @ tall - (body.joint_regressor @ tall)[:22] - smpl_offsets()
    assert np.abs(moved).max() < 0.03
    with pytest.raises(InputError, match="the open body"):
        smpl_joint_regressor(replace(body, left_hand_components=np.eye(45), left_hand_mean=np.zeros(45)))


def test_a_body_with_smpls_joints_turns_about_them():
    body, params = with_smpl_joints(load_body()), sideways()
    ours = body.forward(from_smpl(params, "smpl", body))
    theirs = smpl_skeleton("smpl").pose(params)
    # A bent hip: thigh and shin follow SMPL's within what the lengths differ; about its own hip the ankle is 10 cm off.
    knee, ankle = BODY_JOINTS.index("left_knee"), BODY_JOINTS.index("left_ankle")
    own = smpl_joints(load_body(), from_smpl(params, "smpl", load_body()))
    for joint in (knee, ankle):
        about_smpls = np.linalg.norm(ours.joints[:, joint] - theirs[:, joint], axis=1).max()
        about_own = np.linalg.norm(own[:, joint] - theirs[:, joint], axis=1).max()
        assert about_smpls < 0.07 and about_smpls < about_own
    np.testing.assert_array_equal(body.joint_regressor[22:], load_body().joint_regressor[22:])


# --- AMASS -----------------------------------------------------------------------------------------------------------


def upright(frames: int = 3) -> BodyParams:
    """SMPL-H standing in a world with z up, its pelvis .95 m above the floor."""
    turn = np.tile(Z_UP, (frames, 1))
    place = np.tile([0.2, 0.0, 0.95], (frames, 1)) - smpl_skeleton("smplh").places[0]
    rest = BodyParams.rest(betas=10)
    return replace(
        rest,
        **{k: np.repeat(v, frames, 0) for k, v in rest.as_dict().items() if v.ndim == 2}
        | {"global_orient": turn, "transl": place},
    )


def test_amass_stands_by_itself_and_files_that_state_their_axis_are_obeyed(tmp_path):
    """People of AMASS lay on the floor unless one knew to say --up z."""
    path = write(tmp_path / "walk_poses.npz", "amass smplh", upright())
    with pytest.warns(GeometryWarning, match="SMPL-H"):
        found = load_params(path)
    places = smpl_joints(load_body(), found)
    np.testing.assert_allclose(places[:, 0], [[0.2, 0.95, 0.0]] * 3, atol=1e-6)
    assert (places[:, BODY_JOINTS.index("head"), 1] > 1.4).all()
    # The same in a world with y up: the file says so, or the user; else it is doubted.
    standing = replace(upright(), global_orient=np.zeros((3, 3)))
    path = write(tmp_path / "y_poses.npz", "amass smplh", standing)
    with pytest.warns(GeometryWarning, match="people stand along y.*--up y"):
        load_params(path, whose="smplh")
    with warnings.catch_warnings():
        warnings.simplefilter("error", GeometryWarning)
        said = load_params(path, whose="smplh", up="y")
        with np.load(path) as arrays:
            np.savez(tmp_path / "stated.npz", **arrays, up="Y")
        np.testing.assert_array_equal(load_params(tmp_path / "stated.npz", whose="smplh").transl, said.transl)


def test_our_own_export_says_whose_it_is(tmp_path):
    body = load_body()
    write_amass(tmp_path / "a.npz", body, walk(None))
    with warnings.catch_warnings():
        warnings.simplefilter("error", GeometryWarning)
        back = load_params(tmp_path / "a.npz")
    assert family_of_params(tmp_path / "a.npz") is None
    ours, theirs = (body.forward(it.without_shape()).joints for it in (walk(None), back))
    np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_a_motion_of_smpl_drives_the_open_body_with_feet_on_the_floor(tmp_path):
    """Feet that stand stay where they are, steps are scaled by the legs, the lowest foot is as high as SMPL's."""
    path, body = write(tmp_path / "m.npz", "amass smplh", walk(None)), load_body()
    with pytest.warns(GeometryWarning, match=r"a motion of SMPL-H.*--retarget-from"):
        driven = Driving(up="y").load(path, body)
    source, target = smpl_skeleton("smplh"), Skeleton.of(body)
    theirs, ours = source.pose(load_params(path, up="y", whose="body")), target.pose(driven)
    low = [one.pose(p)[:, one.at(*FEET), 1].min() for one, p in ((source, walk(None)), (target, driven))]
    assert low[0] == pytest.approx(low[1], abs=1e-9)
    way = [float(np.ptp(one[:, 0, 2])) for one in (theirs, ours)]
    assert way[1] / way[0] == pytest.approx(1.05, abs=0.08)  # legs 5 % longer, and feet that do not slide
    # A model of the family takes its parameters as they are.
    licensed = with_smpl_joints(body)
    assert rests_like_smpl(Skeleton.of(licensed)) and rests_like_smpl(source) and not rests_like_smpl(shaped(3))
    np.testing.assert_allclose(smpl_places(target), smpl_joint_regressor(body) @ body.v_template, atol=1e-9)
    with pytest.raises(InputError, match="option whose"):
        Driving(whose="smpl").load(tmp_path / "walk.bvh", body)
    assert np.linalg.norm(matrix_from_rotvec(driven.global_orient)[0] - np.eye(3)) < 0.2
