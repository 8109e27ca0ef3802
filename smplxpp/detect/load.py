"""A detector by the name that a user gives."""

from __future__ import annotations

from pathlib import Path

from smplxpp.core.errors import InputError
from smplxpp.detect.detector import Detector
from smplxpp.detect.mediapipe_detector import MediaPipeDetector
from smplxpp.detect.onnx_detector import OnnxDetector

MEDIAPIPE = "mediapipe"


def load_detector(name: str | Path = MEDIAPIPE) -> Detector:
    """MediaPipe, or the ONNX model of a path.

    Raises:
        MissingExtraError: what it needs is not installed.
        InputError: neither, or a model that cannot be used.
    """
    if str(name) == MEDIAPIPE:
        return MediaPipeDetector()
    if Path(name).suffix.lower() == ".onnx":
        return OnnxDetector(name)
    raise InputError("detector", expected=f"{MEDIAPIPE}, or the path of a model.onnx", received=str(name))
