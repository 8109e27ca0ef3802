"""A person who turns before one camera: poses, shape, vertical and lens from keypoints and masks of one view a pose."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core import InputError, matrix_from_rotvec
from smplxpp.register import Observations, RegisterConfig
from smplxpp.register.kinematics import BodyState, Kinematics
from smplxpp.register.normal_equations import NormalEquations
from smplxpp.register.turntable import TurntableConfig, leveled, register_turntable, turn_notes
from smplxpp.register.turntable.held_pose import HeldPose, Shared, SharedColumns, SharedPriors
from smplxpp.register.turntable.level import widest_unseen
from smplxpp.register.turntable.start import best_path
from tests.register.turns import CAMERA, turned_person

BODY = load_body()
FRAMES = 6
QUICK = RegisterConfig(rim_samples=800)


@pytest.fixture(scope="module")
def turn():
    return turned_person(BODY, FRAMES)


@pytest.fixture(scope="module")
def found(turn):
    """The turn registered with a lens that is taken for a tenth longer than it is, and the stature as told."""
    observed = Observations(
        tuple(range(FRAMES)),
        {CAMERA: turn.level_camera(1.1)},
        {CAMERA: turn.keypoints},
        mask=lambda name, frame: turn.masks[frame],
    )
    config = TurntableConfig(stature=turn.stature, focal_spread=0.2, keypoint_steps=16, surface_steps=3, solver=QUICK)
    return register_turntable(BODY, observed, config)


def test_poses_and_shape_of_one_view_a_pose(turn, found):
    params, camera = leveled(found, BODY)
    own, true = BODY.forward(params), BODY.forward(turn.params)
    # In the camera's axes, from the pelvis on: the direction of view has no say in how far away the person is.
    errors = []
    for frame in range(FRAMES):
        a = own.vertices[frame] - own.joints[frame, 0]
        b = true.vertices[frame] - true.joints[frame, 0]
        a, b = a @ camera.cam_from_world[:3, :3].T, b @ turn.camera.cam_from_world[:3, :3].T
        errors.append(1e3 * np.linalg.norm(a - b, axis=1).mean())
    assert max(errors) < 30.0 and np.mean(errors) < 20.0
    assert np.median(found.fit.residuals["keypoints_px"]) < 1.5
    assert np.median(found.fit.residuals["silhouette_px"]) < 1.5
    assert found.stature == pytest.approx(turn.stature, abs=0.01)
    assert found.turned == pytest.approx(360.0 * (FRAMES - 1) / FRAMES, abs=6.0)


def test_the_stated_uncertainty_of_the_lens_covers_its_error(turn, found):
    # The equations alone stated a third of it: errors of keypoints are not independent, as they take them to be.
    error = abs(np.log(found.camera.K[0, 0] / turn.camera.K[0, 0]))
    assert error < 2.0 * found.focal_spread and 0.05 < found.focal_spread < 0.2
    assert "percent: state --focal-mm" in " ".join(turn_notes(found, BODY, stature=None))


def test_the_world_stands_on_its_floor_and_nothing_moves_in_the_image(found):
    params, camera = leveled(found, BODY)
    before, after = BODY.forward(found.fit.params), BODY.forward(params)
    for frame in (0, FRAMES - 1):
        there = found.camera.screen_from_world(before.vertices[frame, ::50])
        np.testing.assert_allclose(camera.screen_from_world(after.vertices[frame, ::50]), there, atol=1e-6)
    assert np.median(after.vertices[:, :, 1].min(axis=1)) == pytest.approx(0.0, abs=1e-9)
    # The camera looks down by 11 degrees, as it was held.
    down = np.degrees(np.arcsin(-camera.forward[1]))
    assert down == pytest.approx(np.degrees(np.arctan2(0.65, 3.2)), abs=3.0)


def test_what_one_camera_leaves_open_is_said(found, turn):
    notes = " ".join(turn_notes(found, BODY, stature=None))
    assert "--height" in notes and "soles" in notes
    assert "--height" not in " ".join(turn_notes(found, BODY, stature=turn.stature))
    roots = matrix_from_rotvec(np.radians([[0.0, angle, 0.0] for angle in (0, 40, 90, 250)]))
    assert widest_unseen(roots, np.array([0.0, 1.0, 0.0])) == pytest.approx(160.0)


def test_a_path_goes_one_way_round_though_single_frames_say_otherwise():
    # Eight frames to the right; front and back of the third look alike, and the back is a little better.
    cost = np.ones((8, 36))
    true = [(-frame * 36 // 8) % 36 for frame in range(8)]
    for frame, turn in enumerate(true):
        cost[frame, turn] = 0.1
    cost[2, (true[2] + 18) % 36] = 0.05
    path, _ = best_path(cost)
    assert path.tolist() == true


def test_derivatives_of_the_held_pose():
    rng = np.random.default_rng(0)
    kinematics = Kinematics(BODY)
    joints = np.array([0, 1, 4, 16])
    columns = SharedColumns.of(BODY, joints)
    state = BodyState.of_params(BODY, turned_person(BODY, 4, height=40).params)
    up = np.array([0.1, 0.98, -0.05]) / np.linalg.norm([0.1, 0.98, -0.05])
    mean = matrix_from_rotvec(rng.normal(0, 0.1, (BODY.joint_count, 3)))
    shared = Shared(mean, up, 0.9, np.log(800.0))
    held = HeldPose(kinematics, columns, SharedPriors(700.0, 0.1, stature=1.7), np.ones(len(state), dtype=bool))

    def gradient(state, shared):
        equations = NormalEquations(columns, len(state))
        held.add(equations, state, shared)
        return equations

    # The normal matrix J^T J predicts how the gradient J^T r changes along any small step, where residuals are small.
    close = Shared(state.rotations.mean(axis=0), up, 0.9, np.log(700.0))
    u, _, vt = np.linalg.svd(close.mean)
    close = Shared(
        u @ vt, np.array([0.0, 1.0, 0.0]), float((state.transl + kinematics.rest_joints[0])[:, 1].mean()), np.log(700.0)
    )
    close.mean[0] = np.eye(3)
    equations = gradient(state, close)
    step = 1e-5 * rng.normal(size=columns.betas)
    step[columns.mean_pose] *= np.repeat([0.0, 1.0, 1.0, 1.0], 3)  # the root's departures are not small here
    step[columns.vertical] = 0.0
    moved = gradient(
        BodyState(state.rotations, state.transl, state.betas + step[: columns.shape], state.expression),
        close.updated(columns, step),
    )
    change = moved.shape_gradient - equations.shape_gradient
    expected = equations.shape @ step
    rows = np.r_[columns.mean_pose.start + 3 : columns.mean_pose.stop, columns.height, columns.focal]
    scale = np.abs(expected[rows]).max()
    np.testing.assert_allclose(change[rows], expected[rows], atol=0.15 * scale)
    assert gradient(state, shared).shape_gradient[columns.focal] == pytest.approx(np.log(800 / 700) / 0.01)


@pytest.mark.parametrize(("frames", "repeats"), [(6, 1.0), (8, 1.0), (48, 6.0)])
def test_many_frames_of_one_detector_do_not_outvote_the_shape_prior(frames, repeats):
    """Of 53 frames of a real man in a jacket the betas reached 6.8, because a detector errs alike in all of them."""
    columns = SharedColumns.of(BODY, np.array([0, 1, 4, 16]))
    state = BodyState.of_params(BODY, turned_person(BODY, frames, height=40).params)
    mean = np.broadcast_to(np.eye(3), (BODY.joint_count, 3, 3))
    shared = Shared(mean, np.array([0.0, 1.0, 0.0]), 0.9, np.log(800.0))
    tells = np.arange(frames + 8) < frames
    held = HeldPose(Kinematics(BODY), columns, SharedPriors(800.0, 0.1), tells)
    equations = NormalEquations(columns, len(state))
    held._add_shared(equations, state, shared)
    shape = slice(0, columns.shape)
    np.testing.assert_allclose(equations.shape[shape, shape], repeats * np.eye(columns.shape))
    np.testing.assert_allclose(equations.shape_gradient[shape], repeats * state.betas)


def test_refused_before_any_work(turn):
    camera = turn.level_camera()
    keypoints = {CAMERA: turn.keypoints}
    for observed, words in (
        (Observations((0, 1, 2, 3), {CAMERA: camera, "b": camera}, keypoints), "expected one camera, received 2"),
        (Observations((0, 1, 2), {CAMERA: camera}, keypoints), "at least 4 frames"),
        (Observations((0, 1, 2, 3), {CAMERA: camera}), "expected keypoints of its camera"),
    ):
        with pytest.raises(InputError, match=words):
            register_turntable(BODY, observed)


def test_of_frames_that_are_held_out_only_poses_are_taken(turn):
    # Frame 3 shows a person of 1.3 times the size: as a held-out frame it must not change the shape.
    wrong = turn.keypoints.points.copy()
    wrong[3] = 200 + 1.3 * (wrong[3] - 200)
    seen = type(turn.keypoints)(turn.keypoints.names, turn.keypoints.frames, wrong, turn.keypoints.confidence)
    config = TurntableConfig(keypoint_steps=10, surface_steps=0)
    shapes = []
    for points in (seen, turn.keypoints):
        observed = Observations(
            tuple(range(FRAMES)), {CAMERA: turn.level_camera()}, {CAMERA: points}, shape_frames=(0, 1, 2, 4, 5)
        )
        shapes.append(register_turntable(BODY, observed, config).fit.params.betas[0])
    assert np.abs(shapes[0] - shapes[1]).max() < 0.1
