"""Speech to an avatar's face, voice and gestures: phonemes in time, mouth shapes, motion; engines that give phonemes.

No torch, and no engine is imported before it is asked for.
"""

from avatar.speech.coarticulation import ARTICULATORS, articulate
from avatar.speech.face import Face
from avatar.speech.performance import Performer, TalkConfig, idle_motion, talking_motion
from avatar.speech.phonemes import SILENCE, Phoneme, Speech
from avatar.speech.stance import Stance

__all__ = [
    "ARTICULATORS",
    "SILENCE",
    "Face",
    "Performer",
    "Phoneme",
    "Speech",
    "Stance",
    "TalkConfig",
    "articulate",
    "idle_motion",
    "talking_motion",
]
