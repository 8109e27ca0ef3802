"""Losses that the trainer minimises, and the image metrics it reports."""
