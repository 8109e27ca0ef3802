"""Gates of the numbers that several stages of a training measure, each defined once.

Those of a build are in `smplxpp.build.limits`.
"""

from __future__ import annotations

from collections.abc import Mapping

from smplxpp.build import limits
from smplxpp.core.checks import Gate

SILHOUETTE = limits.SILHOUETTE
DRIFT = Gate("mm", 15.0, 60.0, higher_is_better=False)
"""Round-trip drift of the tracked clothes, from the last frames back to the first. A jump of one pattern period is
a few centimetres."""
PSNR: Mapping[str, Gate] = {"novel_view": Gate("dB", 18.0, 16.0), "novel_pose": Gate("dB", 17.0, 15.0)}
"""PSNR over the person by kind of view; training views of a capture without held-out cameras count as novel views.

These are lower bounds below which something is broken. They do not grade a training, because decibels depend on the
size of the image, on its share of fine patterns and on the distance of the nearest training camera. The gates on gains
(over a stage's start, its teacher, or the Gaussians of one frame) grade it.
"""
SSIM = Gate("", 0.9, 0.75)
GAIN = Gate("dB", 0.0, -1.0)
"""PSNR gained since the start of a training, or over the Gaussians of one frame."""
AGAINST_TEACHER = Gate("dB", -0.3, -2.0)
"""PSNR of a student minus that of its teacher."""
LOST_BY_COMPRESSION = Gate("dB", 0.3, 2.0, higher_is_better=False)
"""PSNR of a student minus that of its compact file."""
AGAINST_SKINNING = Gate("x", 1.0, 1.5, higher_is_better=False)
"""P2S of a garment, as a share of that of the template that follows its joints."""
REFINED = Gate("", 0.95, 0.5)
"""Share of the frames whose refined poses fit their photographs better."""
REFINED_LOSS = Gate("x", 1.0, 1.2, higher_is_better=False)
"""Loss of the photographs with refined poses, as a share of that with the poses before."""
ITERATIONS = Gate("", 1.0, 0.0)
"""Share of a training's iterations that were done."""
