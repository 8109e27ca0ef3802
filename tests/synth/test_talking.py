"""The talking motion: within what people do, seeded, of one vocabulary; trousers, painted colours, a capture."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.cli import main
from pipelines.commands.synth import Synth
from smplxpp.body import load_body
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.capture import open_capture
from smplxpp.capture.cameras import camera_rig
from smplxpp.core import BodyParams, InputError, TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.people.fixture_person import load_person, read_layers
from smplxpp.raster.soft_light import LightConfig
from smplxpp.synth.config import SynthConfig
from smplxpp.synth.motion import Performance
from smplxpp.synth.simulate import SimulationConfig, _Stage, attachment
from smplxpp.synth.talking import GESTURES, Talking
from smplxpp.synth.views import Atlas, LitFrame, _cell_centers, paint_atlas, render_view
from smplxpp.synth.write_capture import make_capture

pytestmark = pytest.mark.long

FIXTURE = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"
TOPOLOGY = FIXTURE / "geometry" / "topology.npz"
LONG, STEP = 39.9, 1 / 60
# Degrees that no joint turns beyond, and how fast joints turn at most; eyes jump.
LIMITS = {"shoulder": 95, "elbow": 135, "wrist": 85, "neck": 20, "head": 30, "spine": 12, "pelvis": 10, "hip": 20}
LIMITS |= {"knee": 25, "ankle": 15, "jaw": 10, "eye": 20, "index": 60, "middle": 60, "ring": 60, "pinky": 60}
FASTEST = 300
QUICK = SynthConfig(
    motion="talking",
    clothes="trousers",
    cameras=2,
    frames=5,
    fps=50.0,
    size=48,
    aspect=0.6,
    supersampling=1,
    texel=0.004,
    truth_step=2,
    normals_step=4,
    scan_faces=0,
    simulation=SimulationConfig(settle=0.02, substep={"lower": 1 / 100, "upper": 1 / 100}),
    light=LightConfig(directions=4, resolution=48),
)


@pytest.fixture(scope="module")
def person():
    return load_person(TOPOLOGY, "trousers")


def talking(seed: int, seconds: float = LONG) -> Talking:
    return Talking(np.zeros(20), load_body().expression_names, seconds, seed)


@pytest.fixture(scope="module", params=[0, 1, 2])
def played(request) -> tuple[Talking, BodyParams]:
    motion = talking(request.param)
    return motion, motion.at(np.arange(0, LONG, STEP))


# --- the motion -----------------------------------------------------------------------------------------------------


def test_talking_starts_neutral_at_rest_and_repeats_under_its_seed(played):
    motion, params = played
    start = Performance(np.zeros(20), load_body().expression_names, 1.0).at(np.zeros(1))
    np.testing.assert_array_equal(params.full_pose[0], start.full_pose[0])
    assert not params.expression[0].any()
    assert np.linalg.norm(np.diff(params.full_pose[:2], axis=0), axis=2).max() / STEP < np.radians(10)
    again = talking(motion.seed).at(np.arange(0, LONG, STEP))
    np.testing.assert_array_equal(params.full_pose, again.full_pose)
    np.testing.assert_array_equal(params.expression, again.expression)
    other = talking(motion.seed + 100).at(np.array([10.0]))
    assert np.abs(other.full_pose - motion.at(np.array([10.0])).full_pose).max() > 0.1


def test_joints_stay_within_what_people_do(played):
    _, params = played
    angle = np.degrees(np.linalg.norm(params.full_pose, axis=2))
    speed = np.degrees(np.linalg.norm(np.diff(params.full_pose, axis=0), axis=2)) / STEP
    for j, name in enumerate(SMPLX_JOINTS):
        kind = next((kind for kind in LIMITS if kind in name), None)
        if kind is None:
            continue
        assert angle[:, j].max() < LIMITS[kind], name
        assert kind == "eye" or speed[:, j].max() < FASTEST, name
    # It is a motion at all: elbows bend, hips and head turn, fingers curl.
    for name, least in (("left_elbow", 60), ("right_elbow", 60), ("pelvis", 2), ("head", 5), ("left_ring1", 5)):
        assert np.ptp(angle[:, SMPLX_JOINTS.index(name)]) > least, name


def test_it_is_smooth_and_never_repeats(played):
    _, params = played
    pose = np.delete(params.full_pose, [SMPLX_JOINTS.index(f"{side}_eye_smplhf") for side in ("left", "right")], 1)
    turn = np.diff(np.degrees(pose), 2, axis=0) / STEP**2
    assert np.abs(turn).max() < 4000  # degrees a second squared: no jump
    some = pose[::30].reshape(len(pose[::30]), -1)
    apart = np.linalg.norm(some[:, None] - some[None], axis=2)
    assert apart[np.triu_indices(len(some), 1)].min() > np.radians(3)


def test_lips_move_and_close_and_lids_blink_as_often_as_peoples(played):
    motion, params = played
    names = motion.expression_names
    assert params.expression.min() >= 0 and params.expression.max() <= 1
    jaw = params.expression[:, names.index("jawOpen")]
    assert jaw.max() > 0.35 and 0.1 < (jaw < 0.02).mean() < 0.6
    mouth = [k for k, name in enumerate(names) if name.startswith(("mouth", "jaw"))]
    assert (params.expression[:, mouth].max(axis=0) > 0.15).sum() >= 8
    opened = np.flatnonzero((jaw[1:-1] > jaw[:-2]) & (jaw[1:-1] >= jaw[2:]) & (jaw[1:-1] > 0.1))
    assert 0.8 < len(opened) / LONG < 4  # slow speech
    lids = params.expression[:, names.index("eyeBlinkLeft")]
    closed = np.flatnonzero((lids[1:] > 0.5) & (lids[:-1] <= 0.5))
    assert len(closed) == len(motion.blink_times)
    assert 60 / LONG * len(closed) == pytest.approx(19, abs=8)  # a minute
    np.testing.assert_array_less(0.9, motion.at(motion.blink_times + 0.02).expression[:, names.index("eyeBlinkLeft")])


def test_what_comes_last_has_been_shown_before(played):
    """In the first 320 of 400 frames every gesture comes at least twice; the last 80 show them in other ways."""
    motion, params = played
    early = [number for time, number in motion.gestures if time < 32]
    late = [number for time, number in motion.gestures if 32 <= time < LONG]
    assert np.bincount(early, minlength=len(GESTURES)).min() >= 2 and len(set(late)) >= 4
    arms = [j for j, name in enumerate(SMPLX_JOINTS) if "shoulder" in name or "elbow" in name]
    pose = np.degrees(params.full_pose[:, arms]).reshape(len(params), -1)
    shown, held = pose[: int(32 / STEP) : 6], pose[int(32 / STEP) :: 6]
    near = np.linalg.norm(held[:, None] - shown[None], axis=2).min(axis=1)
    still = np.linalg.norm(held - pose[0], axis=1)
    assert np.median(near) < 0.4 * np.median(still) and near.min() > 0.1


def test_no_time_to_talk_is_refused():
    with pytest.raises(InputError, match="seconds of talking"):
        talking(0, seconds=0.0)


def test_the_default_motion_is_the_fixtures():
    """Her stored parameters, to the last bits that another machine may round otherwise."""
    capture = open_capture(FIXTURE)
    stored = BodyParams.concatenate([capture.params(frame) for frame in capture.frames])
    person = load_person(TOPOLOGY)
    made = Performance(person.betas, person.body.expression_names, 1.5).at(np.arange(16) / 10)
    np.testing.assert_allclose(made.full_pose, stored.full_pose, rtol=0, atol=1e-12)
    np.testing.assert_allclose(made.expression, stored.expression, rtol=0, atol=1e-12)


# --- clothes and colours --------------------------------------------------------------------------------------------


def test_trousers_lie_close_around_the_legs_and_follow_them_wholly(person):
    body, lower = person.body, person.vertex_part == 2
    skin = TriangleMesh(person.tpose.vertices[: body.vertex_count], body.faces)
    distance = SignedDistanceField(skin, solid=True).query(person.tpose.vertices[lower]).distance
    assert 0.0035 < distance.min() and np.percentile(distance, 95) < 0.012
    np.testing.assert_allclose(person.weights[lower].sum(axis=1), 1, atol=1e-6)
    assert (attachment(person)[lower] == 1).all()
    cloth = person.tpose.submesh(person.face_part == 2)[0]
    assert (cloth.edges_with_counts[1] <= 2).all()
    hip, ankle = (body.joint_regressor @ skin.vertices)[[body.joint_names.index(n) for n in ("left_hip", "left_ankle")]]
    assert cloth.vertices[:, 1].max() > hip[1] + 0.08 and 0.02 < cloth.vertices[:, 1].min() - ankle[1] < 0.05


def test_the_other_layers_stay_what_they_are():
    old, new = read_layers(TOPOLOGY), read_layers(TOPOLOGY, "trousers")
    for part in (0, 1, 3, 4):
        for name in ("v_tpose", "weights", "vertex_label", "exprdirs"):
            of_part = [arrays[name][arrays["vertex_part"] == part] for arrays in (old, new)]
            np.testing.assert_array_equal(*of_part)
        corners = [arrays["v_tpose"][arrays["faces"][arrays["face_part"] == part]] for arrays in (old, new)]
        np.testing.assert_array_equal(*corners)
    assert (new["vertex_part"][new["faces"]] == new["face_part"][:, None]).all()
    assert all(new[name].dtype == old[name].dtype for name in new)


@pytest.mark.parametrize("n", range(1, 9))
def test_a_cell_is_found_by_its_middle(n):
    cells = np.arange(n * n)
    index = np.stack([cells, cells, cells], axis=1).astype(np.uint8)
    atlas = Atlas(np.array([n], dtype=np.int32), np.array([0]), index)
    bary = _cell_centers(cells, np.full(n * n, n))
    np.testing.assert_allclose(bary.sum(axis=1), 1)
    assert bary.min() > 0
    np.testing.assert_array_equal(atlas.colors(np.zeros(n * n, dtype=int), bary.astype(np.float32)), index)
    # Corners and edges, in single precision, lie in cells of their own face.
    rng = np.random.default_rng(0)
    edge = rng.dirichlet([0.2] * 3, 1000).astype(np.float32)
    assert atlas.colors(np.zeros(1000, dtype=int), edge).max() < n * n


def test_painted_colours_are_nearly_the_computed_ones(person):
    mesh = TriangleMesh(person.tpose.vertices, person.tpose.faces)
    camera = camera_rig(mesh.vertices, mesh.vertices, count=1, size=160, seed=0)[0].camera
    frame = LitFrame(mesh, np.arange(mesh.face_count), np.ones((2, mesh.vertex_count)))
    computed = render_view(person, frame, camera, supersampling=2)
    errors = []
    for cell in (0.004, 0.0015):
        painted = render_view(
            person, frame, camera, supersampling=2, atlas=paint_atlas(person, cell=cell, face_cell=cell)
        )
        np.testing.assert_array_equal(painted.mask, computed.mask)
        np.testing.assert_array_equal(painted.labels, computed.labels)
        seen = computed.mask > 0
        errors.append(np.abs(painted.image.astype(float) - computed.image)[seen].mean())
    assert errors[1] < errors[0] and errors[1] < 4


# --- options and captures -------------------------------------------------------------------------------------------


def test_options_left_out_are_as_the_motion_has_them(tmp_path):
    made = Synth(out=tmp_path / "a")._config()
    assert made == SynthConfig()
    long = Synth(out=tmp_path / "b", motion="talking", frames=400)._config()
    assert (long.cameras, long.clothes, long.truth_step, long.normals_step) == (8, "trousers", 2, 4)
    own = Synth(out=tmp_path / "c", motion="talking", cameras=5, width=320, clothes="skirt", truth_step=1)._config()
    assert (own.cameras, own.clothes, own.truth_step, own.aspect) == (5, "skirt", 1, 0.5)
    assert Synth(out=tmp_path / "d", skirt_pattern="dots")._config() == replace(made, skirt_pattern="dots")
    assert Synth(out=tmp_path / "e", skirt_length="calf")._config() == replace(made, skirt_length="calf")
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    wide = camera_rig(points, points, count=3, size=640, seed=0)
    assert (wide[0].camera.width, wide[0].camera.height) == (512, 640)
    narrow = camera_rig(points, points, count=3, size=640, seed=0, aspect=long.aspect)
    assert (narrow[0].camera.width, narrow[0].camera.height) == (384, 640)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (["--motion", "dancing"], "talking"),
        (["--motion", "talking", "--frames", "1"], "at least 2"),
        (["--motion", "talking", "--fps", "0"], "--fps"),
        (["--seed", "-1"], "--seed"),
        (["--clothes", "kilt"], "trousers"),
        (["--skirt-pattern", "checks"], "plaid"),
        (["--clothes", "trousers", "--skirt-pattern", "dots"], "with a skirt"),
        (["--skirt-length", "mini"], "calf"),
        (["--clothes", "trousers", "--skirt-length", "calf"], "with a skirt"),
        (["--width", "0"], "--width"),
        (["--cameras", "0"], "--cameras"),
    ],
)
def test_what_cannot_be_made_is_refused_and_names_are_listed(wrong, said, tmp_path, capsys):
    assert main(["synth", "--out", str(tmp_path / "new"), *wrong]) == 2
    assert said in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "new").exists()


def test_feet_keep_their_place(person):
    motion = Talking(person.betas, person.body.expression_names, LONG, 0)
    params, layers, _ = _Stage(person, motion, QUICK.simulation).standing(np.arange(0, LONG, 0.5))
    joints = person.body.forward(params).joints
    ankles = joints[:, [person.body.joint_names.index(f"{side}_ankle") for side in ("left", "right")]]
    assert np.abs(ankles - ankles[0])[..., [0, 2]].max() < 0.02
    assert np.ptp(joints[:, 0, 0]) > 0.02  # the hips move over them
    np.testing.assert_allclose(layers[..., 1].min(axis=1), 0, atol=1e-5)


@pytest.fixture(scope="module")
def short(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("talking") / "short"
    make_capture(out, TOPOLOGY, QUICK)
    return out


def test_a_short_talking_capture_is_whole_and_split(short):
    capture = open_capture(short)
    assert not capture.problems
    assert capture.splits.train_frames == (0, 1, 2, 3) and capture.splits.novel_pose_frames == (4,)
    assert capture.image("Cam001", 4).shape == (48, 32, 3)
    assert {0, 1, 4, 5} <= set(np.unique(capture.labels("Cam001", 0)))
    assert capture.truth_mesh(2) is not None and capture.truth_mesh(1) is None
    assert capture.normals("Cam001", 4) is not None and capture.normals("Cam001", 1) is None
    checks = json.loads((short / "checks.json").read_text())
    assert checks["lower_vs_skinning_mean_mm"] < 0.05 < checks["upper_vs_skinning_mean_mm"]
    readme = (short / "README.md").read_text()
    assert "Frames 0 to 3 are for training, 4 to 4 are held out" in readme
    assert "| 0, 2, 4 ... |" in readme and "talking" in readme and "trousers" in readme


def test_both_protocols_are_there(short):
    tracked = open_capture(short, protocol="tracked")
    exact = open_capture(short, protocol="exact")
    assert tracked.keypoints("Cam001").frames.tolist() == [0, 1, 2, 3, 4] and exact.keypoints("Cam001") is None
    assert 0 < np.linalg.norm(tracked.params(2).transl - exact.params(2).transl) < 0.06
    assert tracked.normals("Cam001", 0) is None and (tracked.labels("Cam001", 0) != exact.labels("Cam001", 0)).any()


def test_it_is_the_same_every_time(short, tmp_path):
    make_capture(tmp_path / "short", TOPOLOGY, QUICK)
    names = sorted(path.relative_to(short) for path in short.rglob("*") if path.is_file())
    assert names == sorted(p.relative_to(tmp_path / "short") for p in (tmp_path / "short").rglob("*") if p.is_file())
    for name in names:
        if name.name not in ("params.npz", "params_noisy.npz"):  # np.savez writes the time of day
            assert (short / name).read_bytes() == (tmp_path / "short" / name).read_bytes(), name
