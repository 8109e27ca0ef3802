"""Speech in, a motion of body parameters out: the face speaks and lives, the body stands."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from avatar.speech.coarticulation import Timing, articulate
from avatar.speech.face import Face
from avatar.speech.liveliness import blinks, glances, head_motion
from avatar.speech.phonemes import Speech
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.validation import require_at_least, require_between, require_positive

_NECK, _HEAD = 3 * 11, 3 * 14  # in the body's pose, which leaves out the root
_LONGEST = 1800.0  # seconds


@dataclass(frozen=True, kw_only=True)
class TalkConfig:
    """Options of `talking_motion`.

    Attributes:
        fps: frames a second. seed: of blinks, glances and the head.
        strength: of the mouth, 1 as designed. lively: of the head's motion and the glances, 0 for none.
        tail: seconds of silence behind the sound. timing: of the articulators.
    """

    fps: float = 30.0
    seed: int = 0
    strength: float = 1.0
    lively: float = 1.0
    tail: float = 0.4
    timing: Timing = field(default_factory=Timing)


def talking_motion(speech: Speech, face: Face, still: BodyParams, config: TalkConfig | None = None) -> BodyParams:
    """Return somebody who stands as in one frame and speaks.

    Args:
        still: one frame: where and how the body stands, and its shape.

    Raises:
        InputError: options out of range, more than one frame, or more than half an hour.
    """
    config = config or TalkConfig()
    require_positive("frames a second", config.fps)
    require_between("strength", config.strength, 0.0, 2.0)
    require_between("liveliness", config.lively, 0.0, 2.0)
    require_between("seconds of speech", speech.seconds, 0.0, _LONGEST)
    require_at_least("frames that stand still", len(still), 1)
    still = still.frame(0)
    times = np.arange(int(np.ceil((speech.seconds + config.tail) * config.fps)) + 1) / config.fps
    # Streams of their own: a longer speech does not change its beginning.
    eyelids, eyes, head = (np.random.default_rng((config.seed, k)) for k in range(3))
    curves = articulate(speech, times, config.timing)
    expression, jaw = face.pose(curves, blinks(times, eyelids), strength=config.strength)
    look = config.lively * glances(times, eyes)
    turn = config.lively * head_motion(times, head)
    whole = still.select(np.zeros(len(times), dtype=np.int64))
    pose = np.array(whole.body_pose)
    for begin in (_NECK, _HEAD):
        here = slice(begin, begin + 3)
        pose[:, here] = rotvec_from_matrix(matrix_from_rotvec(pose[:, here]) @ matrix_from_rotvec(0.5 * turn))
    return replace(
        whole,
        body_pose=pose,
        expression=expression,
        jaw_pose=jaw,
        leye_pose=whole.leye_pose + look,
        reye_pose=whole.reye_pose + look,
        fps=config.fps,
    )
