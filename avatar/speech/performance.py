"""Somebody who stands, listens and talks: body parameters piece by piece, or of one speech."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float64

from avatar.speech.carriage import Carriage
from avatar.speech.coarticulation import Timing, articulate
from avatar.speech.curves import Curves
from avatar.speech.face import Face
from avatar.speech.gesturing import Gesturing
from avatar.speech.liveliness import blinks, glances, head_motion, nods
from avatar.speech.phonemes import Phoneme, Speech
from avatar.speech.stance import Stance
from avatar.speech.tracks import Track
from smplxpp.core.params import DEFAULT_FPS, BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.validation import require_at_least, require_between, require_positive

_NECK, _HEAD = 3 * 11, 3 * 14  # in the body's pose, which leaves out the root
_LONGEST = 1800.0  # seconds
_MARK = np.radians(2.2)  # of head and neck together on a strong beat
_QUIET = 0.45  # of the trunk's motion, of somebody who does not talk
_WAIT = 0.15  # seconds until hands are taken back
_REMEMBERED = 2.0  # seconds of what was said that the mouth may still come from


@dataclass(frozen=True, kw_only=True)
class TalkConfig:
    """Options of `Performer`, `talking_motion` and `idle_motion`.

    Attributes:
        fps: frames a second. seed: of everything that is drawn.
        strength: of the mouth, 1 as designed. lively: of head, glances, breath and weight, 0 for none.
        gestures: of arms and hands, 0 (none) to 1.
        tail: seconds of silence behind the sound. timing: of the articulators.

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
        """Refuse what is out of range."""
        require_positive("frames a second", self.fps)
        require_between("strength", self.strength, 0.0, 2.0)
        require_between("liveliness", self.lively, 0.0, 2.0)
        require_between("gestures", self.gestures, 0.0, 1.0)
        require_at_least("seed", self.seed, 0)


