"""Procedural garments and hair on the open body, with skinning weights that follow from stated rules."""
