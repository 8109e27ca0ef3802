"""`smplxpp capture convert`: rays and pixels stay, nothing is encoded without need, interruptions do no harm."""

from __future__ import annotations

import errno
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.cli import main
from smplxpp.body import load_body
from smplxpp.capture import Capture, open_capture
from smplxpp.capture.check import check_capture
from smplxpp.capture.convert import ConvertConfig, convert_capture
from smplxpp.core import ARRAY_NAMES, InputError
from tests.capture.scene import LENS, make_scene
from tests.capture.writers import (
    WRITERS,
    write_4ddress,
    write_actorshq,
    write_avatarrex,
    write_neus2,
    write_simple,
)
from tests.full_disk import file_size_limit


def rays(capture: Capture) -> np.ndarray:
    """Origins and directions of the corner pixels of every camera."""
    out = []
    for camera in capture.cameras.values():
        pixels = np.array([[0.5, 0.5, 1], [camera.width - 0.5, camera.height - 0.5, 1]])
        directions = pixels @ np.linalg.inv(camera.K).T @ camera.cam_from_world[:3, :3]
        out.append(np.concatenate([camera.position[None], directions]))
    return np.array(out)


def same_params(a: Capture, b: Capture) -> bool:
    """Whether both pose the body alike in every frame."""
    body = load_body()
    return a.frames == b.frames and all(
        np.allclose(body.forward(a.params(f)).vertices, body.forward(b.params(f)).vertices, atol=1e-12)
        for f in a.frames
    )


def tree(root: Path) -> dict[str, int]:
    return {str(p.relative_to(root)): p.stat().st_mtime_ns for p in sorted(root.rglob("*")) if p.is_file()}


def test_what_needs_no_change_is_copied_byte_for_byte(tmp_path):
    source = open_capture(write_simple(make_scene(), tmp_path / "rig"))
    done = convert_capture(source, tmp_path / "new")
    assert (done.views, done.copied, done.encoded, done.left_out) == (6, 12, 0, ())
    new = open_capture(tmp_path / "new")
    np.testing.assert_array_equal(rays(new), rays(source))
    for view in source.views():
        for kind in ("image", "mask"):
            assert new.file(*view, kind).read_bytes() == source.file(*view, kind).read_bytes()
        np.testing.assert_array_equal(new.composited(*view), source.composited(*view))
    assert same_params(source, new) and (tmp_path / "new/params/params.npz").is_file()
    assert check_capture(new, load_body()).findings == ()


@pytest.mark.parametrize("layout", ["avatarrex", "easymocap", "instant-ngp", "neus2", "talkbody4d", "colmap-binary"])
def test_every_layout_comes_out_as_it_was_given_out(layout, tmp_path):
    _, write, lens = WRITERS[layout]
    source = open_capture(write(make_scene(lens=lens, square_pixels=layout == "colmap-binary"), tmp_path / "set"))
    done = convert_capture(source, tmp_path / "new")
    new = open_capture(tmp_path / "new", format="simple")
    assert new.recording.distortions == {} and done.left_out == ()
    np.testing.assert_array_equal(rays(new), rays(source))
    assert new.views() == source.views() and new.recording.background == source.recording.background
    assert done.copied > 0 if lens is None else done.copied == 0
    for view in source.views():
        difference = np.abs(new.image(*view).astype(int) - source.image(*view))
        # JPEG of quality 95 on noise; copies and PNG are exact.
        assert difference.max() == 0 if lens is None or layout == "instant-ngp" else difference.mean() < 2
        mask, expected = new.mask(*view), source.mask(*view)
        assert (mask is None and expected is None) or (mask == expected).all()
    if source.params(0) is not None:
        assert same_params(source, new)


def test_actorshqs_layout_holds_the_person_on_black(tmp_path):
    source = open_capture(write_avatarrex(make_scene(lens=LENS), tmp_path / "set"))
    done = convert_capture(source, tmp_path / "hq", ConvertConfig(layout="actorshq"))
    new = open_capture(tmp_path / "hq")
    assert new.format == "actorshq" and done.views == 6 and done.left_out == ()
    np.testing.assert_allclose(rays(new), rays(source), atol=1e-10)
    for view in source.views():
        assert np.abs(new.composited(*view) - source.composited(*view)).mean() < 0.01
    assert same_params(source, new)
    check = check_capture(new, load_body())
    assert check.findings == () and all(fit.verdict == "good" for fit in check.cameras().values())


def test_actorshq_to_itself_copies(tmp_path):
    source = open_capture(write_actorshq(make_scene(), tmp_path / "set"))
    done = convert_capture(source, tmp_path / "hq", ConvertConfig(layout="actorshq"))
    assert (done.copied, done.encoded) == (12, 0)
    assert (open_capture(tmp_path / "hq").image("A", 1) == source.image("A", 1)).all()


