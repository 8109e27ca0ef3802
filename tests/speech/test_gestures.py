"""A body that talks: feet stay, hands strike on stressed syllables and keep clear, nothing jumps or comes back soon."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from avatar.speech import Face, Phoneme, Speech, SpeechAnimator, StandingBody, TalkConfig, idle_motion, talking_motion
from avatar.speech.gesture_lexicon import MAX_DEVIATION, GestureLexicon, pose_arms
from avatar.speech.gesture_planner import MIN_BEAT_INTERVAL, find_beats
from avatar.speech.tracks import RandomTrack, Track
from smplxpp.body import load_body
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.body.retarget import FEET, PoseRange, Skeleton
from smplxpp.core import BodyParams, InputError, matrix_from_rotvec, rotvec_from_matrix

BODY = load_body()
SKELETON = Skeleton.of(BODY)
FACE = Face.of(BODY.expression_names, BODY.joint_names)
REST = BodyParams.rest(betas=0, expressions=BODY.num_expressions)
ARMS = [SMPLX_JOINTS.index(f"{side}_{name}") - 1 for side in ("left", "right") for name in ("shoulder", "elbow")]


def bent(**degrees: tuple[float, float, float]) -> np.ndarray:
    """A body pose (63,) of turned joints."""
    pose = np.zeros((21, 3))
    for name, angles in degrees.items():
        pose[SMPLX_JOINTS.index(name) - 1] = np.radians(angles)
    return pose.ravel()


def chatter(seconds: float, seed: int = 0, *, stress: bool = True) -> Speech:
    """Syllables of a consonant and a vowel; every third or so is stressed; phrases between silences."""
    rng, out, t = np.random.default_rng(seed), [], 0.3
    while t < seconds - 0.5:
        strong = rng.uniform() < 0.35
        vowel = 0.16 if strong else 0.08
        out += [
            Phoneme("T", t, t + 0.06),
            Phoneme("AA", t + 0.06, t + 0.06 + vowel, int(strong and stress)),
        ]
        t = out[-1].end + (rng.uniform(0.3, 1.2) if rng.uniform() < 0.07 else 0.0)
    return Speech(tuple(out), seconds)


@pytest.fixture(scope="module")
def body() -> StandingBody:
    seen = replace(REST, body_pose=bent(left_shoulder=(0, 0, -50), right_shoulder=(0, 0, 50))[None])
    return StandingBody.of(SKELETON, seen, surface=BODY.forward(REST).frame(0).vertices)


@pytest.fixture(scope="module")
def minute(body) -> tuple[SpeechAnimator, BodyParams, Speech]:
    animator, speech = SpeechAnimator(FACE, body, TalkConfig(seed=4)), chatter(90.0)
    return animator, animator.talk(speech), speech


def test_feet_stay_while_the_hips_move_over_them(body, minute):
    joints = SKELETON.pose(minute[1])
    feet = joints[:, SKELETON.at(*FEET)]
    assert np.abs(feet - feet[0]).max() < 1e-9
    still = SKELETON.pose(body.standing)[0, SKELETON.at(*FEET)]
    assert np.abs(feet[0] - still).max() < 1e-9
    assert 0.02 < np.ptp(joints[:, 0, 0]) < 0.08
    knees = minute[1].body_pose.reshape(-1, 21, 3)[:, [SMPLX_JOINTS.index(f"{s}_knee") - 1 for s in ("left", "right")]]
    assert knees[..., 0].min() > -0.05 and knees[..., 0].max() < np.radians(30)


def test_feet_keep_the_floor_they_stood_on_when_the_frame_is_turned_bent_and_elsewhere():
    rng = np.random.default_rng(1)
    pose = bent(left_hip=(-20, 5, 4), left_knee=(35, 2, 1), right_hip=(-18, -4, -2), right_knee=(33, 0, 0))
    seen = replace(
        REST, global_orient=np.array([[0.05, 1.1, -0.03]]), body_pose=pose[None], transl=rng.normal(size=(1, 3))
    )
    body = StandingBody.of(SKELETON, seen)
    feet = SKELETON.pose(talking_motion(chatter(9.0), FACE, body))[:, SKELETON.at(*FEET)]
    assert np.abs(feet - SKELETON.pose(body.standing)[0, SKELETON.at(*FEET)]).max() < 1e-9
    hips = SKELETON.pose(body.standing)[0, SKELETON.at("left_hip", "right_hip")]
    assert (hips[0] - hips[1])[0] > 0 and abs((hips[0] - hips[1])[2]) < 1e-9  # it faces +Z
    np.testing.assert_allclose(SKELETON.pose(body.standing)[0, 0], SKELETON.pose(seen)[0, 0], atol=1e-12)


def test_hands_strike_on_stressed_syllables(minute):
    """At a stroke the arms have arrived; in the half second before it they were under way."""
    animator, motion, speech = minute
    joints = SKELETON.pose(motion)[:, SKELETON.at("left_wrist", "right_wrist")]
    speed = 30.0 * np.linalg.norm(np.diff(joints, axis=0), axis=2).max(axis=1)
    stressed = np.array([one.start for one in speech.phonemes if one.stress == 1])
    strokes = [time for time, _ in animator.gestures.strokes]
    assert len(strokes) > 25
    for time in strokes:
        behind = time - stressed[stressed <= time]
        assert behind.min() < 0.09  # within the vowel's first half
        before = speed[max(int((time - 0.6) * 30), 0) : int((time - 0.1) * 30)].max()
        assert before > 0.1 and speed[int(np.ceil(time * 30))] < 0.5 * before + 0.1


def test_beats_are_on_stressed_vowels_apart_and_on_long_ones_where_nobody_says(minute):
    rng = np.random.default_rng(0)
    found = find_beats(minute[2], rng)
    times = np.array([one.time for one in found])
    assert np.diff(times).min() > MIN_BEAT_INTERVAL - 0.1 and sum(one.stroke for one in found) > 25
    guessed = find_beats(chatter(90.0, stress=False), rng)
    assert len(guessed) > 25
    assert find_beats(Speech((), 3.0), rng) == []


def test_hands_keep_clear_of_the_trunk_of_the_body_itself(minute):
    mesh = BODY.forward(REST).frame(0).vertices
    weights = BODY.weights
    hand, trunk = (
        weights[:, [k for k, n in enumerate(BODY.joint_names) if any(part in n for part in parts)]].sum(axis=1) > 0.6
        for parts in (("wrist", "index", "middle", "pinky"), ("pelvis", "spine", "hip"))
    )
    assert hand.sum() > 300 and trunk.sum() > 300 and len(mesh) == len(hand)
    for k in range(0, len(minute[1]), 61):
        v = BODY.forward(minute[1].frame(k)).frame(0).vertices
        some = v[hand][::7]
        apart = np.linalg.norm(some[:, None] - v[trunk][None, ::3], axis=2)
        assert apart.min() > 0.03


def test_nothing_is_seen_twice_within_a_minute(minute):
    animator, motion, _ = minute
    strokes = animator.gestures.strokes
    again = [b - a for k, (a, pair) in enumerate(strokes) for b, other in strokes[k + 1 :] if pair == other]
    assert min(again, default=np.inf) > 45.0
    arms = np.degrees(motion.body_pose.reshape(-1, 21, 3)[:, ARMS].reshape(len(motion), -1))
    windows = np.lib.stride_tricks.sliding_window_view(arms, 90, axis=0)[::5].reshape(-1, 12 * 90)
    moving = windows.reshape(len(windows), 12, 90).std(axis=2).max(axis=1) > 8.0
    some, at = windows[moving], 5 * np.flatnonzero(moving)
    squares = (some**2).mean(axis=1)  # |a - b|^2 = |a|^2 + |b|^2 - 2 a.b: all differences would be 800 MB
    apart = np.sqrt(np.maximum(squares[:, None] + squares[None] - 2 * some @ some.T / some.shape[1], 0.0))
    far = np.abs(at[:, None] - at[None]) >= 90
    assert far.any() and apart[far].min() > 2.0  # degrees; a clip that is played again has 0


def test_pieces_follow_each_other_without_a_jump(body):
    animator = SpeechAnimator(FACE, body, TalkConfig(seed=2))
    pieces = [animator.idle(1.3, listening=True), animator.talk(chatter(5.0), more=True)]
    pieces += [animator.talk(chatter(4.0, 1)), animator.idle(2.0), animator.talk(chatter(3.0, 2))]
    seconds = animator.seconds
    animator.rewind(seconds - 1.4)
    pieces[-1] = pieces[-1].select(slice(0, len(pieces[-1]) - 42))
    pieces += [animator.idle(3.0, listening=True)]
    motion = BodyParams.concatenate(pieces)
    assert animator.seconds * 30 == pytest.approx(len(motion))
    turns = matrix_from_rotvec(np.concatenate([motion.global_orient, motion.body_pose], 1).reshape(len(motion), 22, 3))
    speed = rotvec_from_matrix(np.swapaxes(turns[:-1], 2, 3) @ turns[1:]) * 30.0
    jerk = np.linalg.norm(np.diff(speed, axis=0), axis=2) * 30.0
    ends = np.cumsum([len(one) for one in pieces])[:-1]
    inside = np.setdiff1d(np.arange(len(jerk)), [e + d for e in ends for d in (-2, -1, 0)])
    assert jerk[[e + d for e in ends for d in (-2, -1)]].max() <= 1.1 * jerk[inside].max()
    assert np.linalg.norm(speed, axis=2).max() < np.radians(420)
    assert np.abs(np.diff(motion.jaw_pose[:, 0])).max() < 0.12


def test_pieces_are_the_same_as_one_of_their_length(body):
    one = idle_motion(4.0, FACE, body)
    animator = SpeechAnimator(FACE, body)
    parts = BodyParams.concatenate([animator.idle(1.0), animator.idle(0.5), animator.idle(2.5)])
    for name, value in one.as_dict().items():
        np.testing.assert_allclose(value, parts.as_dict()[name], atol=1e-12)


def test_a_seed_gives_one_motion_and_none_of_gestures_leaves_the_arms(body):
    speech = chatter(8.0)
    same = [talking_motion(speech, FACE, body, TalkConfig(seed=5)) for _ in range(2)]
    np.testing.assert_array_equal(same[0].body_pose, same[1].body_pose)
    other = talking_motion(speech, FACE, body, TalkConfig(seed=6))
    assert np.abs(other.body_pose - same[0].body_pose).max() > 0.3
    quiet = talking_motion(speech, FACE, body, TalkConfig(gestures=0.0))
    arms = quiet.body_pose.reshape(-1, 21, 3)[:, ARMS]
    assert np.ptp(arms, axis=0).max() < 1e-12
    half = talking_motion(speech, FACE, body, TalkConfig(seed=5, gestures=0.5))
    reach = [np.ptp(one.body_pose.reshape(-1, 21, 3)[:, ARMS], axis=0).max() for one in (half, same[0])]
    assert 0.3 * reach[1] < reach[0] < 0.75 * reach[1]


def test_somebody_who_waits_breathes_and_a_listener_nods(body):
    waits, listens = (idle_motion(20.0, FACE, body, listening=flag) for flag in (False, True))
    spine, head = (SMPLX_JOINTS.index(name) - 1 for name in ("spine3", "head"))
    for motion in (waits, listens):
        assert np.ptp(motion.body_pose.reshape(-1, 21, 3)[:, spine, 0]) > np.radians(0.5)
        assert motion.jaw_pose.max() < 1e-3
    nods = (listens.body_pose - waits.body_pose).reshape(-1, 21, 3)[:, head, 0]
    assert nods.max() > np.radians(1.5) and np.abs(nods[:6]).max() < np.radians(0.2)
    assert np.abs(listens.leye_pose[60:]).max() < 0.5 * np.abs(waits.leye_pose[60:]).max()


def test_arms_stay_near_what_training_saw():
    """Training saw a few arms: shapes are brought to within reach of one, and frames to within each joint's range."""
    known = np.stack(
        [
            bent(left_shoulder=(0, -6, -46), right_shoulder=(0, 6, 46), left_elbow=(0, -14, 0)),
            bent(left_shoulder=(10, -40, -52), right_shoulder=(10, 40, 52), left_elbow=(-20, -70, 10)),
            bent(left_shoulder=(16, -30, -46), right_shoulder=(16, 30, 46), right_elbow=(-14, 66, -6)),
        ]
    )
    body = StandingBody.of(SKELETON, replace(REST, body_pose=known[:1]), observed_poses=known)
    lexicon = GestureLexicon.of(body)
    turns = matrix_from_rotvec(pose_arms(body.standing, lexicon.states, lexicon.rest).body_pose.reshape(-1, 21, 3))
    seen = matrix_from_rotvec(known.reshape(-1, 21, 3))
    for joint in ARMS:
        apart = rotvec_from_matrix(np.swapaxes(seen[None, :, joint], 2, 3) @ turns[:, None, joint])
        assert np.linalg.norm(apart, axis=2).min(axis=1).max() <= MAX_DEVIATION + 1e-9
    motion = talking_motion(chatter(20.0), FACE, body)
    outside = PoseRange.of(known).outside(motion)
    upper = [k for k, name in enumerate(SMPLX_JOINTS[1:22]) if not any(n in name for n in ("hip", "knee", "ankle"))]
    assert not outside[:, upper].any()
    assert np.ptp(motion.body_pose.reshape(-1, 21, 3)[:, ARMS], axis=0).max() > np.radians(15)


