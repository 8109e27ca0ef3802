"""Inputs that drive an avatar: its person's face and stance, and the sound and phonemes of speech; without torch."""

from avatar.driving.person import Heard, face_of_bundle, hear, person_of_bundle, person_of_template, rows_of, stance_of

__all__ = ["Heard", "face_of_bundle", "hear", "person_of_bundle", "person_of_template", "rows_of", "stance_of"]
