"""The Capture type on a small folder of the simple layout."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
from PIL import Image

from smplxpp.capture import Problem, Splits, open_capture
from smplxpp.core import BodyParams, InputError

W, H = 40, 60
RED, BLUE = (200, 30, 40), (20, 40, 220)


def write_capture(root, *, background=(0, 0, 0), description=None, cameras=("A", "B", "C"), frames=4):
    """A red disc with soft edge on a colour; frame 2 of camera B is missing."""
    entries = []
    x, y = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
    alpha = np.clip(12.5 - np.hypot(x - 20, y - 30), 0, 1)
    for k, name in enumerate(cameras):
        K = [[50.0, 0, 20 + k], [0, 50.0, 30], [0, 0, 1]]
        entries.append({"name": name, "w": W, "h": H, "K": K, "R": np.eye(3).tolist(), "T": [0, 0, 2.0 + k]})
        for kind in ("rgbs", "masks", "labels"):
            (root / kind / name).mkdir(parents=True)
        for frame in range(frames):
            if (name, frame) == ("B", 2):
                continue
            colour = np.array(RED) * alpha[..., None] + np.array(background) * (1 - alpha[..., None])
            mask = np.round(alpha * 255).astype(np.uint8)
            Image.fromarray(np.round(colour).astype(np.uint8)).save(root / f"rgbs/{name}/{name}_rgb{frame:06d}.png")
            Image.fromarray(mask).save(root / f"masks/{name}/{name}_mask{frame:06d}.png")
            Image.fromarray((mask > 127).astype(np.uint8) * 3).save(root / f"labels/{name}/{name}_label{frame:06d}.png")
    (root / "cameras.json").write_text(json.dumps(entries))
    (root / "params").mkdir()
    pose = BodyParams.rest(betas=10)
    BodyParams.concatenate([pose] * frames).save(root / "params/params.npz")
    if description is not None:
        (root / "capture.json").write_text(json.dumps(description))
    return root


def test_everything_of_a_view_is_there(tmp_path):
    capture = open_capture(write_capture(tmp_path / "disc"))
    assert (capture.name, capture.format, capture.frames) == ("disc", "simple", (0, 1, 2, 3))
    assert list(capture.cameras) == ["A", "B", "C"]
    assert capture.image("A", 0).shape == (H, W, 3) and capture.image("A", 0).dtype == np.uint8
    assert set(np.unique(capture.labels("A", 0))) == {0, 3}
    assert capture.normals("A", 0) is None and capture.truth_mesh(0) is None
    assert len(capture.params(3)) == 1 and capture.params(9) is None
    with pytest.raises(ValueError, match="read-only"):
        capture.image("A", 0)[0] = 1


def test_a_capture_says_itself_in_a_paragraph(tmp_path):
    capture = open_capture(write_capture(tmp_path / "disc", description={"novel_views": ["C"]}))
    text = repr(capture)
    assert len(text) < 400 and "array" not in text
    for part in ("'disc', simple,", str(tmp_path / "disc"), "3 cameras of 40 x 60 pixels", "4 frames 0 to 3"):
        assert part in text
    assert "11 images, 11 masks, 11 labels, params" in text and "1 cameras and 0 frames held out" in text
    assert "resized" not in text and "resized or cropped" in repr(capture.resized(0.5))
    assert "1 left out" in repr(capture.without([Problem("bad", "A", 0)]))
    assert repr(capture.recording) in text.replace("Capture(", "Recording(", 1).replace("; 1 cameras and", ")")
    series = capture.recording.series("image", "B")
    assert repr(series) == f"FileSeries(3 files 0 to 3 in '{tmp_path}/disc/rgbs/B')"


def test_presence_is_known_without_opening_files(tmp_path):
    root = write_capture(tmp_path / "disc")
    for path in root.glob("rgbs/*/*"):
        path.write_bytes(b"not an image")
    capture = open_capture(root)
    present = capture.presence()
    assert present.sum() == 11 and not present[1, 2]
    assert len(capture.views()) == 11 and ("B", 2) not in capture.views()
    assert capture.views(["B"], [1, 2]) == [("B", 1)]
    with pytest.raises(InputError, match="frame 2"):
        capture.image("B", 2)
    with pytest.raises(InputError, match=r"A_rgb000000\.png.*whole image"):
        capture.image("A", 0)


@pytest.mark.parametrize("declared", [[0, 0, 0], [20 / 255, 40 / 255, 220 / 255], None])
def test_the_disc_composites_exactly_from_declared_colours_and_from_photographs(tmp_path, declared):
    """On every colour the result is the disc over that colour, with the mask's own soft edge."""
    on = (0, 0, 0) if declared == [0, 0, 0] else BLUE
    root = write_capture(tmp_path / "disc", background=on, description={"background": declared})
    if declared is None:  # a photograph: its red reaches under the soft edge
        Image.new("RGB", (W, H), BLUE).save(root / "rgbs/A/A_rgb000000.png")
        photo = np.array(Image.open(root / "rgbs/A/A_rgb000000.png"))
        photo[np.asarray(Image.open(root / "masks/A/A_mask000000.png")) > 0] = RED
        Image.fromarray(photo).save(root / "rgbs/A/A_rgb000000.png")
    capture = open_capture(root)
    alpha = capture.mask("A", 0)[..., None] / 255
    for background in ((0, 0, 0), (1.0, 0.5, 0.25)):
        out = capture.composited("A", 0, background)
        assert out.dtype == np.float32 and out.shape == (H, W, 3)
        expected = np.array(RED) / 255 * alpha + np.array(background) * (1 - alpha)
        np.testing.assert_allclose(out, expected, atol=2.5 / 255)


