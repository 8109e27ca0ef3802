"""Captures: reports of their checks, conversion, and keypoints and masks of their images."""
