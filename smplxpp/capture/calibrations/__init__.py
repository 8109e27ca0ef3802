"""Read the calibration files of laboratories' tools and of data sets into cameras of this package's conventions."""

from smplxpp.capture.calibrations.table import (
    FORMATS,
    Calibration,
    CalibrationFormat,
    find_calibration,
    format_of,
    read_calibration,
)

__all__ = ["FORMATS", "Calibration", "CalibrationFormat", "find_calibration", "format_of", "read_calibration"]
