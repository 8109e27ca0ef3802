"""Gates of the numbers that several stages measure, each defined once.

Comments give the values of good and bad cases in the benchmark `nasty_scans` or on the captures, from which the two
bounds (warn, fail) were chosen: above all good cases, below the bad ones as far as they separate.
"""

from __future__ import annotations

from collections.abc import Mapping

from smplxpp.clean import ROUGH
from smplxpp.core.checks import Gate

ROUGHNESS = Gate("edges", ROUGH, 1.0, higher_is_better=False)
"""Median height of a scan's vertices over their neighbours, in edges; above the first bound the scan is smoothed."""
UNCOVERED = Gate("", 0.08, 0.2, higher_is_better=False)
"""Share of the body that a scan neither shows nor covers: up to 0.015 in whole scans, 0.09 without a head, from 0.28 on
with 40 % of the faces gone."""
REGION_UNCOVERED = Gate("", 0.2, 0.6, higher_is_better=False)
"""The same of head, torso, an arm or a leg: up to 0.02 in whole scans, 0.97 of a lost head."""
ENDS_UNCOVERED = Gate("", 0.5, 0.9, higher_is_better=False)
"""The same of a hand or a foot, whose soles scanners miss and whose fingers merge: up to 0.17 in whole scans, 0.8 of a
lost hand."""
UNEXPLAINED = Gate("", 0.03, 0.12, higher_is_better=False)
"""Share of a scan that its template does not explain: up to 0.006, 0.06 to 0.19 where a label is missing."""
SKIN_PATCH = Gate("cm2", 100.0, 1000.0, higher_is_better=False)
"""Area that is labelled skin and stands off the body: up to 20, 435 to 2158 where a label is missing."""
MIRRORED = Gate("x", 1.3, 2.0, higher_is_better=False)
"""Distance of a scan to its fit over that of the scan's mirror image: up to 1.02, mirrored 2.8 to 27."""
MIRRORED_VIEWS = Gate("", 0.65, 0.8, higher_is_better=False)
"""Where photographs lie between a scan (0) and its mirror image (1): -0.03 to 0.34 of right scans, 0.38 to 0.56 of
symmetric colours, 0.66 to 1.2 of mirrored ones."""
SILHOUETTE = Gate("IoU", 0.95, 0.8)
"""Overlap of the skinned template's silhouette with the masks."""
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
UNSEEN_SURFACE = Gate("", 0.25, 0.6, higher_is_better=False)
"""Share of a reconstructed surface that fewer than two cameras see: 0.05 to 0.1 of 12 to 24 cameras all around."""
MASKS_LEFT_OUT = Gate("", 0.0, 0.34, higher_is_better=False)
"""Share of the masks that contradict the others and are left out."""
