"""Limits of what a build measures, each defined once.

Comments give the values of good and bad cases in the benchmark `damaged_inputs` or on the captures, from which the two
limits (warn, fail) were chosen: above all good cases, below the bad ones as far as they separate.
"""

from __future__ import annotations

from smplxpp.clean import ROUGH
from smplxpp.core.checks import Gate

ROUGHNESS = Gate("edges", ROUGH, 1.0, higher_is_better=False)
"""Distance of a scan's vertices from the mean of their neighbours, in edge lengths. Above the first limit the scan is
smoothed."""
UNCOVERED = Gate("", 0.08, 0.2, higher_is_better=False)
"""Share of the body that a scan neither shows nor covers: up to 0.015 in whole scans, 0.09 without a head, from 0.28 on
with 40 % of the faces gone."""
REGION_UNCOVERED = Gate("", 0.2, 0.6, higher_is_better=False)
"""The same share of the head, the torso, an arm or a leg: up to 0.02 in whole scans, 0.97 for a lost head."""
ENDS_UNCOVERED = Gate("", 0.5, 0.9, higher_is_better=False)
"""The same share of a hand or a foot. Scanners do not see soles, and fingers stick together: up to 0.17 in whole scans,
0.8 for a lost hand."""
UNEXPLAINED = Gate("", 0.03, 0.12, higher_is_better=False)
"""Share of a scan that its template does not explain: up to 0.006, and 0.06 to 0.19 where a label is missing."""
SKIN_PATCH = Gate("cm2", 100.0, 1000.0, higher_is_better=False)
"""Area that is labelled skin and stands off the body: up to 20, and 435 to 2158 where a label is missing."""
MIRRORED = Gate("x", 1.3, 2.0, higher_is_better=False)
"""Distance of a scan to its fit over that of the scan's mirror image: up to 1.02, and 2.8 to 27 for mirrored scans."""
MIRRORED_VIEWS = Gate("", 0.65, 0.8, higher_is_better=False)
"""Where photographs lie between a scan (0) and its mirror image (1): -0.03 to 0.34 for right scans, 0.38 to 0.56 for
symmetric colours, 0.66 to 1.2 for mirrored ones."""
SILHOUETTE = Gate("IoU", 0.95, 0.8)
"""Overlap of a surface's silhouette and the masks."""
UNSEEN_SURFACE = Gate("", 0.25, 0.6, higher_is_better=False)
"""Share of a reconstructed surface that fewer than two cameras see: 0.05 to 0.1 with 12 to 24 cameras all around."""
MASKS_LEFT_OUT = Gate("", 0.0, 0.34, higher_is_better=False)
"""Share of the masks that the others contradict."""
