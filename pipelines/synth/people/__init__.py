"""Procedural scans of clothed people with their truth: bodies, outfits, poses and colours of every kind."""

from pipelines.synth.people.access import people, person
from pipelines.synth.people.cast import CAST, OUTSIDERS
from pipelines.synth.people.person_scan import VARIANTS, PersonScan, variant

__all__ = ["CAST", "OUTSIDERS", "VARIANTS", "PersonScan", "people", "person", "variant"]
