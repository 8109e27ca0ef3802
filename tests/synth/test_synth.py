"""The synthetic capture's light, cameras, pictures, files and performance; tiny captures from end to end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.cli import main
from smplxpp.body import load_body
from smplxpp.capture import open_capture
from smplxpp.capture.cameras import FACE, camera_rig, read_cameras
from smplxpp.capture.writers import (
    png16,
    save_compact,
    write_calibration_csv,
    write_cameras_json,
    write_normal_png,
)
from smplxpp.core import InputError, TriangleMesh
from smplxpp.people.fixture_person import load_person
from smplxpp.raster import rasterize_mesh
from smplxpp.raster.soft_light import Environment, LightConfig, bounced, vertex_light
from smplxpp.synth.config import SynthConfig, split_frames
from smplxpp.synth.motion import Performance
from smplxpp.synth.simulate import SimulationConfig
from smplxpp.synth.views import LitFrame, normal_map, render_view
from smplxpp.synth.write_capture import make_capture

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"
TOPOLOGY = FIXTURE / "geometry" / "topology.npz"
QUICK = SynthConfig(
    cameras=2,
    frames=2,
    fps=25.0,
    size=48,
    supersampling=2,
    scan_faces=0,
    simulation=SimulationConfig(settle=0.04, substep={"lower": 1 / 150, "upper": 1 / 150}),
    light=LightConfig(directions=6, resolution=64),
)


@pytest.fixture(scope="module")
def person():
    return load_person(TOPOLOGY)


def slab(height: float, half: float = 0.5, cells: int = 20) -> TriangleMesh:
    """A level square that faces up."""
    x, z = np.meshgrid(np.linspace(-half, half, cells), np.linspace(-half, half, cells), indexing="ij")
    vertices = np.stack([x.ravel(), np.full(x.size, height), z.ravel()], axis=1)
    a = (np.arange(cells - 1)[:, None] * cells + np.arange(cells - 1)).ravel()
    b, c, d = a + 1, a + cells, a + cells + 1
    return TriangleMesh(vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)]))


# --- light ----------------------------------------------------------------------------------------------------------


def test_an_open_plane_is_lit_from_above_and_less_from_below():
    light = vertex_light(slab(0.0), LightConfig(directions=400, resolution=128))
    centre = np.abs(slab(0.0).vertices).max(axis=1) < 0.3
    # The integral of L max(cos, 0) / pi over the upper half with L = mean + half (sky - ground) y: mean + slope / 3.
    assert light[0, centre].mean() == pytest.approx(0.92 + 0.24 * 2 / 3, abs=0.02)
    assert light[1, centre].mean() == pytest.approx(0.92 - 0.24 * 2 / 3, abs=0.02)


def test_a_roof_takes_light_away_from_what_is_below():
    floor, roof = slab(0.0), slab(0.1)
    both = TriangleMesh(
        np.concatenate([floor.vertices, roof.vertices]), np.concatenate([floor.faces, roof.faces + floor.vertex_count])
    )
    light = vertex_light(both, LightConfig(directions=200, resolution=128))
    centre = np.flatnonzero(np.abs(floor.vertices).max(axis=1) < 0.2)
    assert light[0, centre].max() < 0.2
    assert light[0, centre + floor.vertex_count].min() > 0.9


def test_bounces_lighten_bright_surfaces_more_and_open_ones_not_at_all():
    albedo = np.array([[0.1, 0.5, 0.9]])
    np.testing.assert_allclose(bounced(np.ones(1), albedo), albedo)
    gain = bounced(np.array([0.4]), albedo)[0] / (0.4 * albedo[0])
    assert (np.diff(gain) > 0).all() and gain[0] > 1
    assert (bounced(np.array([0.4]), albedo) < albedo).all()


# --- cameras --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 3, 4, 8, 20])
def test_every_camera_holds_what_it_looks_at(count):
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.7, 0.0, -0.5], [0.7, 1.7, 0.5], (500, 3))
    heads = points * 0.12 + [0, 1.5, 0]
    rig = camera_rig(points, heads, count=count, size=200, seed=1)
    assert len(rig) == count and len({item.camera.name for item in rig}) == count
    assert sum(item.kind == FACE for item in rig) == (2 if count >= 4 else 0)
    assert not any(item.novel for item in rig if item.kind == FACE)
    for item in rig:
        xy = item.camera.screen_from_world(heads if item.kind == FACE else points)[:, :2]
        size = [item.camera.width, item.camera.height]
        assert (xy > 0).all() and (xy < size).all()
        assert ((np.ptp(xy, axis=0) / size) > 0.85).any()
    if count >= 8:
        assert 1 <= sum(item.novel for item in rig) <= count / 4


def test_both_camera_files_hold_the_same_cameras(tmp_path):
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)) + [0, 1, 0]
    rig = camera_rig(points, points, count=5, size=100, seed=2)
    write_cameras_json(tmp_path / "cameras.json", rig)
    write_calibration_csv(tmp_path / "calibration.csv", rig)
    for one, two, item in zip(
        read_cameras(tmp_path / "cameras.json"), read_cameras(tmp_path / "calibration.csv"), rig, strict=True
    ):
        np.testing.assert_array_equal(one.K, item.camera.K)
        np.testing.assert_allclose(two.K, item.camera.K, rtol=1e-9)
        np.testing.assert_allclose(two.cam_from_world, item.camera.cam_from_world, atol=1e-9)
        assert one.name == two.name == item.camera.name


# --- pictures -------------------------------------------------------------------------------------------------------


def test_a_view_is_premultiplied_its_mask_exact_and_its_labels_single(person):
    mesh = TriangleMesh(person.tpose.vertices, person.tpose.faces)
    rig = camera_rig(mesh.vertices, mesh.vertices[person.vertex_part == 4], count=4, size=96, seed=0)
    frame = LitFrame(mesh, np.arange(mesh.face_count), np.ones((2, mesh.vertex_count)))
    camera = rig[0].camera
    view = render_view(person, frame, camera, supersampling=3)
    assert not view.image[view.mask == 0].any()
    assert (view.image.max(axis=2) <= view.mask).all()
    assert set(np.unique(view.mask)) <= set(np.round(255 * np.arange(10) / 9).astype(int))
    # A mask is the area that the person covers: a much finer one agrees in the mean.
    K = camera.K.copy()
    K[:2] *= 12
    fine = replace(camera, K=K, width=12 * camera.width, height=12 * camera.height)
    covered = rasterize_mesh(mesh, fine).mask.reshape(camera.height, 12, camera.width, 12).mean(axis=(1, 3))
    assert np.abs(view.mask / 255 - covered).max() < 0.25
    assert np.abs(view.mask / 255 - covered).mean() < 4e-3
    assert (view.labels[view.mask == 255] > 0).all() and not view.labels[view.mask == 0].any()
    assert {1, 2, 3, 4, 5} <= set(np.unique(view.labels))


def test_normals_are_unit_face_the_camera_and_survive_their_file(person, tmp_path):
    mesh = TriangleMesh(person.tpose.vertices, person.tpose.faces)
    rig = camera_rig(mesh.vertices, mesh.vertices[person.vertex_part == 4], count=4, size=64, seed=0)
    normals = normal_map(LitFrame(mesh, np.arange(mesh.face_count), np.ones((2, mesh.vertex_count))), rig[3].camera)
    hit = normals.any(axis=2)
    np.testing.assert_allclose(np.linalg.norm(normals[hit], axis=1), 1, atol=1e-9)
    assert (normals[hit] @ rig[3].camera.forward < 0.3).all()
    write_normal_png(tmp_path / "n.png", normals)
    with Image.open(tmp_path / "n.png") as image:
        assert image.size == (rig[3].camera.width, rig[3].camera.height)
        image.load()
        high = np.asarray(image)  # Pillow keeps the upper eight bits
    assert not high[~hit].any()
    np.testing.assert_allclose(high[hit] / 255 * 2 - 1, normals[hit], atol=0.02)


def test_png16_keeps_all_bits(tmp_path):
    imagecodec = pytest.importorskip("imageio_ffmpeg", reason="an independent decoder")
    import subprocess

    image = np.random.default_rng(0).integers(0, 65536, (5, 7, 3), dtype=np.uint16)
    (tmp_path / "a.png").write_bytes(png16(image))
    raw = subprocess.run(
        [
            imagecodec.get_ffmpeg_exe(),
            "-v",
            "error",
            "-i",
            tmp_path / "a.png",
            "-f",
            "rawvideo",
            "-pix_fmt",
            "rgb48le",
            "-",
        ],
        capture_output=True,
        check=True,
    ).stdout
    np.testing.assert_array_equal(np.frombuffer(raw, "<u2").reshape(5, 7, 3), image)


def test_compact_arrays_read_back_and_repeat_bit_for_bit(tmp_path):
    arrays = {
        "verts": np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32),
        "names": np.array(["a", "bc"]),
    }
    for name in ("one.npz", "two.npz"):
        save_compact(tmp_path / name, arrays)
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
    with np.load(tmp_path / "one.npz", allow_pickle=False) as data:
        for name, value in arrays.items():
            np.testing.assert_array_equal(data[name], value)


# --- performance ----------------------------------------------------------------------------------------------------


def test_a_performance_starts_neutral_is_smooth_seeded_and_talks():
    body = load_body()

    def play(seed: int, step: float = 0.02):
        performance = Performance(np.zeros(20), body.expression_names, seconds=5.0, seed=seed)
        return performance.at(np.arange(0, 5, step))

    one, again, other = play(1), play(1), play(2)
    np.testing.assert_array_equal(one.full_pose, again.full_pose)
    assert np.abs(one.full_pose - other.full_pose).max() > 0.1
    assert not one.expression[0].any() and not one.jaw_pose[0].any()
    assert one.expression.min() >= 0 and one.expression.max() <= 1
    # It starts from rest, and no joint turns faster than people do.
    speed = np.linalg.norm(np.diff(one.full_pose, axis=0), axis=2) / 0.02
    assert speed[0].max() < 0.5 and speed.max() < np.radians(700)
    jaw = body.expression_names.index("jawOpen")
    assert one.expression[:, jaw].max() > 0.3
    assert np.ptp(one.jaw_pose[:, 0]) > np.radians(2)
    assert np.ptp(one.global_orient[:, 1]) > np.radians(50)


# --- whole captures -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("frames", "expected"), [(1, (1, 0)), (4, (4, 0)), (5, (4, 1)), (16, (13, 3))])
def test_the_last_fifth_of_the_frames_is_held_out(frames, expected):
    assert split_frames(frames) == expected


@pytest.mark.parametrize(
    "wrong", [{"cameras": 0}, {"frames": 0}, {"size": 4}, {"fps": 0.0}, {"layout": "colmap"}, {"truth_step": 0}]
)
def test_what_cannot_be_made_is_refused(wrong):
    with pytest.raises(InputError, match="expected"):
        SynthConfig(**wrong)


def test_the_command_refuses_a_full_folder_and_a_missing_person(tmp_path, capsys):
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "file").touch()
    assert main(["synth", "--out", str(tmp_path / "old")]) == 2
    assert "empty folder" in capsys.readouterr().err.replace("\n", " ")
    assert main(["synth", "--out", str(tmp_path / "new"), "--person", str(tmp_path / "old")]) == 2
    assert "topology.npz" in capsys.readouterr().err.replace("\n", "")
    assert not (tmp_path / "new").exists()


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("synth") / "tiny"
    make_capture(out, TOPOLOGY, QUICK)
    return out


@pytest.mark.slow
def test_a_capture_is_the_same_every_time(tiny, tmp_path):
    make_capture(tmp_path / "tiny", TOPOLOGY, QUICK)
    names = sorted(path.relative_to(tiny) for path in tiny.rglob("*") if path.is_file())
    assert names == sorted(p.relative_to(tmp_path / "tiny") for p in (tmp_path / "tiny").rglob("*") if p.is_file())
    for name in names:
        if name.name not in ("params.npz", "params_noisy.npz"):  # np.savez writes the time of day
            assert (tiny / name).read_bytes() == (tmp_path / "tiny" / name).read_bytes(), name


@pytest.mark.slow
def test_a_tiny_capture_is_complete(tiny):
    capture = open_capture(tiny)
    assert list(capture.cameras) == ["Cam001", "Cam002"] and capture.frames == (0, 1)
    assert not capture.problems and capture.fps == 25.0
    for camera in capture.cameras:
        for frame in capture.frames:
            assert capture.image(camera, frame).shape == (48, 40, 3)
            assert capture.mask(camera, frame).max() == 255
            assert set(np.unique(capture.labels(camera, frame))) >= {0, 1, 4, 5}
            assert capture.normals(camera, frame).any()
    assert capture.truth_mesh(1) is not None and capture.params(1) is not None
    checks = json.loads((tiny / "checks.json").read_text())
    assert checks["body_vs_skinning_max_mm"] < 0.05


@pytest.mark.slow
def test_another_light_is_the_same_performance(tiny, tmp_path):
    panorama = np.zeros((8, 16, 3))
    panorama[:4] = [3.0, 1.0, 0.2]
    make_capture(tmp_path / "lit", TOPOLOGY, QUICK, environment=Environment(panorama, "evening", turn=30.0))
    changed = {
        path.relative_to(tiny).parts[0]
        for path in tiny.rglob("*")
        if path.is_file()
        and path.suffix != ".npz"
        and path.read_bytes() != (tmp_path / "lit" / path.relative_to(tiny)).read_bytes()
    }
    assert changed == {"rgbs", "manifest.json", "README.md"}
    light = json.loads((tmp_path / "lit" / "manifest.json").read_text())["light"]
    assert (light["panorama"], light["turn"]) == ("evening", 30.0) and light["exposure"] > 0.0
    capture = open_capture(tmp_path / "lit")
    image, mask = capture.image("Cam001", 1), capture.mask("Cam001", 1) == 255
    assert image[mask][:, 0].mean() > 2.0 * image[mask][:, 2].mean()


def test_the_command_refuses_a_light_that_is_none(tmp_path, capsys):
    for options, word in (
        (["--environment", str(tmp_path / "none.hdr")], "none.hdr"),
        (["--environment-turn", "30"], "panorama"),
    ):
        assert main(["synth", "--out", str(tmp_path / "new"), *options]) == 2
        assert word in capsys.readouterr().err.replace("\n", "")
        assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_the_other_layout_is_actorshqs(tmp_path):
    make_capture(tmp_path / "a", TOPOLOGY, replace(QUICK, layout="actorshq"))
    sequence = tmp_path / "a" / "Actor01" / "Sequence1"
    assert len((sequence / "aabbs.csv").read_text().splitlines()) == 3
    assert (sequence / "1x" / "rgbs" / "Cam001" / "Cam001_rgb000001.jpg").is_file()
    assert (sequence / "1x" / "masks" / "Cam002" / "Cam002_mask000000.png").is_file()
    assert [camera.name for camera in read_cameras(sequence / "1x" / "calibration.csv")] == ["Cam001", "Cam002"]
    capture = open_capture(sequence / "1x")
    assert capture.format == "actorshq" and capture.mask("Cam001", 1).any()
    assert capture.params(1).expression.shape == (1, 52)
