"""Animate a standing person who talks, listens or waits: body parameters piece by piece, or of one speech."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64

from avatar.speech.coarticulation import Timing, articulate
from avatar.speech.curves import MAX_SECONDS, Curves
from avatar.speech.face import Face
from avatar.speech.gesture_planner import GesturePlanner
from avatar.speech.phonemes import Phoneme, Speech
from avatar.speech.secondary_motion import PosturalSway, blinks, gaze, head_motion, nods
from avatar.speech.standing_body import StandingBody
from avatar.speech.tracks import Track
from smplxpp.core import matrix_from_rotvec, require_at_least, require_between, require_positive, rotvec_from_matrix
from smplxpp.core.params import DEFAULT_FPS, BodyParams

_IDLE_TRUNK = 0.45
"""Factor of the trunk's motion while the person does not talk; 1 while talking. Set by eye."""


@dataclass(frozen=True, kw_only=True)
class TalkConfig:
    """Options of `SpeechAnimator`, `talking_motion` and `idle_motion`.

    Attributes:
        fps: frames a second.
        seed: of all random draws.
        strength: of the mouth, 1 as designed.
        lively: size of head motion, gaze, breathing and postural sway, 0 for none.
        gestures: size of arm gestures, 0 (none) to 1.
        tail: seconds of silence after the sound.
        timing: of the articulators.

    Raises:
        InputError: options out of range.
    """

    fps: float = DEFAULT_FPS
    seed: int = 0
    strength: float = 1.0
    lively: float = 1.0
    gestures: float = 1.0
    tail: float = 0.4
    timing: Timing = field(default_factory=Timing)

    def check(self) -> None:
        """Raise InputError for an option out of range."""
        require_positive("frames a second", self.fps)
        require_between("strength", self.strength, 0.0, 2.0)
        require_between("liveliness", self.lively, 0.0, 2.0)
        require_between("gestures", self.gestures, 0.0, 1.0)
        require_at_least("seed", self.seed, 0)


