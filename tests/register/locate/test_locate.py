"""A body is found in a bare surface, wherever it stands and whichever way it faces."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from smplxpp.body import load_body, load_params
from smplxpp.body.named_poses import low_poses, rare_poses
from smplxpp.clean import Simplified, simplify
from smplxpp.core import (
    OBJECT,
    SKIN,
    BodyParams,
    InputError,
    TriangleMesh,
    concatenate_meshes,
    ignore_progress,
    matrix_from_rotvec,
)
from smplxpp.core.mesh_files.mesh_io import read_mesh
from smplxpp.people.scan_simulation import ScanConfig, simulate_scan
from smplxpp.people.things import Thing, thing_mesh
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.landmarks import visible_vertices
from smplxpp.register.locate import BodyNotFoundError, LocateConfig, locate, locate_body
from smplxpp.register.locate.decision import (
    closed_hands,
    confidence_of,
    is_doubtful,
    missing_parts,
    no_person,
    notes_of,
)
from smplxpp.register.locate.dressed import PARTS, Misfit
from smplxpp.register.locate.proxy import Region, regions
from smplxpp.register.locate.search import Found, Search

PERSON = Path(__file__).resolve().parents[3] / "data" / "fixtures" / "person"
QUICK = LocateConfig(
    directions=6,
    starts=6,
    limbs_tried=2,
    candidates=2,
    coarse_points=400,
    fine_points=1200,
    dress_steps=5,
    finish_steps=5,
)
# For what no number of points and starts decides.
LEAST = replace(QUICK, directions=4, starts=3, coarse_points=200, fine_points=400, dress_steps=3, finish_steps=3)


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module")
def whole() -> TriangleMesh:
    return read_mesh(PERSON / "scans" / "scan_000000.ply").mesh


@pytest.fixture(scope="module")
def coarse(whole) -> Simplified:
    """The scan with a quarter of its faces, of which points are drawn in less time."""
    return simplify(whole, 20_000)


@pytest.fixture(scope="module")
def scan(coarse) -> TriangleMesh:
    return coarse.mesh


@pytest.fixture(scope="module")
def truth(body) -> np.ndarray:
    params = load_params(PERSON / "params" / "params.npz", body=body).frame(0)
    return body.forward(params).vertices[0]


@pytest.fixture(scope="module")
def located(body, scan):
    return locate_body(body, scan, config=QUICK)


def _error(body, located, truth) -> float:
    return float(np.linalg.norm(body.forward(located.params).vertices[0] - truth, axis=1).mean())


def test_the_fixtures_person_is_found_under_her_clothes(body, located, truth):
    assert _error(body, located, truth) < 0.015
    assert located.confidence > 0.9
    assert located.notes == ()


def test_both_facings_were_followed_and_the_best_comes_first(located):
    facings = np.radians([one.facing_degrees for one in located.candidates])
    assert np.cos(facings - facings[0]).min() < -0.5
    assert located.candidates[0].cost == min(one.cost for one in located.candidates)


@pytest.mark.long
def test_she_is_found_as_well_after_she_has_turned_and_moved_and_her_faces_point_inward(body, scan, truth):
    turn, move = matrix_from_rotvec(np.array([0.0, 2.4, 0.0])), np.array([3.0, 0.5, -2.0])
    found = locate_body(body, TriangleMesh(scan.vertices @ turn.T + move, scan.faces[:, ::-1]), config=QUICK)
    assert _error(body, found, truth @ turn.T + move) < 0.015


@pytest.mark.long
def test_the_same_seed_finds_the_same_body(body, scan, located):
    again = locate_body(body, scan, config=QUICK)
    assert np.array_equal(again.params.full_pose, located.params.full_pose)
    assert np.array_equal(again.params.betas, located.params.betas)


@pytest.mark.long
def test_a_heavier_prior_of_poses_turns_joints_less(body, scan, located):
    stiff = locate_body(body, scan, config=replace(QUICK, pose_prior=300.0))
    assert np.abs(stiff.params.body_pose).sum() < 0.8 * np.abs(located.params.body_pose).sum()


@pytest.mark.parametrize("later", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.long
def test_landmarks_overrule_the_surface(body, whole, monkeypatch, later):
    """Somebody says that she faces backwards: that is believed. What is searched later moves single limbs."""
    if not later:
        monkeypatch.setattr(locate, "look_again", lambda search, best, hints: (best, ()))
        monkeypatch.setattr(locate, "raise_head", lambda search, best: best)
        monkeypatch.setattr(locate, "lift_heels", lambda search, best: best)
    back = {"nose": [0.0, 1.45, -0.15], "left_wrist": [-0.5, 0.95, 0.0], "right_wrist": [0.5, 0.95, 0.0]}
    found = locate_body(body, whole, landmarks={k: np.array(v) for k, v in back.items()}, config=QUICK)
    assert abs(abs(found.candidates[0].facing_degrees) - 180.0) < 30.0


# Bent down with straight legs, arms towards the floor, as to lift something; degrees.
BENT = {
    "pelvis": (30, 0, 0),
    "spine1": (25, 0, 0),
    "spine2": (25, 5, 0),
    "spine3": (15, 0, 0),
    "left_hip": (-28, 0, -3),
    "right_hip": (-32, 0, 3),
    "left_shoulder": (0, -75, -10),
    "right_shoulder": (0, 65, 10),
}


@pytest.fixture(scope="module")
def bent(body) -> tuple[TriangleMesh, BodyParams]:
    """Return the surface of a body in that pose, dressed in clothes that stand off 15 mm, and the body."""
    pose = np.zeros((1, body.joint_count, 3))
    for joint, degrees in BENT.items():
        pose[0, body.joint_names.index(joint)] = np.radians(degrees)
    params = BodyParams.from_full_pose(
        pose, betas=np.zeros(body.num_betas), expression=np.zeros(body.num_expressions), transl=np.zeros(3)
    )
    mesh = body.mesh(body.forward(params).vertices[0])
    worn = np.isin(regions(body), (Region.TRUNK, Region.ARM, Region.LEG))
    outer = np.isin(mesh.faces, visible_vertices(body)).all(axis=1)
    return mesh.with_vertices(mesh.vertices + 0.015 * worn[:, None] * mesh.vertex_normals).submesh(outer)[0], params


@pytest.mark.long
def test_a_body_that_no_standing_pose_explains_is_found_among_rare_poses(body, bent):
    mesh, params = bent
    found = locate_body(body, mesh, config=LEAST)
    truth, posed = body.forward(params), body.forward(found.params)
    assert found.candidates[0].pose in dict(rare_poses(body.joint_count))
    assert np.linalg.norm(posed.vertices[0] - truth.vertices[0], axis=1).mean() < 0.025
    assert np.linalg.norm(posed.joints[0, :22] - truth.joints[0, :22], axis=1).max() < 0.08


def test_low_poses_find_a_person_on_the_heels(body):
    """Thighs on calves: from poses on the feet a search ended with the feet in front, and was not believed."""
    pose = dict(low_poses(body.joint_count))["on the heels, arms hanging"].copy()
    pose[1:22] += np.radians(4.0) * np.random.default_rng(0).normal(size=(21, 3))
    params = BodyParams.from_full_pose(
        pose[None], betas=np.zeros(body.num_betas), expression=np.zeros(body.num_expressions), transl=np.zeros(3)
    )
    outer = np.isin(body.faces, visible_vertices(body)).all(axis=1)
    mesh = body.mesh(body.forward(params).vertices[0]).submesh(outer)[0]
    config = replace(LEAST, limbs_tried=1, candidates=1)
    search = Search(Kinematics(body), mesh, config, None, ignore_progress)
    best = search.candidates(low_poses(body.joint_count))[0]
    found = body.forward(best.state.to_params(body)).vertices[0]
    assert best.name.startswith("on the heels")
    assert np.linalg.norm(found - body.forward(params).vertices[0], axis=1).mean() < 0.03


def test_rare_poses_are_tried_only_where_standing_ones_leave_something_unexplained(located):
    rare = {name for name, _ in rare_poses(55)}
    assert not rare & {one.pose for one in located.candidates}
    plain, parts = _found(), dict.fromkeys(PARTS, 0.9)
    assert not is_doubtful(plain)
    assert is_doubtful(replace(plain, misfit=replace(plain.misfit, covered=0.75)))
    assert is_doubtful(replace(plain, misfit=replace(plain.misfit, bare=0.05)))
    assert is_doubtful(replace(plain, misfit=replace(plain.misfit, parts={**parts, "left foot": 0.1})))


def test_a_landmark_that_no_body_has_is_refused(body, scan):
    with pytest.raises(InputError, match="third_elbow"):
        locate_body(body, scan, landmarks={"third_elbow": np.zeros(3)}, config=QUICK)


@pytest.mark.long
def test_labels_of_a_labeller_are_asked_for_until_they_stay(body, coarse, scan, truth):
    labels = np.load(PERSON / "scans" / "scan_000000_labels.npz")["label"].astype(int)[coarse.source_vertex] - 1
    asked = []

    def labeller(params):
        asked.append(params)
        corner = labels[scan.faces]
        return np.where((corner == corner[:, :1]).all(axis=1), corner[:, 0], -1)

    found = locate_body(body, scan, labeller=labeller, config=QUICK)
    # Of the body fitted as if unclothed, of the one within the clothes, and of that fitted with its skin.
    assert len(asked) == 3
    assert _error(body, found, truth) < 0.010


@pytest.mark.long
def test_a_binder_does_not_draw_the_hand_that_holds_it_once_labels_tell_it(body):
    """Fingers, wrist and shoulders followed the board under the hand, whose labels were right, and the shape them."""
    kinematics = Kinematics(body)
    start = BodyState(
        np.tile(np.eye(3), (1, body.joint_count, 1, 1)),
        np.zeros((1, 3)),
        np.zeros(body.num_betas),
        np.zeros((1, body.num_expressions)),
    )
    posed = body.forward(start.to_params(body))
    skin, binder = body.mesh(posed.vertices[0]), thing_mesh(Thing("binder", "right"), body, posed)
    coarse = ScanConfig(cell=0.015, views=14, resolution=256, faces=6000)
    taken = simulate_scan(concatenate_meshes([skin, binder]), [], coarse)
    held = (taken.face >= skin.face_count)[taken.mesh.faces].sum(axis=1) >= 2
    config = LocateConfig(coarse_points=200, fine_points=1500, finish_steps=6)
    search = Search(kinematics, taken.mesh, config, None, ignore_progress)
    drawn = search.finished(search.measured("T", start))
    found, kept = (
        locate._labelled(search, drawn, lambda params: np.where(held, OBJECT.id, SKIN.id), colored=colored)
        for colored in (True, False)
    )
    off, least, most = (
        np.linalg.norm(body.forward(one.state.to_params(body)).vertices[0] - posed.vertices[0], axis=1).mean()
        for one in (drawn, found, kept)
    )
    assert off > 0.017 and least < 0.013
    assert most > 0.015  # without colours a part of it may be sleeve: it stays
    # What the body explains is counted over the whole surface, as that of other candidates.
    assert len(found.misfit.unexplained) == len(search.fine)


@pytest.mark.long
def test_an_arm_that_is_cut_off_is_named_and_believed_less(body, scan, located):
    arm = scan.face_centers[:, 0] > 0.27
    found = locate_body(body, scan.submesh(~arm)[0], config=QUICK)
    assert "left hand" in " ".join(found.notes)
    assert "right hand" not in " ".join(found.notes)
    assert found.confidence < 0.5 < located.confidence


def test_a_box_is_nobody(body):
    corners = np.array([[x, y, z] for x in (0, 0.6) for y in (0, 1.7) for z in (0, 0.4)], dtype=np.float64)
    quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    with pytest.raises(BodyNotFoundError, match=r"one whole person.*convex") as refused:
        locate_body(body, TriangleMesh(corners, faces), config=QUICK)
    # The body that the error shows stands in the middle of the box.
    shown = body.forward(refused.value.params).vertices[0]
    assert np.abs(shown.mean(axis=0) - corners.mean(axis=0)).max() < 0.1 and refused.value.confidence == 0.0


def test_a_body_that_explains_little_of_a_surface_is_no_person():
    parts = dict.fromkeys(PARTS, 0.9)
    state = BodyState(np.eye(3)[None, None], np.zeros((1, 3)), np.zeros(10), np.zeros((1, 10)))
    whole = Found("by hand", state, Misfit(0.005, 0.015, 0.95, 0.7, parts), 10.0, landmarks=0.0)
    assert no_person(whole) == ""
    assert "explains 40%" in no_person(replace(whole, misfit=replace(whole.misfit, covered=0.4)))
    assert "20% of its hands" in no_person(replace(whole, misfit=replace(whole.misfit, shown=0.2)))
    assert "unlike any person" in no_person(replace(whole, state=replace(state, betas=np.full(10, 6.0))))


def test_a_person_in_centimetres_is_refused_with_the_options_named(body, scan):
    with pytest.raises(InputError, match="--units"):
        locate_body(body, scan.with_vertices(100 * scan.vertices), config=QUICK)


def test_colours_of_another_mesh_are_refused(body, scan):
    with pytest.raises(InputError, match="colours"):
        locate_body(body, scan, colors=np.zeros((3, 3), dtype=np.uint8), config=QUICK)


def test_landmarks_that_are_centimetres_off_do_not_lower_the_confidence():
    """A hand places landmarks centimetres off; a surface that fits as well as before is believed as much."""
    best = _found()
    assert best.cost < replace(best, landmarks=0.04).cost
    assert confidence_of(replace(best, landmarks=0.04), ()) == confidence_of(best, ()) > 0.7


def _found(*, surface: float = 0.004, bare: float = 0.015, **parts: float) -> Found:
    """Return a body with these distances to a surface, metres, and shares of parts shown; others are well shown."""
    shown = dict.fromkeys(PARTS, 0.9) | {name.replace("_", " "): share for name, share in parts.items()}
    state = BodyState(np.eye(3)[None, None], np.zeros((1, 3)), np.zeros(10), np.zeros((1, 10)))
    return Found("made", state, Misfit(surface, bare, 0.95, 0.7, shown), 10.0, landmarks=0.0)


def test_wide_clothes_do_not_lower_the_confidence_and_hands_and_face_elsewhere_do():
    assert confidence_of(_found(surface=0.020), ()) == confidence_of(_found(surface=0.004), ()) > 0.8
    assert confidence_of(_found(bare=0.030), ()) < 0.01


def test_a_heavy_woman_is_believed_and_a_shape_that_the_surface_does_not_show_is_not():
    """The scan of a heavy woman, explained to 99 %, had a confidence of 0.2 and was told to check its units."""
    found = _found()
    heavy = replace(found, state=replace(found.state, betas=np.full(10, 3.2)))
    assert confidence_of(heavy, ()) == confidence_of(found, ()) > 0.8 and notes_of(heavy, ()) == ()
    for misfit in (replace(heavy.misfit, covered=0.85), replace(heavy.misfit, bare=0.0245)):
        doubtful = replace(heavy, misfit=misfit)
        usual = replace(found, misfit=misfit)
        assert confidence_of(doubtful, ()) == pytest.approx(0.2 * confidence_of(usual, ()))
        assert "unlike people" in notes_of(doubtful, ())[-1]


def test_fists_are_no_missing_hands_but_a_hand_is_lost_with_its_forearm():
    """A fist shows some of an open hand; an arm that lies elsewhere shows as much of the hand and no forearm."""
    fist, elsewhere = _found(left_hand=0.3), _found(left_hand=0.3, left_forearm=0.05)
    assert (missing_parts(fist), closed_hands(fist)) == ([], ["left hand"])
    assert (missing_parts(elsewhere), closed_hands(elsewhere)) == (["left hand", "left forearm"], [])
    assert "fist" in " ".join(notes_of(fist, ()))
    assert "not found in the scan: left hand, left forearm" in " ".join(notes_of(elsewhere, ()))
    assert confidence_of(elsewhere, ()) < 0.5 < confidence_of(fist, ())
