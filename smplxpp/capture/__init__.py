"""Open captures of all data sets as one type, and find the reference frame that a template is built from."""

from smplxpp.capture.cameras import read_cameras
from smplxpp.capture.capture import Capture
from smplxpp.capture.masks import MattingConfig, MattingModel, write_mattes
from smplxpp.capture.problems import find_problems
from smplxpp.capture.recording import Problem, Splits
from smplxpp.capture.reference import ReferenceFrame, find_reference, find_scans, scans_in
from smplxpp.capture.registry import FORMATS, detect_format, open_capture

__all__ = [
    "FORMATS",
    "Capture",
    "MattingConfig",
    "MattingModel",
    "Problem",
    "ReferenceFrame",
    "Splits",
    "detect_format",
    "find_problems",
    "find_reference",
    "find_scans",
    "open_capture",
    "read_cameras",
    "scans_in",
    "write_mattes",
]