def test_a_frame_in_which_a_foot_is_up_is_not_stood_in():
    poses = np.stack([bent(left_hip=(-40, 0, 0), left_knee=(60, 0, 0))] * 5 + [bent(left_shoulder=(0, 0, -20))])
    seen = replace(BodyParams.concatenate([REST] * 6), body_pose=poses)
    np.testing.assert_array_equal(StandingBody.of(SKELETON, seen).standing.body_pose[0], poses[5])


def test_a_skeleton_without_legs_is_refused():
    with pytest.raises(InputError, match="joints of a skeleton"):
        StandingBody.of(replace(SKELETON, names=tuple(f"bone{k}" for k in range(55))), REST)
    with pytest.raises(InputError, match="gestures"):
        SpeechAnimator(FACE, REST, TalkConfig(gestures=1.5))
    with pytest.raises(InputError, match="seconds"):
        SpeechAnimator(FACE, REST).idle(float("nan"))


# --- curves ---------------------------------------------------------------------------------------------------------


def test_a_track_goes_on_at_its_speed_and_comes_to_rest():
    track = Track(np.zeros(2))
    track.move(np.array([1.0, -2.0]), 1.0, 2.0)
    track.move(np.array([0.0, 3.0]), 1.4, 2.9)
    times = np.arange(0.0, 4.0, 1e-3)
    out = track(times)
    speed = np.diff(out, axis=0) / 1e-3
    assert np.abs(np.diff(speed, axis=0)).max() < 0.1  # accelerations stay below 100 a second squared
    np.testing.assert_allclose(out[times > 2.9][0], [0.0, 3.0], atol=1e-6)
    np.testing.assert_array_equal(out[times < 1.0], 0.0)
    assert np.abs(speed[(times[:-1] > 2.95)]).max() == 0.0
    np.testing.assert_allclose(track.target, [0.0, 3.0], atol=1e-9)


def test_wandering_is_the_same_however_it_is_asked():
    def make() -> RandomTrack:
        return RandomTrack(
            np.random.default_rng(3), lambda rng: rng.normal(size=1), np.zeros(1), moves=(0.5, 1.0), holds=(0.2, 0.4)
        )

    times = np.arange(0.0, 30.0, 0.1)
    whole, pieces = make()(times), make()
    parts = []
    for some in np.array_split(times, 7):
        parts.append(pieces(some))
        pieces.discard_before(float(some[0]))
    np.testing.assert_allclose(whole, np.concatenate(parts), atol=1e-12)