def test_a_wrong_declaration_is_found_out(tmp_path):
    root = write_capture(tmp_path / "disc", background=BLUE)
    with pytest.raises(InputError, match=r"A_rgb000000\.png.*\[0, 0, 0\].*\[20, 40, 220\].*null"):
        open_capture(root).composited("A", 0)


def test_compositing_needs_a_mask(tmp_path):
    root = write_capture(tmp_path / "disc")
    (root / "masks/A/A_mask000001.png").unlink()
    capture = open_capture(root)
    assert capture.mask("A", 1) is None
    with pytest.raises(InputError, match=r"A_rgb000001\.png"):
        capture.composited("A", 1)


def test_resizing_and_cropping_move_intrinsics_with_the_pixels(tmp_path):
    """The disc's centre of mass is the projection of one point through every camera."""
    capture = open_capture(write_capture(tmp_path / "disc"))
    point = np.array([[(20 - 20) / 50 * 2.0, 0.0, 0.0]])
    for seen in (
        capture,
        capture.resized(0.5),
        capture.resized(0.37),
        capture.resized(2.0),
        capture.cropped({"A": (3, 11, 38, 55)}),
        capture.cropped({"A": (3, 11, 38, 55)}).resized(0.7),
        capture.resized(0.7).cropped({"A": (2, 5, 27, 40)}).resized(1.3),
    ):
        mask = seen.mask("A", 0).astype(float)
        camera = seen.cameras["A"]
        assert mask.shape == (camera.height, camera.width) == seen.labels("A", 0).shape
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        centre = [(x * mask).sum() / mask.sum(), (y * mask).sum() / mask.sum()]
        np.testing.assert_allclose(camera.screen_from_world(point)[0, :2], centre, atol=0.03)
    assert seen.cameras["B"].width == round(round(W * 0.7) * 1.3)


def test_one_resampling_for_any_order_of_crops(tmp_path):
    capture = open_capture(write_capture(tmp_path / "disc"))
    a = capture.cropped({"A": (4, 10, 36, 50)}).resized(0.5).mask("A", 0)
    b = capture.resized(0.5).cropped({"A": (2, 5, 18, 25)}).mask("A", 0)
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("box", [(-1, 0, 5, 5), (0, 0, W + 1, 5), (5, 5, 5, 9)])
def test_a_crop_outside_the_image_is_refused(tmp_path, box):
    capture = open_capture(write_capture(tmp_path / "disc"))
    with pytest.raises(InputError, match="crop box"):
        capture.cropped({"A": box})


def test_splits_come_from_the_description_or_hold_out_every_nth(tmp_path):
    root = write_capture(tmp_path / "a", description={"novel_views": ["B"], "train_frames": [0, 2]})
    assert open_capture(root).splits == Splits(("A", "C"), ("B",), (0, 1, 2), ())
    root = write_capture(tmp_path / "b", description={"novel_pose_frames": [[0, 0], [3, 3]]})
    assert open_capture(root).splits == Splits(("A", "B", "C"), (), (1, 2), (0, 3))
    assert open_capture(root, hold_out_every=2).splits.novel_view_cameras == ("B",)
    with pytest.raises(InputError, match="held-out cameras"):
        open_capture(root, hold_out_every=4)
    with pytest.raises(InputError, match="in both"):
        Splits(("A",), ("A",), (), ())


