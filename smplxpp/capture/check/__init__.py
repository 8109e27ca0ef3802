"""Find what would spoil a training: files, masks, parameters, and the calibration against the silhouettes."""

from smplxpp.capture.check.check import CaptureCheck, CheckConfig, check_capture
from smplxpp.capture.check.findings import Finding

__all__ = ["CaptureCheck", "CheckConfig", "Finding", "check_capture"]
