"""Procedural scans of clothed people with their truth: bodies, outfits, stances and colours of every kind."""

from benchmarks.people.access import people, person
from benchmarks.people.captured import captured, captured_names
from benchmarks.people.cast import CAST
from benchmarks.people.person_scan import PersonScan
from benchmarks.people.variants import VARIANTS, variant

__all__ = ["CAST", "VARIANTS", "PersonScan", "captured", "captured_names", "people", "person", "variant"]
