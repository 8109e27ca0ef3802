"""Keypoints of detectors: small files in each one's real layout, whose points are known by name."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from smplxpp.body.layout import (
    BODY_25,
    BODY_25B,
    BODY_135,
    COCO_17,
    HALPE_26,
    HALPE_136,
    MEDIAPIPE_FACE,
    MEDIAPIPE_POSE,
    VOCABULARY,
    WHOLE_BODY_133,
)
from smplxpp.capture.keypoint_files import KeypointOptions, read_keypoints
from smplxpp.capture.keypoints import find_places
from smplxpp.core import InputError, Keypoints2D

# Where each named point lies in frame 0: told by a number of the name, not by a place in any list.
NAMES = sorted(VOCABULARY)
PLACE = {name: np.array([20.0 + 2 * k, 300.0 - 3 * k]) for k, name in enumerate(NAMES)}
HAND = [
    f"{finger}{joint}" for finger in ("thumb", "index", "middle", "ring", "pinky") for joint in ("1", "2", "3", "_tip")
]
# As OpenPose's own documentation counts: https://github.com/CMU-Perceptual-Computing-Lab/openpose, doc/02_output.md.
OPENPOSE_25 = {0: "nose", 4: "coco_right_wrist", 7: "coco_left_wrist", 9: "coco_right_hip", 16: "left_eye"} | {
    19: "left_big_toe",
    24: "right_heel",
}


def rows(order, frame: int = 0, confidence: float = 0.5) -> np.ndarray:
    """Points of a list in the detector's pixels, whose centres are at whole numbers; NaN-free noise where unnamed."""
    out = np.full((len(order), 3), 7.0)
    out[:, 2] = confidence
    for k, name in enumerate(order):
        if name is not None:
            out[k, :2] = PLACE[name] + frame - 0.5
    return out


def check(found: Keypoints2D, order, frames=(0, 1), *, confidence: float | None = 0.5) -> None:
    assert found.frames.tolist() == list(frames)
    assert set(order) - {None} <= set(found.names)
    for k, name in enumerate(found.names):
        for row in range(len(frames)):
            np.testing.assert_allclose(found.points[row, k], PLACE[name] + row, atol=1e-9, err_msg=name)
    if confidence is not None:
        np.testing.assert_allclose(found.confidence, confidence, atol=1e-12)


