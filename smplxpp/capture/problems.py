"""What is wrong with a capture's files, told before a training run finds out."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from smplxpp.capture.capture import Capture
from smplxpp.capture.distortion import Distortion, RationalDistortion
from smplxpp.capture.recording import Problem
from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError

# So many cameras, whose pictures' upper edges have this mean along an axis, say which one points up.
_AGREEING_CAMERAS, _UPRIGHT = 3, 0.8


def find_problems(capture: Capture, *, decode: bool = True) -> list[Problem]:
    """Everything that would stop a view or a frame from being used, each with its file.

    The world: cameras that agree on another axis up than +y. Missing: cameras without images, frames that not every
    camera has, images without a mask where others have one, frames without parameters. Unusable: parameters and
    keypoints that cannot be read or hold NaN; with `decode` (which reads every file) damaged images, masks, label and
    normal maps, ones of another size than the calibration's, and images that are not on the declared background.
    `capture.without(problems)` leaves out what is named, and then has no problems but those of the whole capture.

    Args:
        capture: as opened; its own `problems` come first.
        decode: open every image file as well.
    """
    found = list(capture.problems)
    told = {(problem.camera, problem.frame) for problem in found}
    found += [problem for problem in _missing_images(capture) if (problem.camera, problem.frame) not in told]
    found += [*_other_way_up(capture), *_missing_masks(capture), *_parameters(capture), *_keypoints(capture)]
    if decode:
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for problems in pool.map(lambda view: list(_damaged(capture, *view)), capture.views()):
                found += problems
    return [p for p in dict.fromkeys(found) if (p.camera, p.frame) not in capture.excluded]


def _missing_images(capture: Capture) -> Iterator[Problem]:
    names, table = list(capture.cameras), capture.presence()
    source = capture.recording.keypoints
    tracked = () if source is None or table.any() else source.cameras()  # cameras for keypoints alone
    for name, has in zip(names, table, strict=True):
        if len(capture.frames) and not has.any() and name not in tracked:
            yield Problem(f"camera {name}: calibrated, but without any image", name)
    used = table.any(axis=1)
    for column, frame in enumerate(capture.frames):
        seen = [name for name, has in zip(names, table[:, column], strict=True) if has]
        if len(seen) == 1 and used.sum() > 1:
            yield Problem(f"frame {frame}: an image in camera {seen[0]} alone", None, frame)
        elif seen:
            for row in np.flatnonzero(used & ~table[:, column]):
                yield Problem(f"camera {names[row]}: no image of frame {frame}", names[row], frame)


def _other_way_up(capture: Capture) -> Iterator[Problem]:
    """A world with another axis up: pictures are upright, their upper edges say it; rigs on their side do not."""
    if len(capture.cameras) < _AGREEING_CAMERAS:
        return
    up = -np.mean([camera.cam_from_world[1, :3] for camera in capture.cameras.values()], axis=0)
    axis = int(np.abs(up).argmax())
    if abs(up[axis]) > _UPRIGHT and (axis, up[axis] > 0) != (1, True):
        name = ("+" if up[axis] > 0 else "-") + "xyz"[axis]
        yield Problem(
            f"the upper edges of the cameras' pictures point along {name} of the world, "
            "where +y is expected: turn cameras and parameters (docs/captures.md)"
        )


def _missing_masks(capture: Capture) -> Iterator[Problem]:
    images, masks = capture.presence(), capture.presence("mask")
    if not masks.any():
        if images.any():
            yield Problem("no masks: give a folder of mattes, or make them with a matting model")
        return
    names = list(capture.cameras)
    for row, column in np.argwhere(images & ~masks):
        frame = capture.frames[column]
        path = capture.file(names[row], frame)
        yield Problem(f"image file {path}: no mask", names[row], frame)


def _parameters(capture: Capture) -> Iterator[Problem]:
    source = capture.recording.params
    if source is None:
        return
    try:
        known = set(source.frames().tolist())
    except InputError as error:
        yield Problem(str(error))
        return
    for frame in capture.frames:
        if frame not in known:
            yield Problem(f"frame {frame}: no body parameters", None, frame)
            continue
        try:
            source.read(frame)
        except InputError as error:
            yield Problem(str(error), None, frame)


def _keypoints(capture: Capture) -> Iterator[Problem]:
    """Files of keypoints that cannot be read; their cameras' images are good."""
    for name in capture.cameras:
        try:
            capture.keypoints(name)
        except InputError as error:
            yield Problem(str(error))


def _damaged(capture: Capture, camera: str, frame: int) -> Iterator[Problem]:
    reader = capture.reader(camera)
    image, mask = capture.file(camera, frame), capture.file(camera, frame, "mask")
    if image is not None:
        try:
            if mask is None:
                reader.color(image)
            else:
                reader.foreground(image, mask)
        except InputError as error:
            yield Problem(str(error), camera, frame)
    for kind, read in (("label", reader.labels), ("normal", reader.normals)):
        path = capture.file(camera, frame, kind)
        if path is not None:
            try:
                read(path)
            except InputError as error:
                yield Problem(str(error), camera, frame)


_GRID = 64
# Losses below this share are margins; every undistortion has them.
_LEAST_SHARE = 0.05


def lost_share(camera: Camera, distortion: Distortion) -> float:
    """The share, from 0 to 1, of a distorted picture that lies outside of `camera`'s undistorted one."""
    middles = (np.arange(_GRID) + 0.5) / _GRID
    x, y = np.meshgrid(middles * camera.width, middles * camera.height)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    K, size = camera.K, (camera.width, camera.height)
    with np.errstate(over="ignore", invalid="ignore"):  # principal points far away
        seen = distortion.undistort((pixels - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T) @ K[:2, :2].T + K[:2, 2]
    return float(1.0 - ((seen >= 0) & (seen <= size)).all(axis=1).mean())  # NaN is outside


def lens_problems(cameras: Mapping[str, Camera], distortions: Mapping[str, Distortion]) -> list[Problem]:
    """Say which fisheye lenses lose more than their margins to the pinhole that keeps their focal length and size."""
    alike: dict[tuple, list[str]] = {}
    for name, distortion in distortions.items():
        if name in cameras and not isinstance(distortion, RationalDistortion):
            camera = cameras[name]
            key = (distortion, camera.K.tobytes(), camera.width, camera.height)
            alike.setdefault(key, []).append(name)
    found = []
    for (distortion, *_), names in alike.items():
        share = lost_share(cameras[names[0]], distortion)
        if share >= _LEAST_SHARE:
            shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
            found.append(Problem(f"camera {shown}: {share:.0%} of the picture is outside of the undistorted one"))
    return found
