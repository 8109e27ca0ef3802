"""`smplxpp export --out` in files of other programs: what lands in them, what is said, what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import trimesh

from avatar.formats import read_splat_ply, world_splats
from avatar.models.model_file import save_avatar
from avatar.runtime import AvatarPlayer
from pipelines.cli import main
from pipelines.commands.export_request import SUFFIXES, format_of
from pipelines.runs.layout import STUDENT, TEMPLATE
from smplxpp.body import load_params
from smplxpp.core import BodyParams, InputError
from smplxpp.template.template import Template
from tests.cloth.test_driver import swaying
from tests.dolls.dancing import dance, write_dance_run
from tests.dolls.doll import ball, make_template
from tests.export.glb_reader import GlbReader
from tests.formats.foreign import pygltflib_splats
from tests.runtime.bundles import EXACT, student, write, write_dressed


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A run with a student, the same as a bundle, and a motion."""
    folder = tmp_path_factory.mktemp("students")
    run = write_dance_run(folder / "run")
    (run / STUDENT).parent.mkdir()
    save_avatar(run / STUDENT, student("whole"))
    write(folder / "me.avatar", student("whole"), EXACT)
    replace(dance(), fps=20.0).save(folder / "motion.npz")
    return folder


def export(capsys, *args: object) -> dict:
    """Run the command; its answer, an error's too."""
    capsys.readouterr()
    main(["export", *map(str, args), "--json"])
    return json.loads(capsys.readouterr().out)


def pose(folder: Path, frame: int):
    """What the player has in a frame of the motion."""
    return world_splats(AvatarPlayer(folder / "me.avatar", threads=1).pose(dance().frame(frame)))


def test_a_run_and_its_bundle_give_the_pose_that_is_asked_for(folder, tmp_path, capsys):
    for source in ("run", "me.avatar"):
        out = tmp_path / f"{source}.ply"
        report = export(capsys, folder / source, "--out", out, "--params", folder / "motion.npz", "--frame", 4)
        assert (report["format"], report["frames"], report["bytes"]) == ("ply", 1, out.stat().st_size)
        splats = read_splat_ply(out)
        np.testing.assert_allclose(splats.means, pose(folder, 4).means, atol=2e-6)
        assert np.abs(splats.means - pose(folder, 0).means).max() > 0.05
    assert "0." in main_says(capsys, folder / "me.avatar", "--out", tmp_path / "b.spz")


def main_says(capsys, *args: object) -> str:
    capsys.readouterr()
    assert main(["export", *map(str, args)]) == 0
    return capsys.readouterr().out


def test_a_ply_is_turned_and_filled_up_where_that_is_asked_for(folder, tmp_path, capsys):
    shown = ("--params", folder / "motion.npz", "--frame", 1)
    for up, axis, sign in (("y", 1, 1), ("-y", 1, -1), ("z", 2, 1)):
        out = tmp_path / f"{up}.ply"
        export(capsys, folder / "me.avatar", "--out", out, f"--up={up}", "--full-harmonics", *shown)
        splats = read_splat_ply(out)
        assert splats.f_rest.shape[1] == 15
        np.testing.assert_allclose(sign * splats.means[:, axis], pose(folder, 1).means[:, 1], atol=1e-6)
    report = export(capsys, folder / "me.avatar", "--out", tmp_path / "a.spz", "--up", "z")
    assert report["error"]["subject"] == "option up" and not (tmp_path / "a.spz").exists()


