"""Keypoints of a capture by a detector: the files, what is kept, who is chosen, what is left out."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
from PIL import Image

from pipelines.cli import main
from smplxpp.capture import open_capture
from smplxpp.core.errors import InputError
from smplxpp.detect import DetectedPerson
from smplxpp.footage.keypoints import detect_keypoints, detection_notes
from tests.capture.scene import LENS, make_scene
from tests.capture.writers import write_simple
from tests.detect.keypoint_models import write_card, write_model

NAMES = ("nose", "coco_left_hip")


class Finder:
    """Finds as many people as it is told to, at the middle of the box or of the image; counts what it looks at."""

    names = NAMES

    def __init__(self, people: int = 1, identity: str = "finder") -> None:
        self.people, self.identity, self.seen = people, identity, []

    def __call__(self, image, box=None):
        self.seen.append((image.shape, box))
        height, width = image.shape[:2]
        x0, y0, x1, y1 = (0.0, 0.0, float(width), float(height)) if box is None else box
        return [
            DetectedPerson(
                np.array([[x0, y0], [x1, y1]]) + (0 if k + 1 == self.people else 300 * (k + 1)),
                np.full(2, 0.9 - 0.2 * k),
            )
            for k in range(self.people)
        ]


@pytest.fixture
def rig(tmp_path):
    return write_simple(make_scene(), tmp_path / "rig")


def test_files_are_read_again_as_the_captures_keypoints(rig, tmp_path):
    capture, finder = open_capture(rig), Finder()
    found = detect_keypoints(capture, finder, tmp_path / "k")
    assert len(finder.seen) == 6 and set(found) == {"A", "B", "C"}
    again = open_capture(rig, keypoints=tmp_path / "k")
    for camera in again.cameras:
        points = again.keypoints(camera)
        assert points.names == NAMES and points.frames.tolist() == [0, 1]
        for row, frame in enumerate((0, 1)):
            rows, columns = np.nonzero(capture.mask(camera, frame) > 127)
            box = [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]
            np.testing.assert_allclose(points.points[row].ravel(), box)
    assert detection_notes(found) == ()


def test_what_stands_is_kept_and_what_changed_is_detected_anew(rig, tmp_path):
    def again(finder: Finder, **options) -> int:
        detect_keypoints(open_capture(rig), finder, tmp_path / "k", **options)
        return len(finder.seen)

    assert again(Finder(), frames=[0]) == 3
    first = (tmp_path / "k" / "A.npz").read_bytes()
    assert again(Finder()) == 3
    assert again(Finder()) == 0
    assert (tmp_path / "k" / "A.npz").read_bytes() != first
    (image,) = (rig / "rgbs" / "B").glob("B_rgb000001.*")
    Image.fromarray(255 - np.asarray(Image.open(image))).save(image)
    assert again(Finder()) == 1
    mask = rig / "masks" / "C" / "C_mask000000.png"
    Image.fromarray(np.full((256, 192), 255, np.uint8)).save(mask)
    assert again(Finder()) == 1
    assert again(Finder(identity="another")) == 6
    assert again(Finder(identity="another")) == 0


def test_a_kill_loses_little(rig, tmp_path, monkeypatch):
    class Killed(Finder):
        def __call__(self, image, box=None):
            if len(self.seen) == 3:
                raise KeyboardInterrupt
            return super().__call__(image, box)

    monkeypatch.setattr("smplxpp.footage.keypoints._SAVE_EVERY_S", 0.0)
    with pytest.raises(KeyboardInterrupt):
        detect_keypoints(open_capture(rig), Killed(), tmp_path / "k")
    rest = Finder()
    detect_keypoints(open_capture(rig), rest, tmp_path / "k")
    assert len(rest.seen) == 3


def test_held_out_cameras_are_left_out_unless_they_are_named(rig, tmp_path):
    capture = open_capture(rig, hold_out_every=3)
    assert capture.splits.novel_view_cameras == ("C",)
    assert set(detect_keypoints(capture, Finder(), tmp_path / "k")) == {"A", "B"}
    assert not (tmp_path / "k" / "C.npz").exists()
    found = detect_keypoints(capture, Finder(), tmp_path / "k", cameras=("C",))
    assert any("held-out" in words for words in detection_notes(found, ("C",)))
    with np.load(tmp_path / "k" / "C.npz") as file:
        assert bool(file["held_out"][0])


def test_distorted_images_are_looked_at_as_they_lie(tmp_path):
    rig = write_simple(make_scene(), tmp_path / "rig")
    capture, finder = open_capture(rig).resized(0.5), Finder()
    detect_keypoints(capture, finder, tmp_path / "k")
    assert {shape for shape, _ in finder.seen} == {(256, 192, 3)}  # the files', not the window's
    assert LENS  # a lens moves the points when they are read: tests/capture/test_keypoints.py


def test_two_people_are_told_and_the_one_in_the_mask_is_taken(rig, tmp_path):
    found = detect_keypoints(open_capture(rig), Finder(people=2), tmp_path / "k")
    assert any("more than one person" in words for words in detection_notes(found))
    capture = open_capture(rig)
    rows, columns = np.nonzero(capture.mask("A", 0) > 127)
    # The surer one stands 300 pixels beside the mask.
    np.testing.assert_allclose(found["A"].keypoints.points[0, 0], [columns.min(), rows.min()])
    shutil.rmtree(rig / "masks")
    found = detect_keypoints(open_capture(rig), Finder(people=2), tmp_path / "other")
    np.testing.assert_allclose(found["A"].keypoints.points[0, 0], [300, 300])


def test_images_on_black_are_looked_at_on_grey(tmp_path):
    """Their masks tell where the black is; the one who is left is nobody else."""

    class Looker(Finder):
        def __call__(self, image, box=None):
            self.corner = image[0, 0]
            return super().__call__(image, box)

    scene = make_scene()
    rig = write_simple(scene, tmp_path / "rig")
    description = {"background": [0, 0, 0]}
    for (camera, frame), mask in scene.masks.items():
        (path,) = (rig / "rgbs" / camera).glob(f"*{frame:06d}.*")
        Image.fromarray(scene.on_black(camera, frame)).save(path)
        assert mask[0, 0] == 0
    (rig / "capture.json").write_text(json.dumps(description))
    capture, looker = open_capture(rig), Looker(people=2)
    assert capture.recording.background == (0.0, 0.0, 0.0)
    found = detect_keypoints(capture, looker, tmp_path / "k")
    np.testing.assert_allclose(looker.corner, 150, atol=2)
    assert detection_notes(found) == ()
    # A capture that declares what is not so keeps its photographs as they are.
    for (camera, frame), photograph in scene.photographs.items():
        (path,) = (rig / "rgbs" / camera).glob(f"*{frame:06d}.*")
        Image.fromarray(photograph).save(path)
    detect_keypoints(capture, looker, tmp_path / "k")
    np.testing.assert_allclose(looker.corner, scene.photographs["C", 1][0, 0], atol=12)


def test_who_is_not_found_in_the_masks_box_is_looked_for_in_the_whole_image(rig, tmp_path):
    class Whole(Finder):
        def __call__(self, image, box=None):
            found = super().__call__(image, box)
            return found if box is None else []

    finder = Whole()
    found = detect_keypoints(open_capture(rig), finder, tmp_path / "k")
    assert len(finder.seen) == 12 and all((one.people == 1).all() for one in found.values())


def test_nobody_anywhere_is_refused_and_nobody_somewhere_is_told(rig, tmp_path):
    with pytest.raises(InputError, match="no person in any of 6"):
        detect_keypoints(open_capture(rig), Finder(people=0), tmp_path / "k")

    class Sometimes(Finder):
        def __call__(self, image, box=None):
            return super().__call__(image, box) if len(self.seen) > 1 else (self.seen.append(None), [])[1]

    found = detect_keypoints(open_capture(rig), Sometimes(), tmp_path / "other")
    assert detection_notes(found) == ("camera A: no person was detected in frame 0",)
    assert not found["A"].keypoints.confidence[0].any()


def test_keypoints_of_others_are_not_written_over(rig, tmp_path):
    (tmp_path / "k").mkdir()
    np.savez(tmp_path / "k" / "A.npz", keypoints=np.zeros((2, 2, 3)), joint_names=np.array(NAMES), frames=[0, 1])
    with pytest.raises(InputError, match=r"A\.npz.*name another folder|A\.npz.*Name another folder"):
        detect_keypoints(open_capture(rig), Finder(), tmp_path / "k")


# --- the commands ---------------------------------------------------------------------------------------------------


def test_the_command_detects_with_a_users_model(rig, tmp_path, capsys):
    pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    model = write_card(write_model(tmp_path / "m.onnx", "heatmap"))
    command = ["keypoints", "detect", str(rig), "--detector", str(model), "--json"]
    sheet = tmp_path / "sheet.png"
    assert main([*command, "--out", str(tmp_path / "k"), "--frames", "0", "--sheet", str(sheet)]) == 0
    with Image.open(sheet) as picture:
        assert picture.height > 480
    answer = json.loads(capsys.readouterr().out)
    assert {one["frames"] for one in answer["cameras"].values()} == {1}
    assert main([*command, "--out", str(tmp_path / "k"), "--cameras", "all"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert all(one == {"frames": 2, "with_a_person": 1.0, "detected_now": 1} for one in answer["cameras"].values())
    # The capture's own folder of keypoints may be written, no other folder of it.
    assert main([*command, "--out", str(rig / "keypoints")]) == 0
    assert open_capture(rig).keypoints("A") is not None
    capsys.readouterr()
    assert main([*command, "--out", str(tmp_path / "k"), "--sheet", str(tmp_path / "sheet.gif")]) == 2
    assert ".png or .jpg" in json.loads(capsys.readouterr().out)["error"]["message"]
    for out, words in ((rig / "rgbs", "apart from the capture"), (tmp_path / "k", "one of A, B, C")):
        cameras = [] if out == rig / "rgbs" else ["--cameras", "A,Z"]
        assert main([*command, "--out", str(out), *cameras]) == 2
        message = json.loads(capsys.readouterr().out)["error"]["message"]
        assert words in message


@pytest.mark.long
def test_masks_of_empty_plates_go_into_a_folder_of_one_origin(rig, tmp_path, capsys):
    scene = make_scene()
    plates = tmp_path / "plates"
    for camera in scene.cameras:
        (plates / camera).mkdir(parents=True)
        for k in range(2):
            noise = np.random.default_rng(k).integers(-8, 8, (256, 192, 1))
            Image.fromarray((np.array([40, 90, 160]) + noise).astype(np.uint8)).save(plates / camera / f"{k}.png")
    command = ["capture", "masks", str(rig), "--json"]
    assert main([*command, "--plates", str(plates), "--out", str(tmp_path / "m")]) == 0
    assert json.loads(capsys.readouterr().out)["masks"] == 6
    capture = open_capture(rig, masks=tmp_path / "m")
    for key, mask in scene.masks.items():
        ours, true = capture.mask(*key) > 127, mask > 127
        assert (ours & true).sum() / (ours | true).sum() > 0.95  # arms are three pixels wide
    stamp = (tmp_path / "m" / "A" / "A_mask000000.png").stat().st_mtime_ns
    assert main([*command, "--plates", str(plates), "--out", str(tmp_path / "m")]) == 0
    assert (tmp_path / "m" / "A" / "A_mask000000.png").stat().st_mtime_ns == stamp
    Image.new("RGB", (192, 256)).save(plates / "A" / "2.png")
    (plates / "A" / "notes.txt").write_text("no plate")
    capsys.readouterr()
    refused = {
        "the same masks": ["--plates", str(plates), "--out", str(tmp_path / "m")],
        "one of --matting": ["--out", str(tmp_path / "n")],
        "an existing folder": ["--plates", str(tmp_path / "none"), "--out", str(tmp_path / "n")],
        "none for A, B, C": ["--plates", str(tmp_path), "--out", str(tmp_path / "n")],
        "apart from the capture": ["--plates", str(plates), "--out", str(rig / "rgbs")],
    }
    for words, options in refused.items():
        assert main([*command, *options]) == 2
        assert words in json.loads(capsys.readouterr().out)["error"]["message"]
    assert not (tmp_path / "n").exists()
