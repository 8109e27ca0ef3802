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
SEAM = Gate("mm", 10.0, 30.0, higher_is_better=False)
"""Distance of two segments of the tracked clothes in frames that both have, 95th percentile over the vertices."""
PSNR: Mapping[str, Gate] = {"novel_view": Gate("dB", 18.0, 16.0), "novel_pose": Gate("dB", 17.0, 15.0)}
"""PSNR over the person by kind of view; training views of a capture without held-out cameras count as novel views.

These are lower bounds below which something in a training is broken, on the few views that it measures on its way.
`LIKENESS` grades the model that comes out.
"""
LIKENESS: Mapping[str, Gate] = {"novel_view": Gate("dB", 24.0, 20.0), "novel_pose": Gate("dB", 22.0, 17.0)}
"""PSNR over the person of a finished model, by kind of view: whether its pictures can be shown for photographs.

Chosen on the `ablate` tables of three people. In novel views students whose patterns are where the photographs have
them reach 24 to 27 dB; Gaussians that follow their joints alone, which smear a skirt, 19.9 to 21.1. In novel poses
Gaussians of one frame have 16 to 18 dB and the best students 18.8 to 21.1, with cloth that swings elsewhere than in the
photograph: they are warned about. 22 dB are a typical error of 20 of 255, 17 dB one of 36.
"""
PERCEPTUAL: Mapping[str, Gate] = {"st-lpips": Gate("", 0.012, 0.03, higher_is_better=False)}
"""Perceptual distance of whole held-out images by metric: ST-LPIPS of the same tables is 0.006 to 0.011 for good
students and from 0.031 on for a textured mesh. LPIPS has no limits, because it was not measured there."""
DETAIL = Gate("x", 0.8, 0.5)
"""Detail of held-out images as a multiple of the photographs': students of sharp patterns have 0.88 to 0.92, and
blurred ones, which learned from cloth that lies beside its photographs, 0.70 to 0.77."""
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
