"""Gates of what several stages measure: one number each, wherever it is held against them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from pipelines.runs.checks import Check


@dataclass(frozen=True)
class Gate:
    """Bounds of a measured number.

    Attributes:
        unit: of number and bounds.
        warn, fail: the number passes up to `warn` (from `warn` on where higher is better) and fails beyond `fail`.
        higher_is_better: the bounds are lower ones.
    """

    unit: str
    warn: float
    fail: float
    higher_is_better: bool = True

    def check(self, name: str, value: float, *, explanation: str = "") -> Check:
        """A number held against the gate."""
        return Check(name, value, self.unit, self.warn, self.fail, self.higher_is_better, explanation)


SILHOUETTE = Gate("IoU", 0.95, 0.8)
"""The skinned template on the masks."""
PSNR: Mapping[str, Gate] = {"novel_view": Gate("dB", 18.0, 16.0), "novel_pose": Gate("dB", 17.0, 15.0)}
"""PSNR over the person by kind of view; training views of a capture without held-out cameras count as novel views.

A floor, not a mark: decibels fall with the size of the image, with the share of it that is fine pattern and with the
distance of the nearest camera that was trained on, so that one number cannot tell a good training of minutes at 256x320
from a poor one of hours. Below it something is broken. What a stage is worth is for the gates on its gain: over its
start, over its teacher, over the Gaussians of one frame.
"""
SSIM = Gate("", 0.9, 0.75)
GAIN = Gate("dB", 0.0, -1.0)
"""PSNR gained since the start of a training, or over the Gaussians of one frame."""
AGAINST_TEACHER = Gate("dB", -0.3, -2.0)
"""PSNR of a student less that of its teacher."""
LOST_BY_COMPRESSION = Gate("dB", 0.3, 2.0, higher_is_better=False)
"""PSNR of a student less that of its compact file."""
AGAINST_SKINNING = Gate("x", 1.0, 1.5, higher_is_better=False)
"""P2S of a garment, as a share of that of the template that follows its joints."""
REFINED = Gate("", 0.95, 0.5)
"""Share of the frames whose refined poses fit their photographs better."""
REFINED_LOSS = Gate("x", 1.0, 1.2, higher_is_better=False)
"""Loss of the photographs with refined poses, as a share of that with the poses before."""
ITERATIONS = Gate("", 1.0, 0.0)
"""Share of a training's iterations that were done."""
