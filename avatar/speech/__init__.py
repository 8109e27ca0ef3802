"""Speech to face, voice and gestures: phonemes in time, articulators, motion, and the engines that give phonemes.

The room needs no torch, and imports an engine only when it is used.
"""

from avatar.speech.coarticulation import ARTICULATORS, articulate
from avatar.speech.face import Face
from avatar.speech.phonemes import SILENCE, Phoneme, Speech, Word
from avatar.speech.speech_animation import SpeechAnimator, TalkConfig, idle_motion, talking_motion
from avatar.speech.standing_body import StandingBody

__all__ = [
    "ARTICULATORS",
    "SILENCE",
    "Face",
    "Phoneme",
    "Speech",
    "SpeechAnimator",
    "StandingBody",
    "TalkConfig",
    "Word",
    "articulate",
    "idle_motion",
    "talking_motion",
]