def test_a_folder_gets_a_file_a_frame_and_their_times(folder, tmp_path, capsys):
    out = tmp_path / "series"
    options = ("--out", out, "--format", "glb", "--params", folder / "motion.npz")
    report = export(capsys, folder / "me.avatar", *options, "--frame", 1, "--step", 2)
    assert (report["frames"], report["fps"]) == (3, 10.0)
    about = json.loads((out / "sequence.json").read_text())
    assert [row["seconds"] for row in about["frames"]] == [0.0, 0.1, 0.2] and about["fps"] == 10.0
    for row, frame in zip(about["frames"], (1, 3, 5), strict=True):
        splats = pygltflib_splats(out / row["file"])
        np.testing.assert_allclose(splats.means, pose(folder, frame).means, atol=1e-6)
    # An earlier series is replaced, anything else is not.
    assert export(capsys, folder / "me.avatar", *options, "--stop", 2)["frames"] == 2
    assert len(list(out.iterdir())) == 3
    (out / "notes.txt").write_text("mine")
    assert "notes.txt" in export(capsys, folder / "me.avatar", *options)["error"]["received"]


@pytest.mark.long
def test_loose_clothes_of_a_motion_are_simulated(tmp_path, capsys):
    write_dressed(tmp_path)
    swing = BodyParams.concatenate([replace(swaying(k / 20.0), fps=None) for k in range(3)])
    replace(swing, fps=20.0).save(tmp_path / "swing.npz")
    means = {}
    for cloth in ("simulate", "field", "skin"):
        out = tmp_path / f"{cloth}.ply"
        options = ("--params", tmp_path / "swing.npz", "--frame", 2, "--cloth", cloth)
        assert "error" not in export(capsys, tmp_path / "me.avatar", "--out", out, *options)
        means[cloth] = read_splat_ply(out).means
    player = AvatarPlayer(tmp_path / "me.avatar", threads=1)
    by_field = player.pose(swing.frame(2)).means.copy()
    np.testing.assert_allclose(means["field"], by_field, atol=1e-6)
    skinned = player.pose(swing.frame(2), cloth=player.skinned_clothes).means
    np.testing.assert_allclose(means["skin"], skinned, atol=1e-6)
    for other in (by_field, skinned):
        assert np.abs(means["simulate"] - other).max() > 1e-3


def test_poses_that_training_did_not_see_are_said(folder, tmp_path, capsys):
    far = replace(dance(), body_pose=dance().body_pose + np.linspace(0.0, 2.0, len(dance()))[:, None], fps=20.0)
    far.save(tmp_path / "far.npz")
    options = ("--out", tmp_path / "s", "--format", "spz", "--params", tmp_path / "far.npz")
    (sentence,) = export(capsys, folder / "me.avatar", *options)["notes"]
    assert "of 6 frames, the first at" in sentence
    assert export(capsys, folder / "me.avatar", *options, "--stop", 1)["notes"] == []


def test_the_template_moves_as_glb_and_stands_as_obj(folder, tmp_path, capsys):
    shown = ("--params", folder / "motion.npz")
    out = tmp_path / "a.glb"
    report = export(capsys, folder / "run", "--out", out, "--model", "template", *shown, "--stop", 4)
    assert report["frames"] == 4 and "animations" in GlbReader(out).json
    if find_spec("pxr"):
        report = export(
            capsys, folder / "run", "--out", tmp_path / "a.usdc", "--model", "template", *shown, "--frame", 2
        )
        assert report["frames"] == 4 and report["bytes"] > 1000
    report = export(capsys, folder / "run", "--out", tmp_path / "still.glb", "--model", "template")
    assert report["frames"] == 1 and "animations" not in GlbReader(tmp_path / "still.glb").json
    # Where both are there, a GLB without --model holds splats, which an artist's program shows as points: it is noted.
    assert report["notes"] == []
    report = export(capsys, folder / "run", "--out", tmp_path / "splats.glb")
    assert ["--model template" in note for note in report["notes"]] == [True]
    template = Template.load(folder / "run" / TEMPLATE)
    report = export(capsys, folder / "run", "--out", tmp_path / "objs", "--format", "obj", *shown, "--step", 5)
    assert report["frames"] == 2
    for k, frame in enumerate((0, 5)):
        mesh = trimesh.load(tmp_path / "objs" / f"frame_{k:06d}.obj", process=False, force="mesh")
        np.testing.assert_allclose(mesh.vertices, template.pose(dance().frame(frame))[0], atol=2e-7)
        np.testing.assert_array_equal(mesh.visual.vertex_colors[:, :3], template.vertex_colors)
    export(capsys, folder / "run", "--out", tmp_path / "t.obj")
    rest = trimesh.load(tmp_path / "t.obj", process=False, force="mesh")
    np.testing.assert_allclose(rest.vertices, template.on_floor().vertices, atol=2e-7)
    assert abs(rest.vertices[:, 1].min()) < 2e-7


