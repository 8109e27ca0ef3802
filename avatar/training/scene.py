"""Check the inputs of a training before it starts: leave out unusable frames and views, refuse mismatches."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from avatar.data.capture_digests import capture_digests
from avatar.data.views import View, read_views
from smplxpp.capture import Capture, Problem, Splits
from smplxpp.core import BodyParams, GeometryWarning, InputError, TriangleMesh, spread
from smplxpp.raster import rasterize_mesh
from smplxpp.template.template import Template


@dataclass(frozen=True, eq=False)
class TrainScene:
    """A template and a capture that it can be trained on.

    Attributes:
        template: the clothed body.
        capture: its splits name training and held-out frames; unusable frames and views are left out.
        frame: reference frame of the fit.
        built_frame: frame that the template was built from if it is trained on (then equal to `frame`), else None.
        template_frame: frame whose scan the template was made of if the scan is the capture's own, else None.
        overlap: mean IoU of silhouettes and masks in some training frames.
        digests: SHA-256 by name of all inputs that the training reads.
    """

    template: Template
    capture: Capture
    frame: int
    built_frame: int | None
    template_frame: int | None
    overlap: float
    digests: dict[str, str]

    def reference_params(self) -> BodyParams:
        """Return the parameters of the reference frame, which were checked when the scene was opened."""
        params = self.capture.params(self.frame)
        assert params is not None
        return params


def prepare_scene(
    template: Template, capture: Capture, *, built_frame: int | None, before: TrainScene | None = None
) -> TrainScene:
    """Check a capture against a template, and leave out frames and views that cannot be trained on.

    Args:
        template: the clothed body.
        capture: opened with the parameters of its frames; its splits name the training and the held-out frames.
        built_frame: frame that the template was built from; None: not known.
        before: scene of the same capture with other parameters, whose files are not looked at again.

    Returns:
        The scene; its digests are those of the capture, and `template_frame` is `built_frame`.

    Raises:
        InputError: no training frame with parameters, image and mask; images of another size than their camera's; an
            empty mask everywhere; a template that does not stand in the images; parameters of another body.

    Warns:
        GeometryWarning: frames without parameters or views without a mask, which are left out; a template without
            clothes.
    """
    if not template.cloth_mask.any():
        warnings.warn("the template has no clothes: the whole of it moves as one body", GeometryWarning, stacklevel=2)
    if not capture.splits.train_frames:
        raise InputError(
            f"capture {capture.name}",
            expected="frames to train on",
            received="none in its splits",
            remedy="see docs/captures.md: splits are read from the capture",
        )
    # Leave out frames without parameters, then views without masks; what is left of the training frames is used.
    capture, params = with_params(capture)
    capture = with_masks(capture)
    seen = {shown for _, shown in capture.views(capture.splits.train_cameras)}
    frames = [number for number in capture.splits.train_frames if number in seen]
    # The fit and the tracking start where the template is the scanned surface, if that frame is trained on.
    trained = built_frame if built_frame in frames else None
    frame = frames[0] if trained is None else trained
    for name in capture.splits.train_cameras:
        if capture.file(name, frame) is not None:
            capture.foreground(name, frame)  # a damaged image or one of another size is an error now
    compare_shapes(template, [params[f] for f in frames])
    overlap = overlap_of(template, capture, params)
    # A capture of a million files takes minutes to look at on a shared disk.
    files = None
    if before is not None and (before.capture.splits, before.capture.excluded) == (capture.splits, capture.excluded):
        files = {name: digest for name, digest in before.digests.items() if " files" in name}
    digests = capture_digests(capture, params, files=files)
    return TrainScene(template, capture, frame, trained, built_frame, overlap, digests)


def hold_out_cameras(capture: Capture, names: Sequence[str]) -> Capture:
    """Hold out cameras instead of those that the capture's splits hold out.

    Cameras that the splits hold out and `names` does not are trained on; cameras of neither split stay unused.

    Args:
        capture: with cameras and images.
        names: cameras to hold out; empty: those of the splits.

    Raises:
        InputError: an unknown camera, no images, or no camera left to train on.
    """
    if not capture.cameras or not capture.presence().any():
        raise InputError(
            f"capture {capture.name}",
            expected="cameras and their images",
            received="none",
            remedy="a scan alone makes a template; a fit needs the views: see docs/captures.md",
        )
    unknown = sorted(set(names) - set(capture.cameras))
    if unknown:
        raise InputError(
            "option hold-out", expected=f"cameras among {', '.join(capture.cameras)}", received=", ".join(unknown)
        )
    splits = capture.splits
    # Named cameras replace the split's held-out ones; cameras of neither split stay unused.
    held_out = tuple(names) or splits.novel_view_cameras
    known = {*splits.train_cameras, *splits.novel_view_cameras}
    train = tuple(name for name in capture.cameras if name in known and name not in held_out)
    if not train:
        raise InputError("cameras", expected="at least one to train on", received="all held out")
    return replace(capture, splits=Splits(train, tuple(held_out), splits.train_frames, splits.novel_pose_frames))


def normal_maps(capture: Capture) -> tuple[int, int]:
    """Return the numbers of training views that have a normal map, and of all training views."""
    splits = capture.splits
    # `presence` is (cameras, frames); the two masks select training cameras and training frames in it.
    rows = np.isin(list(capture.cameras), splits.train_cameras)
    views = capture.presence() & rows[:, None] & np.isin(capture.frames, splits.train_frames)
    return int((views & capture.presence("normal")).sum()), int(views.sum())


def silhouette_overlap(posed: TriangleMesh, views: list[View], *, least: float = 0.3) -> float:
    """Return the mean intersection over union of the posed template's silhouette and the masks.

    Args:
        posed: the template in the pose of the views.
        views: whole views with the opacity of the person.
        least: overlap below which nothing can be learned; another pose, other cameras or another unit give less.

    Raises:
        InputError: a mean below `least`: template and images do not belong together.
    """
    values = []
    for view in views:
        mask, mesh = view.alpha.numpy() > 127, rasterize_mesh(posed, view.camera).mask
        # Intersection over union of the two silhouettes.
        values.append((mask & mesh).sum() / max((mask | mesh).sum(), 1))
    mean = float(np.mean(values))
    if mean < least:
        raise InputError(
            "template in the images",
            expected="a silhouette on the masks",
            received=f"a mean overlap (IoU) of {mean:.2f} over {len(views)} views",
            remedy="check --frame and --params, and that cameras and template share one world",
        )
    return mean


def with_cameras(capture: Capture, poses: Mapping[str, Float[np.ndarray, "4 4"]]) -> Capture:
    """Return the capture with other `cam_from_world` for the cameras in `poses`; the others keep theirs."""
    cameras = {
        name: replace(camera, cam_from_world=poses[name]) if name in poses else camera
        for name, camera in capture.recording.cameras.items()
    }
    return replace(capture, recording=replace(capture.recording, cameras=cameras))


def with_params(capture: Capture) -> tuple[Capture, dict[int, BodyParams]]:
    """Leave out the frames without usable parameters; return the capture and the parameters of the others by frame.

    Raises:
        InputError: no training frame has parameters.
    """
    # A damaged row of parameters costs its frame, not the training; the first reason is shown in the warning.
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
    """Leave out the views without a mask.

    Raises:
        InputError: no training view has an image and a mask.
    """
    names = list(capture.cameras)
    # (cameras, frames) tables: which views have an image, which a mask, and which are trained on.
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


def compare_shapes(
    template: Template, params: Sequence[BodyParams], *, doubtful: float = 0.005, refused: float = 0.03
) -> None:
    """Compare the shape coefficients of parameters with those that the template was built with.

    Args:
        template: the clothed body.
        params: of the training frames.
        doubtful: mean distance of the two bodies' vertices, metres, above which a warning is given: two fits of one
            person differ by less.
        refused: distance above which the parameters are those of another person.

    Raises:
        InputError: parameters of another person.
    """
    # Displacement of each vertex by the difference of the two shape vectors, metres; the shape space is linear.
    size = template.body.num_betas
    betas = np.mean([_padded(p.betas[0], size) for p in params], axis=0)
    moved = template.body.shapedirs @ (betas - _padded(template.betas, size))
    distance = float(np.linalg.norm(moved, axis=-1).mean())
    if distance > refused:
        raise InputError(
            "body parameters of the training frames",
            expected="those of the template's person and body model",
            received=f"shape coefficients that move the body by {1e3 * distance:.0f} mm on average",
            remedy="build the template from this capture, or name its own parameters with --params (and --body)",
        )
    if distance > doubtful:
        _warn(
            f"the parameters' body is {1e3 * distance:.0f} mm off the template's on average: another fit of its shape?"
        )


def _padded(betas: np.ndarray, size: int) -> np.ndarray:
    return np.pad(betas[:size], (0, max(0, size - len(betas))))


def overlap_of(
    template: Template, capture: Capture, params: Mapping[int, BodyParams], *, frames: int = 3, cameras: int = 4
) -> float:
    """Return the mean IoU of the posed template and the masks in some training frames.

    Args:
        template: the clothed body.
        capture: with masks.
        params: of the training frames.
        frames: number of frames to compare; a few are enough to notice a wrong world.
        cameras: number of cameras of each frame.

    Raises:
        InputError: no person in these masks, or a template elsewhere.
    """
    values = []
    for frame in spread(capture.splits.train_frames, frames):
        # Evenly spread frames and cameras; views without a person in the mask are left out by the reader.
        seen = [name for name in capture.splits.train_cameras if capture.file(name, frame) is not None]
        views = read_views(capture, frame, spread(seen, cameras))
        if views:
            posed = template.mesh.with_vertices(template.pose(params[frame])[0])
            values.append(silhouette_overlap(posed, views))
    if not values:
        raise InputError(
            f"masks of capture {capture.name}",
            expected="a person in them",
            received=f"masks that are zero in all of {frames} frames",
            remedy="look at them with `smplxpp capture check`",
        )
    return float(np.mean(values))


def _warn(message: str) -> None:
    warnings.warn(message, GeometryWarning, stacklevel=4)