def test_views_named_by_problems_are_left_out(tmp_path):
    capture = open_capture(write_capture(tmp_path / "disc"))
    less = capture.without([Problem("", "A", 0), Problem("", None, 3), Problem("", "C", None), Problem("")])
    assert less.frames == (0, 1, 2) and list(less.cameras) == ["A", "B"]
    assert less.views() == [("B", 0), ("A", 1), ("B", 1), ("A", 2)]
    assert less.splits.train_cameras == ("A", "B") and less.params(3) is None
    assert len(capture.views()) == 11
    twice = less.without([Problem("", "C", 1), Problem("", "B", 0)])
    assert twice.views() == [("A", 1), ("B", 1), ("A", 2)]


def test_a_capture_pickles_small_and_reads_the_same_elsewhere(tmp_path):
    capture = open_capture(write_capture(tmp_path / "disc")).resized(0.5)
    image = capture.image("A", 1)
    other = pickle.loads(pickle.dumps(capture))
    assert other.cache.held_bytes == 0 and capture.cache.held_bytes == image.nbytes
    np.testing.assert_array_equal(other.image("A", 1), image)


def test_folders_without_a_camera_and_listed_but_missing_images_are_told(tmp_path):
    root = write_capture(tmp_path / "disc", description={"images": {"A": [0, 1, 2, 3, 4]}})
    (root / "rgbs/D").mkdir()
    messages = [problem.message for problem in open_capture(root).problems]
    assert len(messages) == 2
    assert any("D" in m and "not calibrated" in m for m in messages)
    assert any(m.endswith("no image of frame 4") for m in messages)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("capture.json", "{", "JSON"),
        ("capture.json", "[]", "object"),
        ("capture.json", '{"background": [0, 0]}', "background"),
        ("capture.json", '{"background": [0, 0, 255]}', "from 0 to 1"),
        ("capture.json", '{"novel_views": ["Z"]}', "novel_views.*Z"),
        ("capture.json", '{"train_frames": [1, 2, 3]}', "train_frames"),
        ("capture.json", '{"train_views": "A"}', "list of cameras"),
        ("capture.json", '{"fps": "fast"}', r"capture\.json.*fast"),
        ("capture.json", '{"background": "black"}', r"capture\.json.*black"),
        ("capture.json", '{"images": {"A": "all"}}', r"capture\.json"),
    ],
)
def test_broken_descriptions_are_refused(tmp_path, name, text, words):
    root = write_capture(tmp_path / "disc")
    (root / name).write_text(text)
    with pytest.raises(InputError, match=words):
        open_capture(root)


def test_unknown_folders_and_names_are_refused(tmp_path):
    with pytest.raises(InputError, match="existing folder"):
        open_capture(tmp_path / "nothing")
    (tmp_path / "phone.MOV").write_bytes(b"film")
    with pytest.raises(InputError, match=r"capture turntable .*phone\.MOV --out DIR"):
        open_capture(tmp_path / "phone.MOV")
    with pytest.raises(InputError, match=r"cameras\.json"):
        open_capture(tmp_path)
    root = write_capture(tmp_path / "disc")
    with pytest.raises(InputError, match="'simple' or "):
        open_capture(root, format="nope")
    with pytest.raises(InputError, match="one of A, B, C"):
        open_capture(root).image("Z", 0)
    (root / "cameras.json").unlink()
    with pytest.raises(InputError, match=r"calibration\.csv"):
        open_capture(root, format="simple")


def test_ground_truth_capture_projects_onto_its_masks(captures):
    from smplxpp.raster import rasterize_mesh

    capture = open_capture(captures / "woman_casual")
    assert capture.splits.novel_view_cameras == ("Cam005", "Cam010") and len(capture.splits.train_frames) == 48
    for frame in (0, 52):
        covered = rasterize_mesh(capture.truth_mesh(frame), capture.cameras["Cam003"]).mask
        mask = capture.mask("Cam003", frame) > 127
        assert (covered & mask).sum() / (covered | mask).sum() > 0.998
    normals = capture.normals("Cam001", 0)
    lengths = np.linalg.norm(normals, axis=-1)
    assert set(np.unique(lengths.round(4))) == {0.0, 1.0}
    noisy = open_capture(captures / "woman_casual", params="params_noisy.npz")
    assert 0 < np.abs(noisy.params(0).transl - capture.params(0).transl).max() < 0.05


def test_one_frame_alone_is_a_stack_of_one(tmp_path):
    """Arrays without the frames' axis; and columns that no layout knows do not count as rows."""
    root = write_capture(tmp_path / "disc")
    arrays = {name: value[0] for name, value in BodyParams.rest(betas=10).as_dict().items()}
    np.savez(tmp_path / "fit.npz", **arrays, joints=np.full((77, 3), np.nan))
    capture = open_capture(root, params=tmp_path / "fit.npz")
    assert len(capture.params(0)) == 1 and capture.params(1) is None