def test_the_student_is_exported_where_there_is_one_else_the_template(folder, tmp_path, capsys):
    export(capsys, folder / "run", "--out", tmp_path / "student.glb")
    assert "skins" not in GlbReader(tmp_path / "student.glb").json
    built = tmp_path / "built"
    (built / TEMPLATE).parent.mkdir(parents=True)
    (built / TEMPLATE).write_bytes((folder / "run" / TEMPLATE).read_bytes())
    export(capsys, built, "--out", tmp_path / "template.glb")
    assert "skins" in GlbReader(tmp_path / "template.glb").json
    error = export(capsys, built, "--out", tmp_path / "a.ply")["error"]
    assert "student" in error["expected"]


def test_what_does_not_go_together_is_refused_before_anything_is_written(folder, tmp_path, capsys):
    shown = ("--params", folder / "motion.npz")
    bundle, run = folder / "me.avatar", folder / "run"
    for source, options, word in (
        (bundle, ("--out", tmp_path / "a.xyz"), "--format"),
        (bundle, ("--out", tmp_path / "folder"), "ply or spz"),
        (bundle, ("--out", tmp_path / "folder", "--format", "usd"), "usdc"),
        (bundle, ("--out", tmp_path / "a.ply", "--format", "spz"), ".spz"),
        (bundle, ("--out", tmp_path / "a.ply", "--model", "template"), "--model student"),
        (bundle, ("--out", tmp_path / "a.glb", "--model", "template"), "template"),
        (bundle, ("--out", tmp_path / "a.spz", "--full-harmonics"), "PLY"),
        (bundle, ("--out", tmp_path / "a.ply", *shown, "--frame", 6), "6 frames"),
        (bundle, ("--out", tmp_path / "a.ply", *shown, "--step", 0), "1 or more"),
        (bundle, ("--out", tmp_path / "a.ply", "--params", tmp_path / "none.npz"), "none.npz"),
        (run, ("--out", tmp_path / "objs", "--format", "obj"), "motion"),
        (run, ("--out", tmp_path / "s", "--format", "glb", "--model", "template", *shown), "itself"),
        (tmp_path, ("--out", tmp_path / "a.ply"), "finished template"),
    ):
        error = export(capsys, source, *options)["error"]
        assert word in " ".join(map(str, error.values())), (options, error)
    assert list(tmp_path.iterdir()) == []


def test_the_step_becomes_onnx(folder, tmp_path, capsys):
    onnxruntime = pytest.importorskip("onnxruntime")
    pytest.importorskip("onnx")
    for source in ("run", "me.avatar"):
        report = export(capsys, folder / source, "--out", tmp_path / "a.onnx")
        assert (report["format"], report["fps"]) == ("onnx", None)
        session = onnxruntime.InferenceSession(str(tmp_path / "a.onnx"), providers=["CPUExecutionProvider"])
        assert {one.name for one in session.get_inputs()} == {"pose", "transl", "expression", "eye"}


def test_webavatars_file_says_what_it_leaves_out(folder, tmp_path, capsys):
    report = export(capsys, folder / "me.avatar", "--out", tmp_path / "a.npz", "--format", "webavatar")
    assert report["format"] == "webavatar" and any("ctrl_pt_basis" in sentence for sentence in report["notes"])
    with np.load(tmp_path / "a.npz") as stored:
        assert len(stored["_xyz"]) == len(pose(folder, 0))
    report = export(capsys, folder / "me.avatar", "--out", tmp_path / "b.npz")
    assert "--format amass or webavatar" in report["error"]["expected"] and not (tmp_path / "b.npz").exists()


