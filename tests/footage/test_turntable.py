"""Photographs of a person who turns become a capture with its camera and poses."""

from __future__ import annotations

import functools
import json
import subprocess

import numpy as np
import pytest
from PIL import Image

from smplxpp.body import load_body
from smplxpp.build import register
from smplxpp.build.config import RegisterInputs
from smplxpp.build.inputs import plan_build
from smplxpp.build.observe import observe
from smplxpp.build.request import BuildRequest
from smplxpp.capture import open_capture
from smplxpp.capture.writers import write_keypoints
from smplxpp.core import InputError, Keypoints2D
from smplxpp.core.files.image_file import image_size
from smplxpp.detect import DetectedPerson
from smplxpp.footage import turntable
from smplxpp.footage.turn_frames import lens_of, turn_frames, upright_image
from smplxpp.footage.turntable import TurntableCaptureConfig, held_out_frames, make_turntable_capture
from smplxpp.register import RegisterConfig
from tests.register.turns import turned_person

BODY = load_body()
FRAMES = 5
QUICK = {"keypoint_steps": 8, "surface_steps": 1}


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """Photographs 103, 104, ... of a turn, masks and keypoints with the same numbers."""
    turn, root = turned_person(BODY, FRAMES, height=240), tmp_path_factory.mktemp("turn")
    for name in ("photos", "masks"):
        (root / name).mkdir()
    for k, mask in enumerate(turn.masks):
        Image.fromarray(np.stack([mask, mask // 2, mask // 3], axis=2)).save(root / "photos" / f"IMG_{103 + k}.png")
        Image.fromarray(mask).save(root / "masks" / f"{103 + k}.png")
    seen = turn.keypoints
    numbered = Keypoints2D(seen.names, 103 + seen.frames, seen.points, seen.confidence)
    write_keypoints(root / "keypoints.npz", numbered)
    return root, turn


@pytest.fixture(scope="module")
def made(taken, tmp_path_factory):
    root, turn = taken
    config = TurntableCaptureConfig(height=turn.stature, masks=root / "masks", keypoints=root / "keypoints.npz")
    quick = functools.partial(turntable.TurntableConfig, **QUICK, solver=RegisterConfig(rim_samples=500))
    out = tmp_path_factory.mktemp("captures") / "anna"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(turntable, "TurntableConfig", quick)
        return make_turntable_capture(root / "photos", out, config)


def test_a_capture_with_camera_and_poses(made, taken):
    capture = open_capture(made.out)
    assert capture.kind == "turntable" and capture.frames == tuple(range(FRAMES)) and list(capture.cameras) == ["cam"]
    assert all(capture.params(frame) is not None and capture.mask("cam", frame) is not None for frame in capture.frames)
    # Players show the turn in eight seconds, not in a sixth of one.
    assert capture.fps == pytest.approx(FRAMES / 8)
    # Photographs keep their bytes; the joints of the poses lie where the keypoints are.
    first = taken[0] / "photos" / "IMG_103.png"
    assert capture.required_file("cam", 0).read_bytes() == first.read_bytes()
    assert np.median(made.found.fit.residuals["keypoints_px"]) < 3.0
    said = json.loads((made.out / "capture.json").read_text())["found"]
    assert said["turned_degrees"] == pytest.approx(288.0, abs=10.0) and any("soles" in note for note in said["notes"])


def test_a_build_reconstructs_with_the_poses_of_the_capture(made):
    plan = plan_build(BuildRequest(capture=made.out))
    assert plan.inputs.steps[:2] == ("reconstruct", "capture") and plan.registration is None
    (made.out / "params" / "params.npz").rename(made.out / "params.away")
    try:
        with pytest.raises(InputError, match="capture turntable"):
            plan_build(BuildRequest(capture=made.out))
    finally:
        (made.out / "params.away").rename(made.out / "params" / "params.npz")


@pytest.mark.long
def test_a_registration_fits_the_whole_turn_at_once(made, monkeypatch):
    # Parameters of the capture start it; one shape and one held pose for all frames come out.
    monkeypatch.setattr(register, "TurntableConfig", functools.partial(register.TurntableConfig, **QUICK))
    observed = observe(RegisterInputs(capture=made.out), BODY)
    found, output = register.register_observed(observed, BODY, at=0, config=RegisterConfig(rim_samples=500))
    assert found.fit.frames == tuple(range(FRAMES)) and np.ptp(found.fit.params.betas, axis=0).max() == 0.0
    assert [check.name for check in output.checks if check.status != "pass"] == []


def test_masks_and_keypoints_that_are_not_given_are_made(taken, tmp_path, monkeypatch):
    root, turn = taken
    seen = iter(zip(turn.keypoints.points, turn.keypoints.confidence, strict=True))

    class Detects:
        names, identity = turn.keypoints.names, "a detector that knows"

        def __call__(self, image, box=None):
            return [DetectedPerson(*next(seen))]

    monkeypatch.setattr(turntable, "load_detector", lambda name: Detects())
    monkeypatch.setattr(
        turntable, "MattingModel", lambda path: lambda image: 255 * (image[..., 0] > 0).astype(np.uint8)
    )
    quick = functools.partial(turntable.TurntableConfig, keypoint_steps=1, surface_steps=0)
    monkeypatch.setattr(turntable, "TurntableConfig", quick)
    config = TurntableCaptureConfig(most_frames=4, matting=tmp_path / "model.onnx")
    made = make_turntable_capture(root / "photos", tmp_path / "out", config)
    capture = open_capture(made.out)
    # Four of the five photographs; the first and the last are among them.
    assert (
        made.frames == 4 and capture.required_file("cam", 3).read_bytes() == (root / "photos/IMG_107.png").read_bytes()
    )
    np.testing.assert_array_equal(capture.mask("cam", 0), turn.masks[0])
    np.testing.assert_allclose(capture.keypoints("cam").points[0], turn.keypoints.points[0], atol=0.1)


def test_of_a_video_the_sharp_frames_of_equal_intervals_are_taken_upright(tmp_path):
    program = pytest.importorskip("imageio_ffmpeg", reason="the extra video reads films").get_ffmpeg_exe()
    # 40 frames, whose grey level counts; a pattern on them is sharp in every fifth frame alone, the others have none.
    pattern = 40 * (np.indices((48, 64)).sum(axis=0) // 4 % 2)
    film = np.stack([np.full((48, 64), 4 * k) + (pattern if k % 5 == 2 else 20) for k in range(40)]).astype(np.uint8)
    lying, path = tmp_path / "lying.mp4", tmp_path / "phone.mov"
    source = ["-f", "rawvideo", "-pix_fmt", "gray", "-s", "64x48", "-r", "20", "-i", "-"]
    coded = ["-c:v", "libx264", "-qp", "4", "-pix_fmt", "yuv420p"]
    subprocess.run([program, "-v", "error", *source, *coded, str(lying)], input=film.tobytes(), check=True, timeout=900)
    # A phone that stands upright writes lying frames and how to turn them.
    turned = ["-display_rotation", "90", "-i", str(lying), "-c", "copy"]
    subprocess.run([program, "-v", "error", *turned, str(path)], check=True, timeout=900)
    with turn_frames(path, 8) as (frames, given):
        assert given is None and [frame.number for frame in frames] == list(range(1, 9))
        assert image_size(frames[0].path) == (48, 64)
        levels = [np.asarray(upright_image(frame.path)).mean() for frame in frames]
    expected = [film[k].mean() for k in range(2, 40, 5)]
    np.testing.assert_allclose(levels, expected, atol=2.0)
    path.write_bytes(b"no film")
    with pytest.raises(InputError, match="expected a video"), turn_frames(path, 8):
        pass


def test_photographs_that_were_cropped_one_by_one_are_refused(taken, tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for k in range(4):
        Image.new("RGB", (120, 160 + (k == 2))).save(photos / f"{k}.png")
    with pytest.raises(InputError, match="expected 120 x 160 pixels, as the first, received 120 x 161"):
        make_turntable_capture(photos, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_masks_and_keypoints_of_other_frames_are_refused(taken, tmp_path):
    root, _ = taken
    (tmp_path / "masks").mkdir()
    Image.new("L", (180, 240)).save(tmp_path / "masks" / "7.png")
    with pytest.raises(InputError, match="images of the 5 frames"):
        make_turntable_capture(root / "photos", tmp_path / "out", TurntableCaptureConfig(masks=tmp_path / "masks"))


def test_a_lens_is_stated_recorded_or_a_phones(tmp_path):
    path = tmp_path / "photo.jpg"
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 26
    Image.new("RGB", (400, 300)).save(path, exif=exif)
    diagonal = 500.0
    assert lens_of(path, (400, 300), None).pixels == pytest.approx(26 * diagonal / 43.27)
    assert lens_of(path, (400, 300), 50.0).pixels == pytest.approx(50 * diagonal / 43.27)
    Image.new("RGB", (400, 300)).save(path)
    assert lens_of(path, (400, 300), None).spread > 5 * lens_of(path, (400, 300), 50.0).spread


def test_a_kind_that_the_cameras_contradict_is_refused(made, tmp_path):
    out = tmp_path / "copy"
    (out / "rgbs").mkdir(parents=True)
    cameras = json.loads((made.out / "cameras.json").read_text())
    cameras["cameras"].append({**cameras["cameras"][0], "name": "other"})
    (out / "cameras.json").write_text(json.dumps(cameras))
    (out / "capture.json").write_text(json.dumps({"kind": "turntable"}))
    with pytest.raises(InputError, match="turntable"):
        open_capture(out)


def test_of_many_frames_some_are_held_out_but_never_the_reference():
    assert held_out_frames(8) == () and held_out_frames(60) == (5, 15, 25, 35, 45, 55)
    assert held_out_frames(8, (5, 2)) == (2, 5)
    for wrong in ((0,), (8,), (1, 2, 3, 4, 5)):
        with pytest.raises(InputError, match="hold-out: expected numbers of frames, 1 to 7"):
            held_out_frames(8, wrong)