class SpeechAnimator:
    """One person through time: every call continues smoothly where the last one ended.

    Args:
        face: the face of the person.
        body: a `StandingBody`, which gestures and sways; or one frame that stays as it is.
        config: options.

    Raises:
        InputError: options out of range, or no frame.

    Example:
        animator = SpeechAnimator(face, body)
        motion = [animator.idle(2.0, listening=True), animator.talk(speech), animator.idle(1.0)]
    """

    def __init__(self, face: Face, body: StandingBody | BodyParams, config: TalkConfig | None = None) -> None:
        self.config = config or TalkConfig()
        self.config.check()
        self._face = face
        seed = self.config.seed
        self.gestures: GesturePlanner | None = None
        self._sway: PosturalSway | None = None
        self._body = body if isinstance(body, StandingBody) else None
        # A standing body gestures and sways; a single frame moves its face, head and eyes alone.
        if isinstance(body, StandingBody):
            self._standing = body.standing
            self.gestures = GesturePlanner(body, size=self.config.gestures, seed=seed)
            self._sway = PosturalSway(body, size=self.config.lively, seed=seed)
        else:
            require_at_least("frames that stand still", len(body), 1)
            self._standing = body.frame(0)
        self._made = 0
        self._phonemes: list[Phoneme] = []
        self._curves: tuple[float, Curves] | None = None  # with the time at which they begin
        self._activity = Track(np.array([_IDLE_TRUNK, 0.0]))  # factor of the trunk's motion; listening, 0 to 1

    @property
    def seconds(self) -> float:
        """The length of the motion made so far, seconds: the time of the next frame."""
        return self._made / self.config.fps

    def talk(self, speech: Speech, *, more: bool = False, curves: Curves | None = None) -> BodyParams:
        """Return the frames of a speech; the first is at its beginning.

        Args:
            speech: phonemes in time.
            more: another speech follows at once, so that hands stay up; else they are retracted.
            curves: of the face; they replace those made from the phonemes.

        Raises:
            InputError: more than half an hour, or curves that the body does not have.
        """
        require_between("seconds of speech", speech.seconds, 0.0, MAX_SECONDS)
        start = self.seconds
        if curves is not None:
            self._face_of_curves(curves, np.zeros(1))
        self._curves = None if curves is None else (start, curves)
        # Phonemes of the last two seconds still shape the mouth by coarticulation.
        self._phonemes = [one for one in self._phonemes if start - 2.0 < one.end and one.start < start]
        self._phonemes += [replace(one, start=one.start + start, end=one.end + start) for one in speech.phonemes]
        self._set_activity(1.0, 0.0)
        if self.gestures is not None:
            self.gestures.plan(speech, start, more=more)
        return self._frames(int(np.ceil(speech.seconds * self.config.fps - 1e-9)))

    def idle(self, seconds: float, *, listening: bool = False) -> BodyParams:
        """Return frames of waiting, or of listening: then the gaze stays with the viewer, and the head nods.

        Raises:
            InputError: more than half an hour.
        """
        require_between("seconds", seconds, 0.0, MAX_SECONDS)
        self._set_activity(_IDLE_TRUNK, float(listening))
        if self.gestures is not None and not self.gestures.resting:
            self.gestures.retract(self.seconds + 0.15)
        return self._frames(int(np.ceil(seconds * self.config.fps - 1e-9)))

    def rewind(self, seconds: float) -> None:
        """Return to a time and discard what was made for later, as when the person is interrupted."""
        # Time is counted in whole frames, so that pieces join without gaps whatever their lengths.
        self._made = int(np.clip(round(seconds * self.config.fps), 0, self._made))
        if self.gestures is not None:
            self.gestures.discard_from(self.seconds)
        self._activity.discard_from(self.seconds)
        self._phonemes = [
            replace(one, end=min(one.end, self.seconds)) for one in self._phonemes if one.start < self.seconds - 1e-6
        ]

    def _set_activity(self, trunk: float, listening: float) -> None:
        """Move to another activity within 0.8 seconds."""
        target = np.array([trunk, listening])
        if np.abs(self._activity.target - target).max() > 0.0:
            self._activity.move(target, self.seconds, self.seconds + 0.8)
        self._activity.discard_before(self.seconds - 60.0)

    def _frames(self, count: int) -> BodyParams:
        """Make the next frames, `count` of them, and move the time on."""
        times = (self._made + np.arange(count)) / self.config.fps
        if not count:
            return replace(self._standing.select(slice(0)), fps=self.config.fps)
        self._made += count
        frames = self._standing.select(np.zeros(count, dtype=np.int64))
        beat, trunk = np.zeros(count), np.zeros((count, 3))
        trunk_size, listening = self._activity(times).T
        # Arms first, then the trunk above planted feet.
        if self.gestures is not None and self._sway is not None:
            frames, beat = self.gestures.at(self._standing, times)
            frames, trunk = self._sway.at(frames, times, trunk_size)
        # Each kind of motion has its own random stream, so that a longer speech does not change its beginning.
        eyelids, eyes, head, nodding = (np.random.default_rng((self.config.seed, k)) for k in range(4))
        look = self.config.lively * gaze(times, eyes) * (1.0 - 0.7 * listening)[:, None]
        turn = self.config.lively * (head_motion(times, head) - 0.4 * trunk)
        # Beats lower the head by up to 2.2 degrees, and a listener nods.
        down = np.radians(2.2) * beat + self.config.lively * nods(times, nodding) * listening
        turn[:, 0] += down
        pose = np.array(frames.body_pose)
        # Neck and head share the rotation; `body_pose` leaves out the root, joint 0.
        for begin in (3 * 11, 3 * 14):
            here = slice(begin, begin + 3)
            pose[:, here] = rotvec_from_matrix(matrix_from_rotvec(pose[:, here]) @ matrix_from_rotvec(0.5 * turn))
        expression, jaw = self._mouth(times, blinks(times, eyelids))
        frames = replace(frames, body_pose=pose)
        if self._body is not None:
            frames = self._body.clamp_to_observed(frames)
        return replace(
            frames,
            expression=expression,
            jaw_pose=jaw,
            leye_pose=frames.leye_pose + look,
            reye_pose=frames.reye_pose + look,
            fps=self.config.fps,
        )

    def _mouth(
        self, times: Float64[np.ndarray, " T"], closed_eyes: Float64[np.ndarray, " T"]
    ) -> tuple[Float64[np.ndarray, "T E"], Float64[np.ndarray, "T 3"]]:
        """Return expressions and jaw, from the curves or the phonemes before and at the times."""
        if self._curves is not None:
            # Curves with blinks of their own keep them; others get the random ones.
            start, curves = self._curves
            expression, jaw = self._face_of_curves(curves, times - start)
            lids = closed_eyes[:, None] * self._face.blink * (not curves.blinks)
            return np.clip(expression + lids, self._face.lowest, self._face.highest), jaw
        # `articulate` wants phonemes from 0 on: shift phonemes and times to the first one that still matters.
        first = min((one.start for one in self._phonemes), default=0.0)
        phonemes = tuple(replace(one, start=one.start - first, end=one.end - first) for one in self._phonemes)
        seconds = max([times[-1] - first, *(one.end for one in phonemes)])
        mouth = articulate(Speech(phonemes, seconds), times - first, self.config.timing)
        return self._face.pose(mouth, closed_eyes, strength=self.config.strength)

    def _face_of_curves(
        self, curves: Curves, times: Float64[np.ndarray, " T"]
    ) -> tuple[Float64[np.ndarray, "T E"], Float64[np.ndarray, "T 3"]]:
        values, jaw = curves.at(times)
        if curves.jaw is None:
            return self._face.pose_arkit(values, strength=self.config.strength)
        return self._face.pose_flame(values, jaw, strength=self.config.strength)


def talking_motion(
    speech: Speech,
    face: Face,
    body: StandingBody | BodyParams,
    config: TalkConfig | None = None,
    *,
    curves: Curves | None = None,
) -> BodyParams:
    """Return the motion of a person who speaks once, then is silent for `tail` seconds.

    Args:
        speech: phonemes in time.
        face: the face of the person.
        body: a `StandingBody`, which gestures; or one frame in which the body stands still.
        config: options.
        curves: of the face; they replace those made from the phonemes.

    Raises:
        InputError: options out of range, no frame, curves that the body does not have, or more than half an hour.
    """
    animator = SpeechAnimator(face, body, config)
    talking = animator.talk(speech, curves=curves)
    rest = animator.idle(max(animator.config.tail + speech.seconds - animator.seconds, 0.0))
    # A last frame, so that the motion lasts as long as the sound and its tail.
    return BodyParams.concatenate([talking, rest, animator.idle(1.0 / animator.config.fps)])


def idle_motion(
    seconds: float,
    face: Face,
    body: StandingBody | BodyParams,
    config: TalkConfig | None = None,
    *,
    listening: bool = False,
) -> BodyParams:
    """Return the motion of a person who waits, or listens, for some seconds.

    Raises:
        InputError: options out of range, no frame, or more than half an hour.
    """
    return SpeechAnimator(face, body, config).idle(seconds, listening=listening)