def test_frames_and_cameras_are_chosen_and_splits_follow(tmp_path):
    root = write_simple(make_scene(), tmp_path / "rig")
    description = {"background": None, "novel_views": ["C"], "novel_pose_frames": [1, 1], "fps": 12.5}
    (root / "capture.json").write_text(json.dumps(description))
    source = open_capture(root)
    convert_capture(source, tmp_path / "a", ConvertConfig(cameras=("A", "C"), frames=(1,)))
    new = open_capture(tmp_path / "a")
    assert list(new.cameras) == ["A", "C"] and new.frames == (1,) and new.fps == 12.5
    assert new.splits.novel_view_cameras == ("C",) and new.splits.train_cameras == ("A",)
    assert new.splits.novel_pose_frames == (1,) and new.splits.train_frames == ()
    # Frame 1 alone: a file of its own, since there is no row 0.
    assert (tmp_path / "a/params/000001.npz").is_file() and not (tmp_path / "a/params/params.npz").exists()
    for name in ARRAY_NAMES:
        np.testing.assert_array_equal(getattr(new.params(1), name), getattr(source.params(1), name))
    convert_capture(source, tmp_path / "b", ConvertConfig(layout="actorshq", frames=(1,)))
    assert np.allclose(open_capture(tmp_path / "b").params(1).body_pose, source.params(1).body_pose)


def test_scaled_images_have_scaled_cameras(tmp_path):
    source = open_capture(write_simple(make_scene(lens=LENS), tmp_path / "rig"))
    convert_capture(source, tmp_path / "half", ConvertConfig(scale=0.5))
    new, expected = open_capture(tmp_path / "half"), source.resized(0.5)
    np.testing.assert_array_equal(rays(new), rays(expected))
    assert new.image("B", 1).shape == (128, 96, 3) and (new.mask("B", 1) == expected.mask("B", 1)).all()
    fits = check_capture(new, load_body()).cameras()
    assert all(fit.outside < 0.015 for fit in fits.values())


