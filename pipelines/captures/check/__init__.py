"""Whether a capture can be trained on: files, masks, parameters, and the calibration against the silhouettes."""

from pipelines.captures.check.check import CaptureCheck, CheckConfig, check_capture
from pipelines.captures.check.findings import Finding
from pipelines.captures.check.report import write_check_report

__all__ = ["CaptureCheck", "CheckConfig", "Finding", "check_capture", "write_check_report"]