class Performer:
    """One person through time: every call goes on where the last one ended, without a jump.

    Args:
        face: how it speaks. body: a `Stance`, which gestures and shifts its weight; or one frame that stands still.

    Raises:
        InputError: options out of range, or no frame.

    Example:
        performer = Performer(face, stance)
        motion = [performer.idle(2.0, listening=True), performer.talk(speech), performer.idle(1.0)]
    """

    def __init__(self, face: Face, body: Stance | BodyParams, config: TalkConfig | None = None) -> None:
        self.config = config or TalkConfig()
        self.config.check()
        self._face = face
        seed = self.config.seed
        self.gesturing: Gesturing | None = None
        self._carriage: Carriage | None = None
        self._stance = body if isinstance(body, Stance) else None
        if isinstance(body, Stance):
            self._still = body.still
            self.gesturing = Gesturing(body, size=self.config.gestures, seed=seed)
            self._carriage = Carriage(body, size=self.config.lively, seed=seed)
        else:
            require_at_least("frames that stand still", len(body), 1)
            self._still = body.frame(0)
        self._made = 0
        self._said: list[Phoneme] = []
        self._curves: tuple[float, Curves] | None = None  # and when they began
        self._activity = Track(np.array([_QUIET, 0.0]))  # of the trunk; of somebody who listens

    @property
    def seconds(self) -> float:
        """How much was made, seconds: when the next frame is."""
        return self._made / self.config.fps

    def talk(self, speech: Speech, *, more: bool = False, curves: Curves | None = None) -> BodyParams:
        """Return the frames in which a speech is said, the first at its beginning.

        Args:
            more: another speech follows at once, so that hands stay up; else they come down, in the next frames too.
            curves: of the face, in the place of those that are made of the phonemes.

        Raises:
            InputError: more than half an hour, or curves that the body does not have.
        """
        require_between("seconds of speech", speech.seconds, 0.0, _LONGEST)
        start = self.seconds
        if curves is not None:
            self._of_curves(curves, np.zeros(1))
        self._curves = None if curves is None else (start, curves)
        self._said = [one for one in self._said if start - _REMEMBERED < one.end and one.start < start]
        self._said += [replace(one, start=one.start + start, end=one.end + start) for one in speech.phonemes]
        self._be(1.0, 0.0)
        if self.gesturing is not None:
            self.gesturing.plan(speech, start, more=more)
        return self._frames(int(np.ceil(speech.seconds * self.config.fps - 1e-9)))

    def idle(self, seconds: float, *, listening: bool = False) -> BodyParams:
        """Return frames of somebody who waits, or listens: then the eyes stay with the viewer, and the head nods.

        Raises:
            InputError: more than half an hour.
        """
        require_between("seconds", seconds, 0.0, _LONGEST)
        self._be(_QUIET, float(listening))
        if self.gesturing is not None and not self.gesturing.resting:
            self.gesturing.rest(self.seconds + _WAIT)
        return self._frames(int(np.ceil(seconds * self.config.fps - 1e-9)))

    def cut(self, seconds: float) -> None:
        """Go back to a time: what was made for later was not shown, as when somebody is interrupted."""
        self._made = int(np.clip(round(seconds * self.config.fps), 0, self._made))
        if self.gesturing is not None:
            self.gesturing.drop(self.seconds)
        self._activity.drop(self.seconds)
        self._said = [
            replace(one, end=min(one.end, self.seconds)) for one in self._said if one.start < self.seconds - 1e-6
        ]

    def _be(self, trunk: float, listens: float) -> None:
        target = np.array([trunk, listens])
        if np.abs(self._activity.target - target).max() > 0.0:
            self._activity.move(target, self.seconds, self.seconds + 0.8)
        self._activity.forget(self.seconds - 60.0)

    def _frames(self, count: int) -> BodyParams:
        """The next frames."""
        times = (self._made + np.arange(count)) / self.config.fps
        if not count:
            return replace(self._still.select(slice(0)), fps=self.config.fps)
        self._made += count
        frames = self._still.select(np.zeros(count, dtype=np.int64))
        mark, trunk = np.zeros(count), np.zeros((count, 3))
        trunk_size, listens = self._activity(times).T
        if self.gesturing is not None and self._carriage is not None:
            frames, mark = self.gesturing.at(self._still, times)
            frames, trunk = self._carriage.at(frames, times, trunk_size)
        # Streams of their own: a longer speech does not change its beginning.
        eyelids, eyes, head, yes = (np.random.default_rng((self.config.seed, k)) for k in range(4))
        look = self.config.lively * glances(times, eyes) * (1.0 - 0.7 * listens)[:, None]
        turn = self.config.lively * (head_motion(times, head) - 0.4 * trunk)
        down = _MARK * mark + self.config.lively * nods(times, yes) * listens
        turn[:, 0] += down
        pose = np.array(frames.body_pose)
        for begin in (_NECK, _HEAD):
            here = slice(begin, begin + 3)
            pose[:, here] = rotvec_from_matrix(matrix_from_rotvec(pose[:, here]) @ matrix_from_rotvec(0.5 * turn))
        expression, jaw = self._mouth(times, blinks(times, eyelids))
        frames = replace(frames, body_pose=pose)
        if self._stance is not None:
            frames = self._stance.within(frames)
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
        """Expressions and jaw, of what is being said and what was said before it."""
        if self._curves is not None:
            start, curves = self._curves
            expression, jaw = self._of_curves(curves, times - start)
            lids = closed_eyes[:, None] * self._face.blink * (not curves.blinks)
            return np.clip(expression + lids, self._face.lowest, self._face.highest), jaw
        first = min((one.start for one in self._said), default=0.0)
        said = tuple(replace(one, start=one.start - first, end=one.end - first) for one in self._said)
        seconds = max([times[-1] - first, *(one.end for one in said)])
        mouth = articulate(Speech(said, seconds), times - first, self.config.timing)
        return self._face.pose(mouth, closed_eyes, strength=self.config.strength)

    def _of_curves(
        self, curves: Curves, times: Float64[np.ndarray, " T"]
    ) -> tuple[Float64[np.ndarray, "T E"], Float64[np.ndarray, "T 3"]]:
        values, jaw = curves.at(times)
        if curves.jaw is None:
            return self._face.pose_arkit(values, strength=self.config.strength)
        return self._face.pose_flame(values, jaw, strength=self.config.strength)


def talking_motion(
    speech: Speech,
    face: Face,
    body: Stance | BodyParams,
    config: TalkConfig | None = None,
    *,
    curves: Curves | None = None,
) -> BodyParams:
    """Return somebody who says one speech, and is silent for `tail` seconds behind it.

    Args:
        body: a `Stance`, which gestures; or one frame in which the body stands still.
        curves: of the face, in the place of those that are made of the phonemes.

    Raises:
        InputError: options out of range, no frame, curves that the body does not have, or more than half an hour.
    """
    performer = Performer(face, body, config)
    said = performer.talk(speech, curves=curves)
    rest = performer.idle(max(performer.config.tail + speech.seconds - performer.seconds, 0.0))
    # A last frame, so that the motion lasts as long as the sound and its tail.
    return BodyParams.concatenate([said, rest, performer.idle(1.0 / performer.config.fps)])


def idle_motion(
    seconds: float,
    face: Face,
    body: Stance | BodyParams,
    config: TalkConfig | None = None,
    *,
    listening: bool = False,
) -> BodyParams:
    """Return somebody who waits for so many seconds, or listens.

    Raises:
        InputError: options out of range, no frame, or more than half an hour.
    """
    return Performer(face, body, config).idle(seconds, listening=listening)
