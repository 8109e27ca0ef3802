"""What of a capture can be trained on with a template: views without a mask are left out, strangers refused."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from avatar.data.views import View, read_views
from smplxpp.capture import Capture
from smplxpp.capture.recording import Problem
from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.params import BodyParams
from smplxpp.core.spread import spread
from smplxpp.raster import rasterize_mesh
from smplxpp.template.template import Template

CHECKED_FRAMES, CHECKED_CAMERAS = 3, 4
"""Training frames, and cameras of each, in whose images the template has to stand."""
STANDS_IN_IMAGES = 0.3
"""Overlap of template and masks below which nothing can be learned."""
OTHER_SHAPE, OTHER_PERSON = 0.005, 0.03
"""Metres between the template's body and that of the parameters, on average: doubtful, and another person."""


def normal_maps(capture: Capture) -> tuple[int, int]:
    """Training views that have a normal map, and all training views."""
    splits = capture.splits
    rows = np.isin(list(capture.cameras), splits.train_cameras)
    views = capture.presence() & rows[:, None] & np.isin(capture.frames, splits.train_frames)
    return int((views & capture.presence("normal")).sum()), int(views.sum())


def silhouette_overlap(posed: TriangleMesh, views: list[View]) -> float:
    """Mean intersection over union of the posed template's silhouette and the masks.

    Raises:
        InputError: so little that template and images do not belong together.
    """
    values = []
    for view in views:
        mask, mesh = view.alpha.numpy() > 127, rasterize_mesh(posed, view.camera).mask
        values.append((mask & mesh).sum() / max((mask | mesh).sum(), 1))
    mean = float(np.mean(values))
    if mean < STANDS_IN_IMAGES:
        raise InputError(
            "template in the images",
            expected="a silhouette on the masks",
            received=f"a mean overlap (IoU) of {mean:.2f} over {len(views)} views",
            remedy="check --frame and --params, and that cameras and template share one world",
        )
    return mean


def with_cameras(capture: Capture, poses: Mapping[str, Float[np.ndarray, "4 4"]]) -> Capture:
    """The capture with other `cam_from_world` of some of its cameras; what is not among them stays."""
    cameras = {
        name: replace(camera, cam_from_world=poses[name]) if name in poses else camera
        for name, camera in capture.recording.cameras.items()
    }
    return replace(capture, recording=replace(capture.recording, cameras=cameras))


def with_params(capture: Capture) -> tuple[Capture, dict[int, BodyParams]]:
    """Without the frames that have no usable parameters; those of the others."""
    splits, known, why = capture.splits, {}, {}
    for frame in (*splits.train_frames, *splits.novel_pose_frames):
        try:
            params = capture.params(frame)
        except InputError as error:
            why[frame] = str(error)
            continue
        if params is None:
            why[frame] = f"frame {frame}: no body parameters"
        else:
            known[frame] = params
    if not any(frame in known for frame in splits.train_frames):
        raise InputError(
            f"capture {capture.name}",
            expected="body parameters of the training frames",
            received=why[splits.train_frames[0]],
            remedy="name a file with --params, convert your fit with `smplxpp params convert`, or make one with "
            "`smplxpp register`",
        )
    if why:
        _warn(f"{len(why)} of {len(known) + len(why)} frames are left out: {next(iter(why.values()))}")
        capture = capture.without([Problem(text, None, frame) for frame, text in why.items()])
    return capture, known


def with_masks(capture: Capture) -> Capture:
    """Without the views that have no mask."""
    names = list(capture.cameras)
    images, masks = capture.presence(), capture.presence("mask")
    wanted = np.isin(names, capture.splits.train_cameras)[:, None] & np.isin(
        capture.frames, capture.splits.train_frames
    )
    lacking = [(names[row], capture.frames[column]) for row, column in np.argwhere(images & ~masks)]
    if not (images & masks & wanted).any():
        raise InputError(
            f"capture {capture.name}",
            expected="images of training frames and their masks",
            received="no mask" if (images & wanted).any() else "no image",
            remedy="give the masks as docs/captures.md says, or make them with your matting model",
        )
    if lacking:
        camera, frame = lacking[0]
        _warn(f"{len(lacking)} views are left out: no mask of camera {camera}, frame {frame}")
        capture = capture.without([Problem("no mask", *view) for view in lacking])
    return capture


def compare_shapes(template: Template, params: Sequence[BodyParams]) -> None:
    """Refuse parameters of another person: their shape coefficients against those that the template is made of."""
    size = template.body.num_betas
    betas = np.mean([_padded(p.betas[0], size) for p in params], axis=0)
    moved = template.body.shapedirs @ (betas - _padded(template.betas, size))
    distance = float(np.linalg.norm(moved, axis=-1).mean())
    if distance > OTHER_PERSON:
        raise InputError(
            "body parameters of the training frames",
            expected="those of the template's person and body model",
            received=f"shape coefficients that move the body by {1e3 * distance:.0f} mm on average",
            remedy="build the template from this capture, or name its own parameters with --params (and --body)",
        )
    if distance > OTHER_SHAPE:
        _warn(
            f"the parameters' body is {1e3 * distance:.0f} mm off the template's on average: another fit of its shape?"
        )


def _padded(betas: np.ndarray, size: int) -> np.ndarray:
    return np.pad(betas[:size], (0, max(0, size - len(betas))))


def overlap_of(template: Template, capture: Capture, params: Mapping[int, BodyParams]) -> float:
    """Mean IoU of the posed template and the masks in some training frames.

    Raises:
        InputError: nobody in these masks, or a template elsewhere.
    """
    values = []
    for frame in spread(capture.splits.train_frames, CHECKED_FRAMES):
        seen = [name for name in capture.splits.train_cameras if capture.file(name, frame) is not None]
        views = read_views(capture, frame, spread(seen, CHECKED_CAMERAS))
        if views:
            posed = template.mesh.with_vertices(template.pose(params[frame])[0])
            values.append(silhouette_overlap(posed, views))
    if not values:
        raise InputError(
            f"masks of capture {capture.name}",
            expected="a person in them",
            received=f"masks that are zero in all of {CHECKED_FRAMES} frames",
            remedy="look at them with `smplxpp capture check`",
        )
    return float(np.mean(values))


def _warn(message: str) -> None:
    warnings.warn(message, GeometryWarning, stacklevel=3)