def test_a_suffix_tells_the_format_where_one_has_it():
    for name, suffixes in SUFFIXES.items():
        for suffix in suffixes:
            assert format_of(Path(f"a{suffix.upper()}"), name) == name
    assert format_of(Path("a.usda"), "auto") == "usd"
    with pytest.raises(InputError, match="format ply or spz"):
        format_of(Path("folder"), "auto")


def test_a_motion_becomes_bvh_and_amass(folder, tmp_path, capsys):
    for source in ("run", "me.avatar"):
        report = export(
            capsys, folder / source, "--out", tmp_path / "a.bvh", "--params", folder / "motion.npz", "--step", 2
        )
        assert (report["frames"], report["fps"]) == (3, 10.0)
        assert "Frames: 3" in (tmp_path / "a.bvh").read_text()
        options = ("--format", "amass", "--params", folder / "motion.npz")
        report = export(capsys, folder / source, "--out", tmp_path / "a.npz", *options)
        assert report.get("frames") == 6, report
        body = Template.load(folder / "run" / TEMPLATE).body
        # The file says that z is up and that it is of the open body; here it is compared as it is written.
        z_up = replace(load_params(tmp_path / "a.npz", up="y"), expression=np.zeros((6, 0)))
        y_up = replace(dance(), expression=np.zeros((6, 0)))
        ours, theirs = (body.forward(it.without_shape()).joints for it in (y_up, z_up))
        # float32 in the bundle
        np.testing.assert_allclose(theirs, np.stack([ours[..., 0], -ours[..., 2], ours[..., 1]], axis=-1), atol=1e-5)
        with np.load(tmp_path / "a.npz") as arrays:
            assert str(arrays["up"]) == "z" and str(arrays["body"]) == "open_body"
    for name in ("a.bvh", "a.npz"):
        (tmp_path / name).unlink()
        report = export(
            capsys, folder / "run", "--out", tmp_path / name, "--format", {"a.bvh": "bvh"}.get(name, "amass")
        )
        assert report["error"]["subject"] == "option params"
    assert list(tmp_path.iterdir()) == []


def test_levels_of_detail_are_files_of_their_own_and_the_rig_has_what_is_asked_for(folder, tmp_path, capsys):
    run = tmp_path / "run"
    (run / TEMPLATE).parent.mkdir(parents=True)
    make_template([ball((0.2, 0.28, 0.15), 0.35, {"pelvis": 1.0}, subdivisions=4)], {}).save(run / TEMPLATE)
    report = export(capsys, run, "--out", tmp_path / "me.glb", "--faces", 2000, 1200, "--max-influences", 4)
    assert report["out"] == f"{tmp_path / 'me_LOD0.glb'}, {tmp_path / 'me_LOD1.glb'}"
    assert report["bytes"] == sum(path.stat().st_size for path in tmp_path.glob("*.glb"))
    counts = []
    for k in range(2):
        reader = GlbReader(tmp_path / f"me_LOD{k}.glb")
        accessors = [reader.json["accessors"][mesh["primitives"][0]["indices"]] for mesh in reader.json["meshes"]]
        counts.append(sum(accessor["count"] for accessor in accessors) // 3)
    assert counts[0] <= 2050 and counts[1] <= 1250 < counts[0]
    assert f"me_LOD1.glb: {counts[1]:,} faces" in report["notes"]
    assert any(note.startswith("weights of at most 4 joints") for note in report["notes"])
    for options in (("--out", tmp_path / "a.ply"), ("--out", tmp_path / "a.glb", "--model", "student")):
        refused = export(capsys, folder / "run", *options, "--faces", 2000)
        assert refused["error"]["subject"] == "options of the mesh"
    said = export(capsys, run, "--out", tmp_path / "me.obj", "--params", folder / "motion.npz", "--faces", 2000)
    assert said["error"]["subject"] == "option faces"
