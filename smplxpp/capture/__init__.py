"""Captures on disk: cameras, and the reference frame that a template is built from."""

from smplxpp.capture.cameras import read_cameras
from smplxpp.capture.reference import ReferenceFrame, find_reference

__all__ = ["ReferenceFrame", "find_reference", "read_cameras"]
