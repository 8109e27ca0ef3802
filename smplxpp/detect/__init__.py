"""Detect people in images: named keypoints and masks, by MediaPipe (extra `[detect]`), ONNX models or empty plates."""

from pathlib import Path

from smplxpp.core.errors import InputError
from smplxpp.detect.detector import Box, DetectedPerson, Detector, mask_box
from smplxpp.detect.mediapipe_detector import MediaPipeDetector
from smplxpp.detect.onnx_detector import OnnxDetector

__all__ = ["MEDIAPIPE", "Box", "DetectedPerson", "Detector", "load_detector", "mask_box"]

MEDIAPIPE = "mediapipe"
"""Name of MediaPipe's detector."""


def load_detector(name: str | Path = MEDIAPIPE) -> Detector:
    """Load MediaPipe's detector, or the ONNX model at a path.

    Raises:
        MissingExtraError: a package that it needs is not installed.
        InputError: another name, or a model that cannot be used.
    """
    if str(name) == MEDIAPIPE:
        return MediaPipeDetector()
    if Path(name).suffix.lower() == ".onnx":
        return OnnxDetector(name)
    raise InputError("detector", expected=f"{MEDIAPIPE}, or the path of a model.onnx", received=str(name))
