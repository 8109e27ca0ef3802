"""The backends as parameters of a test, and how near to the truth each has to be."""

from __future__ import annotations

import pytest
import torch

IMAGE_TOLERANCE = {"reference": 1e-12, "cpu": 1e-6, "gsplat": 2e-5}
"""Largest error of an image, as a share of its largest value."""
GRADIENT_TOLERANCE = {"reference": 1e-10, "cpu": 1e-5, "gsplat": 1e-4}
"""Largest error of a gradient, as a share of its largest entry."""

GSPLAT = pytest.param(
    "gsplat",
    marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat needs a CUDA device"),
)
FAST_BACKENDS = ["cpu", GSPLAT]
ALL_BACKENDS = ["reference", *FAST_BACKENDS]