def test_labels_and_normals_go_along(tmp_path):
    root = write_simple(make_scene(), tmp_path / "rig")
    for name in ("labels/A", "normals/A"):
        (root / name).mkdir(parents=True)
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(256, 192, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    codes = np.where(rng.random((256, 192, 1)) < 0.5, 0, np.round((normals + 1) * 127.5)).astype(np.uint8)
    Image.fromarray(codes).save(root / "normals/A/A_normal000001.png")
    np.save(root / "labels/A/A_label000000.npy", rng.integers(0, 6, (256, 192)))
    source = open_capture(root)
    for scale in (1.0, 0.5):
        out = tmp_path / f"at{scale}"
        convert_capture(source, out, ConvertConfig(scale=scale))
        new, expected = open_capture(out), source.resized(scale)
        assert (new.labels("A", 0) == expected.labels("A", 0)).all() and new.labels("B", 0) is None
        given, back = expected.normals("A", 1), new.normals("A", 1)
        assert ((given == 0).all(axis=2) == (back == 0).all(axis=2)).all() and np.abs(given - back).max() < 0.01


def test_scans_of_4ddress_become_ours(tmp_path):
    source = open_capture(write_4ddress(make_scene(), tmp_path / "set"))
    convert_capture(source, tmp_path / "new")
    frame = source.frames[0]
    assert (tmp_path / f"new/scans/scan_{frame:06d}.ply").is_file()


def test_true_surfaces_and_scans_of_ours_go_along(tmp_path):
    root = write_simple(make_scene(), tmp_path / "rig")
    mesh = make_scene().meshes[1]
    (root / "geometry").mkdir()
    (root / "scans").mkdir()
    np.savez(root / "geometry/topology.npz", faces=mesh.faces)
    np.savez(root / "geometry/frame_000001.npz", verts=mesh.vertices)
    (root / "scans/scan_000001_labels.npz").write_bytes(b"labels")
    convert_capture(open_capture(root), tmp_path / "new", ConvertConfig(frames=(1,)))
    np.testing.assert_array_equal(open_capture(tmp_path / "new").truth_mesh(1).vertices, mesh.vertices)
    assert (tmp_path / "new/scans/scan_000001_labels.npz").read_bytes() == b"labels"


def test_an_interrupted_conversion_goes_on(tmp_path):
    source = open_capture(write_simple(make_scene(lens=LENS), tmp_path / "rig"))

    class Interrupted(Exception):
        pass

    def stop(step: str, share: float) -> None:
        if share == 2 / 12:
            raise Interrupted

    with pytest.raises(Interrupted):
        convert_capture(source, tmp_path / "new", progress=stop)
    with pytest.raises(InputError, match="one layout"):
        open_capture(tmp_path / "new")
    stands = tree(tmp_path / "new")
    done = convert_capture(source, tmp_path / "new")
    assert done.kept >= 4 and done.kept + done.encoded == 12
    after = tree(tmp_path / "new")
    assert all(after[name] == time for name, time in stands.items() if name.startswith(("rgbs", "masks")))
    assert not [name for name in after if Path(name).name.startswith(".")]
    convert_capture(source, tmp_path / "whole")
    assert [n for n in after] == [n for n in tree(tmp_path / "whole")]


def test_damaged_views_are_left_out_and_named(tmp_path, capsys):
    root = write_simple(make_scene(), tmp_path / "rig")
    path = root / "rgbs/B/B_rgb000001.jpg"
    path.write_bytes(path.read_bytes()[:-400])
    assert main(["capture", "convert", str(root), "--out", str(tmp_path / "new")]) == 1
    text = capsys.readouterr().out
    assert "B_rgb000001.jpg" in text and "5 views" in text
    assert not (tmp_path / "new/masks/B/B_mask000001.png").exists()
    assert len(open_capture(tmp_path / "new").views()) == 5


def test_a_view_without_a_mask_cannot_go_to_actorshq(tmp_path):
    root = write_simple(make_scene(), tmp_path / "rig")
    (root / "masks/A/A_mask000000.png").unlink()
    done = convert_capture(open_capture(root), tmp_path / "hq", ConvertConfig(layout="actorshq"))
    assert done.views == 5 and "mask of camera A, frame 0" in done.left_out[0]


def test_the_command(tmp_path, capsys):
    root = write_neus2(make_scene(), tmp_path / "scene")
    params = tmp_path / "params.npz"
    make_scene().params.save(params)
    args = [
        "capture",
        "convert",
        str(root),
        "--out",
        str(tmp_path / "new"),
        "--params",
        str(params),
        "--json",
        "--cameras",
        "image_c_000, image_c_002",
        "--frames",
        "0:2",
        "--scale",
        "0.5",
    ]
    assert main(args) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["views"] == 4 and answer["left_out"] == [] and answer["exit_status"] == 0
    assert main(["capture", "check", str(tmp_path / "new")]) == 0
    assert main(args) == 0
    assert json.loads(capsys.readouterr().out.split("no complaint")[-1].strip())["kept"] == 8


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"cameras": ("X",)}, "--cameras: expected some of A, B, C, received X"),
        ({"frames": (7,)}, "--frames: expected some of 0, 1, received 7"),
        ({"frames": ()}, "--frames"),
    ],
)
def test_what_the_capture_does_not_have_is_refused(options, words, tmp_path):
    source = open_capture(write_simple(make_scene(), tmp_path / "rig"))
    with pytest.raises(InputError, match=words):
        convert_capture(source, tmp_path / "new", ConvertConfig(**options))
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("options", [{"layout": "colmap"}, {"scale": 0.0}, {"scale": float("nan")}, {"quality": 0}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(InputError, match="--"):
        ConvertConfig(**options)


def test_folders_that_hold_something_else_are_refused(tmp_path):
    root = write_simple(make_scene(), tmp_path / "rig")
    source = open_capture(root)
    for out in (root, root / "inside", tmp_path):
        with pytest.raises(InputError, match="apart from the capture's"):
            convert_capture(source, out)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").write_text("")
    with pytest.raises(InputError, match="new or an empty folder"):
        convert_capture(source, tmp_path / "full")
    convert_capture(source, tmp_path / "new", ConvertConfig(cameras=("A",)))
    with pytest.raises(InputError, match="with other cameras, scale stands"):
        convert_capture(source, tmp_path / "new", ConvertConfig(scale=0.5))
    shutil.rmtree(tmp_path / "new")


def test_a_disk_that_fills_is_told_with_what_there_is_and_the_conversion_goes_on(tmp_path, capsys):
    rig = write_simple(make_scene(), tmp_path / "rig")
    sizes = sorted(path.stat().st_size for path in (rig / "rgbs").rglob("*.jpg"))
    command = ["capture", "convert", str(rig), "--out", str(tmp_path / "new"), "--json"]
    with file_size_limit(sizes[-1] - 1):
        assert main(command) == 2
    error = json.loads(capsys.readouterr().out)["error"]["message"]
    assert (
        "File too large" in error and str(tmp_path / "new" / "rgbs") in error and "the same command continues" in error
    )
    assert not (tmp_path / "new" / "cameras.json").exists() and not list((tmp_path / "new").rglob(".*"))
    assert main(command) == 0
    assert open_capture(tmp_path / "new").views() == open_capture(rig).views()


def test_a_file_that_the_system_does_not_give_spoils_its_view_alone(tmp_path, monkeypatch):
    source = open_capture(write_simple(make_scene(), tmp_path / "rig"))
    spoilt, read = source.file("A", 1), Path.read_bytes

    def refused(path: Path) -> bytes:
        if path == spoilt:
            raise OSError(errno.EIO, "Input/output error", str(path))
        return read(path)

    source.image("A", 1)  # decoded and kept: what fails is the copy
    monkeypatch.setattr(Path, "read_bytes", refused)
    done = convert_capture(source, tmp_path / "new")
    assert done.views == 5 and len(done.left_out) == 1 and "Input/output error" in done.left_out[0]
