"""Garments made by procedure on the open body, each with weights that a stated rule gives it."""