def write(path: Path, content: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
    return path


def openpose(order, frame: int, *, hands: bool = True, person: int = -1, confidence: float = 0.5) -> dict:
    def flat(values: np.ndarray) -> list[float]:
        return values.ravel().tolist()

    left = [None] + [f"left_{name}" for name in HAND]
    right = [None] + [f"right_{name}" for name in HAND]
    face = [None] * 17 + [f"face_{k}" for k in range(17, 68)] + [None, None]
    return {
        "person_id": [person],
        "pose_keypoints_2d": flat(rows(order, frame, confidence)),
        "face_keypoints_2d": flat(rows(face, frame, confidence)) if hands else [],
        "hand_left_keypoints_2d": flat(rows(left, frame, confidence)) if hands else [],
        "hand_right_keypoints_2d": flat(rows(right, frame, confidence)) if hands else [],
        "pose_keypoints_3d": [],
    }


@pytest.mark.parametrize("hands", [True, False])
def test_openpose_a_file_a_frame(tmp_path, hands):
    for frame in range(2):
        content = {"version": 1.3, "people": [openpose(BODY_25, frame, hands=hands)]}
        write(tmp_path / f"A_0000000000{frame:02d}_keypoints.json", content)
    check(read_keypoints(tmp_path), BODY_25)
    assert len(read_keypoints(tmp_path).names) == 23 + (91 if hands else 0)
    for place, name in OPENPOSE_25.items():
        assert BODY_25[place] == name


def test_openpose_25b_has_to_be_named_and_135_is_one_list(tmp_path):
    for frame in range(2):
        write(tmp_path / "b" / f"{frame}_keypoints.json", {"people": [openpose(BODY_25B, frame, hands=False)]})
        write(tmp_path / "all" / f"{frame}_keypoints.json", {"people": [openpose(BODY_135, frame, hands=False)]})
    check(read_keypoints(tmp_path / "b", KeypointOptions(format="openpose-25b")), BODY_25B)
    check(read_keypoints(tmp_path / "all"), BODY_135)
    # POSE_BODY_135_BODY_PARTS: 25 of the body, 20 of each hand without the wrist, 70 of the face.
    assert (BODY_135[25], BODY_135[44], BODY_135[45], BODY_135[65 + 17]) == (
        "left_thumb1",
        "left_pinky_tip",
        "right_thumb1",
        "face_17",
    )
    assert len(BODY_135) == 135


def test_the_surest_person_counts_or_the_one_that_is_named(tmp_path):
    far = openpose(BODY_25, 40, person=7, confidence=0.2)
    near = openpose(BODY_25, 0, person=3)
    write(tmp_path / "000000_keypoints.json", {"people": [far, near]})
    check(read_keypoints(tmp_path), BODY_25, (0,))
    other = read_keypoints(tmp_path, KeypointOptions(person=7))
    np.testing.assert_allclose(other.points[0, other.names.index("nose")], PLACE["nose"] + 40)
    with pytest.raises(InputError, match=r"\[3, 7\]"):
        read_keypoints(tmp_path, KeypointOptions(person=5))


def test_frames_without_people_are_there_with_confidence_0(tmp_path):
    write(tmp_path / "10_keypoints.json", {"people": [openpose(BODY_25, 0)]})
    write(tmp_path / "12_keypoints.json", {"people": []})
    found = read_keypoints(tmp_path)
    assert found.frames.tolist() == [10, 12] and (found.confidence[1] == 0).all() and (found.confidence[0] > 0).all()
    assert read_keypoints(tmp_path, KeypointOptions(first_frame=0)).frames.tolist() == [0, 2]


def test_easymocap_annotations(tmp_path):
    left, right = ([None] + [f"{side}_{name}" for name in HAND] for side in ("left", "right"))
    face = [None] * 17 + [f"face_{k}" for k in range(17, 68)] + [None, None]
    for frame in range(2):
        one = {
            "bbox": [0, 0, 9, 9, 1],
            "personID": 4,
            "keypoints": rows(BODY_25, frame).tolist(),
            "handl2d": rows(left, frame).tolist(),
            "handr2d": rows(right, frame).tolist(),
            "face2d": rows(face, frame).tolist(),
        }
        write(tmp_path / f"{frame:06d}.json", {"filename": "x.jpg", "height": 9, "width": 9, "annots": [one]})
    found = read_keypoints(tmp_path)
    check(found, BODY_25)
    assert {"left_ring_tip", "right_thumb1", "face_67"} <= set(found.names)
    check(read_keypoints(tmp_path, KeypointOptions(person=4)), BODY_25)


@pytest.mark.parametrize(
    "order", [COCO_17, WHOLE_BODY_133, HALPE_26, HALPE_136], ids=["coco 17", "whole body 133", "halpe 26", "halpe 136"]
)
@pytest.mark.parametrize("layout", ["video", "images", "results"])
def test_mmpose_and_coco(tmp_path, order, layout):
    def instance(frame: int) -> dict:
        values = rows(order, frame)
        return {"keypoints": values[:, :2].tolist(), "keypoint_scores": values[:, 2].tolist(), "bbox": [[0, 0, 9, 9]]}

    if layout == "video":
        entries = [{"frame_id": frame + 1, "instances": [instance(frame)]} for frame in range(2)]
        path = write(
            tmp_path / "results_A.json", {"meta_info": {"num_keypoints": len(order)}, "instance_info": entries}
        )
        check(read_keypoints(path, KeypointOptions(first_frame=0)), order)
        assert read_keypoints(path).frames.tolist() == [1, 2]
        return
    if layout == "images":
        for frame in range(2):
            write(tmp_path / f"A_{frame:06d}.json", [instance(frame)])
        path = tmp_path
    else:
        entries = [
            {
                "image_id": 1 - frame,
                "category_id": 1,
                "keypoints": rows(order, 1 - frame).ravel().tolist(),
                "score": 0.9,
            }
            for frame in range(2)
        ]
        path = write(tmp_path / "A.json", entries)
    check(read_keypoints(path), order)


def test_whole_body_order_is_mmposes():
    """Blocks of `configs/_base_/datasets/coco_wholebody.py`: 17 body, 6 feet, 68 face, 21 left hand, 21 right hand."""
    assert [WHOLE_BODY_133[k] for k in (0, 5, 16, 17, 19, 20, 22)] == [
        "nose",
        "coco_left_shoulder",
        "coco_right_ankle",
        "left_big_toe",
        "left_heel",
        "right_big_toe",
        "right_heel",
    ]
    assert WHOLE_BODY_133[23:40] == (None,) * 17 and WHOLE_BODY_133[40] == "face_17" and WHOLE_BODY_133[90] == "face_67"
    assert (WHOLE_BODY_133[91], WHOLE_BODY_133[92], WHOLE_BODY_133[111]) == (None, "left_thumb1", "left_pinky_tip")
    assert (WHOLE_BODY_133[116 + 1], WHOLE_BODY_133[132]) == ("right_index1", "right_pinky_tip")


def test_halpe_orders_are_mmposes_and_alphaposes_list_is_read(tmp_path):
    """Blocks of `configs/_base_/datasets/halpe26.py` and `halpe.py`; AlphaPose's names of images and its `idx`."""
    assert HALPE_26[:17] == COCO_17 and HALPE_26[17:20] == (None, None, None)  # head, neck, hip
    assert HALPE_26[20:] == (
        "left_big_toe",
        "right_big_toe",
        "left_small_toe",
        "right_small_toe",
        "left_heel",
        "right_heel",
    )
    assert (HALPE_136[26 + 17], HALPE_136[93], HALPE_136[95], HALPE_136[135]) == (
        "face_17",
        "face_67",
        "left_thumb1",
        "right_pinky_tip",
    )
    entries = [
        {
            "image_id": f"{frame}.jpg",
            "category_id": 1,
            "keypoints": rows(HALPE_26, frame).ravel().tolist(),
            "score": 2.48,
            "box": [0, 0, 9, 9],
            "idx": 1,
        }
        for frame in range(2)
    ]
    check(read_keypoints(write(tmp_path / "alphapose-results.json", entries)), HALPE_26)


def mediapipe_parts(frame: int, size: tuple[int, int] | None) -> dict[str, np.ndarray]:
    """MediaPipe's arrays of a frame: pixels, or shares of the size; 0.5 of visibility for the pose alone."""
    scale = np.array([1.0, 1.0] if size is None else size)

    def landmarks(order) -> np.ndarray:
        points = rows(order, frame)[:, :2] + 0.5  # its shares count from the image's edge
        return np.concatenate([points / scale, np.zeros((len(points), 1))], axis=1)

    face = np.full((478, 3), 0.4)
    for k, own in enumerate(MEDIAPIPE_FACE):
        face[list(own), :2] = (PLACE[f"face_{17 + k}"] + frame) / scale
    pose = np.concatenate([landmarks(MEDIAPIPE_POSE), np.full((33, 1), 0.5)], axis=1)
    hands = {f"{s}_hand": landmarks([None] + [f"{s}_{name}" for name in HAND]) for s in ("left", "right")}
    return {"pose": pose, "face": face, **hands}


@pytest.mark.parametrize("size", [None, (640, 480)], ids=["pixels", "shares"])
@pytest.mark.parametrize("suffix", ["npz", "json", "folder"])
def test_mediapipe(tmp_path, size, suffix):
    parts = [mediapipe_parts(frame, size) for frame in range(2)]
    if suffix == "npz":
        path = tmp_path / "A.npz"
        np.savez(path, **{name: np.stack([one[name] for one in parts]) for name in parts[0]})
    else:
        entries = []
        for one in parts:
            keys = ("x", "y", "z", "visibility")
            entry: dict = {
                f"{name}_landmarks": [dict(zip(keys, row, strict=False)) for row in value.tolist()]
                for name, value in one.items()
            }
            entries.append(entry)
        path = tmp_path / "A.json" if suffix == "json" else tmp_path / "A"
        if suffix == "json":
            write(path, entries)
        else:
            for frame, entry in enumerate(entries):
                write(path / f"{frame}.json", entry)
    found = read_keypoints(path, KeypointOptions(size=size))
    check(found, MEDIAPIPE_POSE, confidence=None)
    confidence = dict(zip(found.names, found.confidence[0], strict=True))
    assert confidence["nose"] == 0.5 and confidence["left_index_tip"] == 1.0 and confidence["face_40"] == 1.0
    if size is not None:
        with pytest.raises(InputError, match="--size"):
            read_keypoints(path)


def test_mediapipe_frames_without_a_hand(tmp_path):
    parts = [mediapipe_parts(frame, None) for frame in range(2)]
    parts[1]["left_hand"][:] = np.nan
    np.savez(tmp_path / "A.npz", **{name: np.stack([one[name] for one in parts]) for name in parts[0]})
    found = read_keypoints(tmp_path / "A.npz")
    gone = found.confidence[1] == 0
    assert {name for name, one in zip(found.names, gone, strict=True) if one} == {f"left_{name}" for name in HAND}


def test_ours_and_its_errors(tmp_path):
    values = np.zeros((2, 2, 3))
    values[..., 2] = 1.0
    np.savez(tmp_path / "A.npz", keypoints=values, joint_names=["pelvis", "head"], frames=[3, 5])
    assert read_keypoints(tmp_path / "A.npz").frames.tolist() == [3, 5]
    np.savez(tmp_path / "B.npz", keypoints=values[:, :1], joint_names=["pelvis", "head"])
    with pytest.raises(InputError, match=r"B\.npz.*\(frames, 2, 3\)"):
        read_keypoints(tmp_path / "B.npz")
    values[0, 0, 2] = 3.0
    np.savez(tmp_path / "C.npz", keypoints=values, joint_names=["pelvis", "head"])
    with pytest.raises(InputError, match=r"C\.npz.*from 0 to 1"):
        read_keypoints(tmp_path / "C.npz")


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"people": [{"pose_keypoints_2d": [1.0] * 54}]}, "18 points"),
        ({"shapes": []}, "another kind"),
        ({"people": [{"body": []}]}, "KeyError"),
    ],
)
def test_what_is_not_understood_is_named(tmp_path, content, words):
    write(tmp_path / "A" / "000000.json", content)
    with pytest.raises(InputError, match=words):
        read_keypoints(tmp_path / "A")
    (tmp_path / "broken.json").write_text('{"people": ')
    with pytest.raises(InputError, match=r"broken\.json.*JSON"):
        read_keypoints(tmp_path / "broken.json")
    with pytest.raises(InputError, match="no such file"):
        read_keypoints(tmp_path / "nothing")


