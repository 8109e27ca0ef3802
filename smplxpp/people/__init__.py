"""Procedural scans of clothed people with their truth: bodies, outfits, poses and colours of every kind."""

from smplxpp.people.access import people, person
from smplxpp.people.cast import CAST, OUTSIDERS
from smplxpp.people.person_scan import VARIANTS, PersonScan, variant

__all__ = ["CAST", "OUTSIDERS", "VARIANTS", "PersonScan", "people", "person", "variant"]
