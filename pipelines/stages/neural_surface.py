"""Reconstruct surfaces as a neural signed distance field within the hull, on machines with a CUDA device."""

from __future__ import annotations

import warnings
from dataclasses import replace
from functools import partial

import numpy as np

from avatar.reconstruct import SurfaceConfig, fit_surface
from avatar.training.engine.resources import choose_device
from pipelines.stages.reconstruct import Method
from smplxpp.core.errors import GeometryWarning, InputError, ProgressCallback
from smplxpp.reconstruct import PhotoView, ReconstructConfig, Reconstruction, adopt_surface, reconstruct


def neural_method(config: ReconstructConfig, surface: SurfaceConfig, device: str) -> Method:
    """Return the neural method for `reconstruct_capture`.

    Raises:
        InputError: no CUDA device, and the CPU was not asked for.
    """
    try:
        choose_device(device)
    except InputError as error:
        raise InputError(
            "--method sdf",
            expected=error.expected,
            received=error.received,
            remedy="leave --method at sweep, which needs none, or force --device cpu (hours at the default size)",
        ) from None
    make = partial(_neural_surface, config=config, surface=surface, device=device)
    return Method(make, (__name__,), {"name": "sdf", "surface": surface, "device": device})


def _neural_surface(
    views: list[PhotoView],
    *,
    config: ReconstructConfig,
    surface: SurfaceConfig,
    device: str,
    progress: ProgressCallback,
) -> Reconstruction:
    """Fit the neural surface within the hull; colours and confidence are computed as for the sweep's surface."""
    # The visual hull bounds the search. Views that it rejected are left out of the neural fit too.
    start = reconstruct(views, replace(config, refine=False), progress=progress)
    kept = [view for view in views if view.name in start.numbers["views"]]
    fit = fit_surface(kept, start.hull, surface, device=device, progress=progress)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GeometryWarning)  # the hull has warned of the same masks already
        found = adopt_surface(fit.mesh, kept, config)
    # Counts of the final mesh replace those of the hull.
    numbers = {
        **start.numbers,
        **{name: found.numbers[name] for name in ("status", "genus", "vertices", "faces", "unseen", "unsure", "gains")},
        # The mean over the last 100 steps smooths the noise of single batches.
        "loss": float(np.mean(fit.losses[-100:])),
    }
    return replace(found, hull=start.hull, numbers=numbers, notes=start.notes)
