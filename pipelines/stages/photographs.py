"""Whether the photographs of the reference frame show the scan, or its mirror image."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipelines.runs.gates import MIRRORED_VIEWS
from pipelines.stages.build_config import BuildInputs
from pipelines.stages.completeness import sagittal_plane
from smplxpp.capture.cameras import read_lenses
from smplxpp.capture.views import ViewReader
from smplxpp.capture.window import Window
from smplxpp.core.camera import Camera
from smplxpp.core.checks import Check
from smplxpp.core.errors import InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.metrics import mirrored_by_views
from smplxpp.template.template import Template

SIZE = 256
"""Pixels of a photograph's longer side: what tells left from right is no detail."""


def photograph_checks(
    template: Template, params: BodyParams, scan: TriangleMesh, colors: np.ndarray, inputs: BuildInputs
) -> tuple[list[Check], dict[str, Any]]:
    """The check, if scan and photographs have anything to tell, and its numbers.

    Args:
        params: of the scan's pose. colors: (N, 3) uint8 of the scan, all the same if it has none.
    """
    if not inputs.photographs or (colors == colors[0]).all():
        return [], {}
    views, problems = _views(inputs)
    figure = template.posed_body(params).frame(0)
    center, across = sagittal_plane(template, figure.joints)
    body = template.body.mesh(figure.vertices)
    share = mirrored_by_views(scan, colors / 255.0, views, body=body, center=center, across=across)
    numbers = {"views": [camera.name for camera, _ in views], "unread": problems, "mirrored": share}
    if share is None:
        return [], numbers
    words = "0: the scan as it is, 1: its mirror image; high: scan or parameters have left and right exchanged; 0.5 "
    words += f"tells nothing; {len(views)} views" + (f", {len(problems)} cannot be read" if problems else "")
    check = MIRRORED_VIEWS.check("photographs between the scan and its mirror image", share, explanation=words)
    return [check], numbers


def _views(inputs: BuildInputs) -> tuple[list[tuple[Camera, np.ndarray]], list[str]]:
    """Small photographs (H, W, 3) in [0, 1] with their cameras, and what cannot be read: nothing else needs them."""
    if inputs.cameras is None:
        return [], ["no camera file"]
    try:
        lenses = {camera.name: (camera, lens) for camera, lens in read_lenses(inputs.cameras)}
    except InputError as error:
        return [], [str(error)]
    views, problems = [], []
    for name, path in inputs.photographs.items():
        if name not in lenses:
            problems.append(f"camera {name}: not in {inputs.cameras.name}")
            continue
        camera, lens = lenses[name]
        try:
            window = Window.full(camera).resized(min(1.0, SIZE / max(camera.width, camera.height)))
            views.append((window.camera(camera), ViewReader(camera, window, lens).color(path) / 255.0))
        except InputError as error:
            problems.append(f"camera {name}: {error}")
    return views, problems
