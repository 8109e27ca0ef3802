"""Distances to a known truth: templates, bodies, labels, avatars, lips."""
