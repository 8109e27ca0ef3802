"""Procedural scans of clothed people with their truth: bodies, outfits, poses and colours of every kind."""

from pipelines.synth.people.access import people, person
from pipelines.synth.people.cast import CAST
from pipelines.synth.people.person_scan import VARIANTS, PersonScan, variant

__all__ = ["CAST", "VARIANTS", "PersonScan", "people", "person", "variant"]
