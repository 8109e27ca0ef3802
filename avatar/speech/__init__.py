"""Speech to the face and voice of an avatar: phonemes in time, mouth shapes, motion; engines that give phonemes.

No torch, and no engine is imported before it is asked for.
"""

from avatar.speech.coarticulation import ARTICULATORS, articulate
from avatar.speech.face import Face
from avatar.speech.performance import TalkConfig, talking_motion
from avatar.speech.phonemes import SILENCE, Phoneme, Speech

__all__ = [
    "ARTICULATORS",
    "SILENCE",
    "Face",
    "Phoneme",
    "Speech",
    "TalkConfig",
    "articulate",
    "talking_motion",
]
