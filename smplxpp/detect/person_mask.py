"""Masks by MediaPipe with the weights inside its wheel: rough, for photographs without anything better."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8

from smplxpp.detect.mediapipe_detector import mediapipe_package, quiet, silent_start
from smplxpp.detect.plates import cleaned


class PersonSegmenter:
    """The matte that MediaPipe's pose model gives of whom it finds, or else its selfie segmentation.

    The pose's is of a square about the person and the better one of people who stand; the selfie's is of the whole
    image, for close-ups in which no pose is found. Both have 256 pixels a side at most.

    Raises:
        MissingExtraError: mediapipe is not installed.
        InputError: a mediapipe without weights.
    """

    def __init__(self) -> None:
        package = mediapipe_package("segmentation of people")
        solutions = package.solutions
        with quiet(), silent_start():
            self._pose = solutions.pose.Pose(static_image_mode=True, model_complexity=1, enable_segmentation=True)
            self._selfie = solutions.selfie_segmentation.SelfieSegmentation(model_selection=0)
            for graph in (self._pose, self._selfie):
                graph.process(np.zeros((16, 16, 3), dtype=np.uint8))
        self.identity = f"mediapipe {package.__version__} segmentation"

    def __call__(self, image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
        """The opacity of the person in an sRGB image; 0 where nobody is."""
        image = np.ascontiguousarray(image)
        with quiet():
            matte = self._pose.process(image).segmentation_mask
            if matte is None:
                matte = self._selfie.process(image).segmentation_mask
        matte = np.asarray(matte, dtype=np.float32)
        matte = matte * cleaned(matte > 0.5)
        return np.round(255.0 * np.clip(matte, 0.0, 1.0)).astype(np.uint8)
