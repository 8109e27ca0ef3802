"""Files of motion as other programs write them, which once lost the way, joints or the rate without a word."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.commands.params import ParamsConvert
from smplxpp.body import load_body, load_params
from smplxpp.body.skeleton_params import load_skeleton
from smplxpp.core import BodyParams, GeometryWarning, InputError, matrix_from_rotvec
from smplxpp.export.motion_files import write_bvh
from tests.body.walks import FPS, shaped, walk

SMPL_NAMES = {
    "pelvis": "Pelvis",
    "neck": "Neck",
    "head": "Head",
    **{f"spine{k}": f"Spine{k}" for k in (1, 2, 3)},
    **{
        f"{side}_{part}": f"{side[0].upper()}_{part.capitalize()}"
        for side in ("left", "right")
        for part in "hip knee ankle foot collar shoulder elbow wrist".split()
    },
}


def joints(params: BodyParams) -> np.ndarray:
    """(T, 22, 3) from the first pelvis on."""
    found = shaped(None).pose(params)[:, :22]
    return found - found[:1, :1]


@pytest.fixture(scope="module")
def text(tmp_path_factory) -> str:
    """The walk without fingers as our exporter writes it."""
    path = tmp_path_factory.mktemp("bvh") / "walk.bvh"
    write_bvh(path, load_body(), walk(None))
    return path.read_text()


def test_smpl_names_are_joints_and_not_their_neighbours(tmp_path, text):
    """`L_Foot` was taken for the ankle though `L_Ankle` is there, and `Spine1` for the second joint of the spine."""
    for ours, theirs in SMPL_NAMES.items():
        text = text.replace(f" {ours}\n", f" {theirs}\n")
    (tmp_path / "smpl.bvh").write_text(text)
    assert "L_Ankle" in text and "left_ankle" not in text
    params = load_skeleton(tmp_path / "smpl.bvh", shaped(None))
    np.testing.assert_allclose(joints(params), joints(walk(None)), atol=1e-5)


def test_words_of_the_format_in_other_letters_and_as_names(tmp_path, text):
    """`ZPosition`, and a joint named after the word that begins the numbers."""
    changed = text.replace("Yposition", "YPosition").replace(" jaw\n", " MOTION_jaw\n")
    (tmp_path / "a.bvh").write_text(changed)
    assert changed != text
    np.testing.assert_allclose(joints(load_skeleton(tmp_path / "a.bvh", shaped(None))), joints(walk(None)), atol=1e-5)


def test_spines_of_five_joints_keep_the_turn_of_the_last(tmp_path, text):
    """A chain of more than three: the last one below the neck carries shoulders, whatever its name is."""
    lines = text.splitlines()
    row = next(k for k, line in enumerate(lines) if line.strip() == "JOINT spine3")
    for ours, theirs in {"spine1": "spine_01", "spine2": "spine_02", "spine3": "spine_05"}.items():
        lines = [line.replace(f" {ours}", f" {theirs}") for line in lines]
    assert "spine_05" in lines[row]
    for ours, theirs in SMPL_NAMES.items():
        lines = [line if line.split()[-1:] != [ours] else line.replace(ours, theirs) for line in lines]
    (tmp_path / "five.bvh").write_text("\n".join(lines) + "\n")
    np.testing.assert_allclose(
        joints(load_skeleton(tmp_path / "five.bvh", shaped(None))), joints(walk(None)), atol=1e-5
    )


def below_a_root(text: str, *, positions: str) -> str:
    """The file with hips, or all joints, that have positions, below a root that stands still."""
    head, motion = text.split("MOTION\n")
    body, frames = head.replace("HIERARCHY\nROOT", "JOINT"), motion.splitlines()
    root = "HIERARCHY\nROOT joint_Root\n{\nOFFSET 0 0 0\nCHANNELS 6 "
    root += "Xposition Yposition Zposition Zrotation Xrotation Yrotation\n"
    rows = [np.array(line.split(), dtype=float) for line in frames[2:]]
    if positions == "all":
        # Every joint gets position channels, which hold zeros: displacements from the offsets.
        body = body.replace("CHANNELS 3 ", "CHANNELS 6 Xposition Yposition Zposition ")
        width = (len(rows[0]) - 3) // 3
        rows = [
            np.concatenate([row[:6], *(np.r_[np.zeros(3), row[3 * k + 3 :][:3]] for k in range(1, width))])
            for row in rows
        ]
    rows = [np.concatenate([np.zeros(6), row]) for row in rows]
    lines = [" ".join(f"{value:.6f}" for value in row) for row in rows]
    return root + body + "}\nMOTION\n" + "\n".join([*frames[:2], *lines]) + "\n"


@pytest.mark.parametrize("positions", ["hips", "all"])
def test_hips_below_a_root_that_stands_keep_their_way(tmp_path, text, positions):
    """Positions of joints other than the first were dropped, and the person walked on the spot.

    With zeros as the positions of all others, which are displacements then, the skeleton stays whole, too.
    """
    (tmp_path / "root.bvh").write_text(below_a_root(text, positions=positions))
    params = load_skeleton(tmp_path / "root.bvh", shaped(None))
    assert np.ptp(params.transl[:, 2]) > 0.5
    np.testing.assert_allclose(joints(params), joints(walk(None)), atol=1e-5)


def test_bones_that_stretch_are_told(tmp_path, text):
    head, motion = text.split("MOTION\n")
    bone = head[: head.index("left_knee")].count("CHANNELS")
    at = head.index("CHANNELS", head.index("JOINT left_knee"))
    head = head[:at] + head[at:].replace("CHANNELS 3 ", "CHANNELS 6 Xposition Yposition Zposition ", 1)
    rows = motion.splitlines()
    offset = np.array(head[head.index("OFFSET", head.index("JOINT left_knee")) :].split()[1:4], dtype=float)
    for k in range(2, len(rows)):
        values = np.array(rows[k].split(), dtype=float)
        stretched = offset * (1.0 + 0.3 * (k % 2))
        rows[k] = " ".join(map(str, np.insert(values, 3 * bone + 3, stretched)))
    (tmp_path / "stretch.bvh").write_text(head + "MOTION\n" + "\n".join(rows) + "\n")
    with pytest.warns(GeometryWarning, match=r"1 bones move.*left_knee most, by up to 30 %"):
        load_skeleton(tmp_path / "stretch.bvh", shaped(None))


# --- parameters ------------------------------------------------------------------------------------------------------


def as_matrices(params: BodyParams) -> dict[str, np.ndarray]:
    """What recent estimators write: a rotation matrix a joint."""
    arrays = params.as_dict()
    for name in ("global_orient", "body_pose", "left_hand_pose"):
        arrays[name] = matrix_from_rotvec(arrays[name].reshape(len(params), -1, 3)).astype("f4")
    return arrays


@pytest.mark.parametrize("frames", [1, 3])
def test_rotation_matrices_are_read(tmp_path, frames):
    walked = walk(None).select(slice(frames))
    np.savez(tmp_path / "m.npz", **as_matrices(walked))
    read = load_params(tmp_path / "m.npz")
    for name in ("global_orient", "body_pose", "transl"):
        np.testing.assert_allclose(getattr(read, name), getattr(walked, name), atol=2e-6, err_msg=name)
    # One frame without the axis of frames, the root's matrix beside axis-angle vectors of the body.
    if frames == 1:
        matrix = as_matrices(walked)["global_orient"][0, 0]
        np.savez(tmp_path / "one.npz", **walked.as_dict() | {"global_orient": matrix})
        np.testing.assert_allclose(load_params(tmp_path / "one.npz").global_orient, walked.global_orient, atol=2e-6)


@pytest.mark.parametrize("form", ["flat matrices", "no axis for the joint", "a joint a row", "SMPL's 23", "whole"])
def test_rotations_of_any_shape_are_read(tmp_path, form):
    """Shapes of estimators that were refused without a word on what they are, or taken for frames."""
    params = walk(None).select(slice(3))
    arrays, whole = as_matrices(params), params.as_dict()
    if form == "flat matrices":
        whole |= {name: arrays[name].reshape(3, -1) for name in ("global_orient", "body_pose")}
    elif form == "no axis for the joint":
        whole |= {"global_orient": arrays["global_orient"][:, 0], "body_pose": arrays["body_pose"]}
    elif form == "a joint a row":
        whole |= {"body_pose": whole["body_pose"].reshape(3, 21, 3), "global_orient": whole["global_orient"][:, None]}
    else:
        hands = np.tile(np.eye(3), (3, 2, 1, 1))
        whole |= {
            "global_orient": arrays["global_orient"],
            "body_pose": np.concatenate([arrays["body_pose"], hands], 1),
        }
    if form == "whole":
        pose = np.concatenate([whole["global_orient"], whole["body_pose"]], axis=1)
        whole = {"pose": pose, "trans": whole["transl"], "betas": np.zeros((3, 10))}
    np.savez(tmp_path / "m.npz", **whole)
    read = load_params(tmp_path / "m.npz", whose="body")
    for name in ("global_orient", "body_pose", "transl"):
        np.testing.assert_allclose(getattr(read, name), getattr(params, name), atol=2e-6, err_msg=name)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda turns: 2.0 * turns, r"body_pose: expected rotation matrices"),
        (lambda turns: turns[..., :2].reshape(-1, 21, 6), r"six numbers a joint.*first two columns"),
        (lambda turns: turns[..., :2].reshape(-1, 126), r"six numbers a joint.*first two columns"),
        (lambda turns: turns[..., :1, :].repeat(2, -1)[..., :4].reshape(-1, 21, 4), r"four numbers a joint.*w first"),
    ],
)
def test_what_is_no_rotation_is_named(tmp_path, change, words):
    arrays = as_matrices(walk(None))
    np.savez(tmp_path / "m.npz", **arrays | {"body_pose": change(arrays["body_pose"])})
    with pytest.raises(InputError, match=words):
        load_params(tmp_path / "m.npz")


def test_a_dictionary_in_an_npy_is_read(tmp_path):
    np.save(tmp_path / "d.npy", walk(None).as_dict(), allow_pickle=True)
    np.testing.assert_array_equal(load_params(tmp_path / "d.npy").body_pose, walk(None).body_pose)
    (tmp_path / "walk.usdc").write_bytes(b"PXR-USDC")
    with pytest.raises(InputError, match=r"Open it in Blender, File > Export > glTF 2.0"):
        load_params(tmp_path / "walk.usdc")
    (tmp_path / "results.pt").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"\.pt.*numpy\.savez"):
        load_params(tmp_path / "results.pt")


@pytest.mark.parametrize(
    ("frames", "fps", "rate"), [("::4", None, FPS / 4), ("::-2", 29.476, 29.476 / 2), (None, 12.0, 12.0)]
)
def test_every_nth_frame_plays_at_the_same_speed(tmp_path, frames, fps, rate):
    """Every fourth frame kept the rate and played four times too fast."""
    walk(None).save(tmp_path / "walk.npz")
    summary = ParamsConvert(input=tmp_path / "walk.npz", out=tmp_path / "o.npz", frames=frames, fps=fps).run()
    assert summary["fps"] == pytest.approx(rate) and load_params(tmp_path / "o.npz").fps == pytest.approx(rate)
    with pytest.raises(InputError, match="option fps"):
        ParamsConvert(input=tmp_path / "walk.npz", out=tmp_path / "o.npz", fps=-1.0).run()


def test_selected_rows_keep_the_rate():
    assert walk(None).select([0, 4]).fps == FPS and walk(None).select(slice(2, 9)).fps == FPS