def test_places_of_cameras(tmp_path):
    for name in ("Cam1.npz", "results_Cam10.json", "Cam2_keypoints.json", "notes.txt"):
        (tmp_path / name).write_text("")
    (tmp_path / "Cam3").mkdir()
    expected = {"Cam1": "Cam1.npz", "Cam10": "results_Cam10.json", "Cam2": "Cam2_keypoints.json", "Cam3": "Cam3"}
    found = find_places(tmp_path, ["Cam1", "Cam10", "Cam2", "Cam3", "Cam4"])
    assert {camera: path.name for camera, path in found.items()} == expected
    assert {camera: path.name for camera, path in find_places(tmp_path).items()} == expected


@pytest.mark.parametrize("place", ["cam.npz", "cam/0007_keypoints.json"])
def test_a_captures_folder_with_the_keypoints_of_one_camera(tmp_path, place):
    """`keypoints detect --out CAPTURE/keypoints` writes it, and `capture turntable --keypoints` refused it."""
    path = tmp_path / place
    path.parent.mkdir(exist_ok=True)
    if place.endswith("npz"):
        np.savez(path, keypoints=np.ones((1, 1, 3)), joint_names=np.array(["nose"]), frames=np.array([7]))
    else:
        path.write_text(json.dumps({"people": [{"pose_keypoints_2d": rows(BODY_25).ravel().tolist()}]}))
    found = read_keypoints(tmp_path)
    assert found.frames.tolist() == [7] and "nose" in found.names
    (tmp_path / "other.npz").write_bytes(b"")
    with pytest.raises(InputError, match="expected an npz or JSON file"):
        read_keypoints(tmp_path)
