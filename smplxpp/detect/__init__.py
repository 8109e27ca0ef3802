"""Detect people in images: named keypoints and masks, by MediaPipe (extra `[detect]`), ONNX models or empty plates."""

from smplxpp.detect.detector import Box, DetectedPerson, Detector, mask_box
from smplxpp.detect.load import load_detector

__all__ = ["Box", "DetectedPerson", "Detector", "load_detector", "mask_box"]
