"""Find damaged, missing and inconsistent files of a capture before a training fails on them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from smplxpp.capture.capture import Capture
from smplxpp.capture.distortion import Distortion, RationalDistortion, beyond_fold
from smplxpp.capture.recording import Problem
from smplxpp.core import Camera, InputError


def find_problems(capture: Capture, *, decode: bool = True) -> list[Problem]:
    """Return all problems that make a view or a frame unusable, each with its file.

    World: cameras that agree on another up axis than +y. Missing: cameras without images, frames that not every camera
    has, images without a mask where others have one, frames without parameters. Unusable: parameters and keypoints that
    cannot be read or contain NaN; with `decode` (which reads every file) damaged images, masks, label and normal maps,
    files of another size than the calibration, and images that are not on the declared background.
    `capture.without(problems)` excludes these views and frames; problems of the whole capture remain.

    Args:
        capture: the capture; its own `problems` come first.
        decode: whether to open every image file.
    """
    found = list(capture.problems)
    # A reader may have reported the same view already, with a better reason.
    known = {(problem.camera, problem.frame) for problem in found}
    found += [problem for problem in _missing_images(capture) if (problem.camera, problem.frame) not in known]
    found += [*_wrong_up_axis(capture), *_missing_masks(capture), *_parameters(capture), *_keypoints(capture)]
    if decode:
        # Threads, because decoding JPEG and PNG releases the interpreter's lock.
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            for problems in pool.map(lambda view: list(_damaged(capture, *view)), capture.views()):
                found += problems
    return [p for p in dict.fromkeys(found) if (p.camera, p.frame) not in capture.excluded]


def _missing_images(capture: Capture) -> Iterator[Problem]:
    """Find cameras without any image, frames of one camera only, and gaps in the images of a camera."""
    names, table = list(capture.cameras), capture.presence()
    source = capture.recording.keypoints
    tracked = () if source is None or table.any() else source.cameras()  # cameras for keypoints alone
    for name, has in zip(names, table, strict=True):
        if len(capture.frames) and not has.any() and name not in tracked:
            yield Problem(f"camera {name}: calibrated, but without any image", name)
    # Cameras without any image were reported as a whole and do not count as gaps.
    used = table.any(axis=1)
    for column, frame in enumerate(capture.frames):
        seen = [name for name, has in zip(names, table[:, column], strict=True) if has]
        # A frame in one camera of many is a stray file, and one report suffices for it.
        if len(seen) == 1 and used.sum() > 1:
            yield Problem(f"frame {frame}: an image in camera {seen[0]} alone", None, frame)
        elif seen:
            for row in np.flatnonzero(used & ~table[:, column]):
                yield Problem(f"camera {names[row]}: no image of frame {frame}", names[row], frame)


def _wrong_up_axis(capture: Capture) -> Iterator[Problem]:
    """Find a world whose up axis is not +y, by the mean up direction of the cameras' images.

    Images are upright in most rigs. Fewer than three cameras, or cameras whose mean up direction is shorter than 0.8
    along its main axis, prove nothing.
    """
    if len(capture.cameras) < 3:
        return
    # In OpenCV's axes y points down, so that minus the second row of R is the image's up direction in the world.
    up = -np.mean([camera.cam_from_world[1, :3] for camera in capture.cameras.values()], axis=0)
    axis = int(np.abs(up).argmax())
    # Allowed is +y alone; the length of the mean tells how much the cameras agree.
    if abs(up[axis]) > 0.8 and (axis, up[axis] > 0) != (1, True):
        name = ("+" if up[axis] > 0 else "-") + "xyz"[axis]
        yield Problem(
            f"the upper edges of the cameras' pictures point along {name} of the world, "
            f"where +y is expected: `smplxpp capture convert DIR --out NEW --up {name.lstrip('+')}` turns them"
        )


def _missing_masks(capture: Capture) -> Iterator[Problem]:
    """Find images without a mask; a capture without any mask is one problem."""
    images, masks = capture.presence(), capture.presence("mask")
    if not masks.any():
        if images.any():
            yield Problem("no masks: give a folder of mattes, or make them with a matting model")
        return
    names = list(capture.cameras)
    # (N, 2) rows and columns: images that exist without their mask.
    for row, column in np.argwhere(images & ~masks):
        frame = capture.frames[column]
        path = capture.file(names[row], frame)
        yield Problem(f"image file {path}: no mask", names[row], frame)


def _parameters(capture: Capture) -> Iterator[Problem]:
    """Find frames whose body parameters are missing or cannot be read."""
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
    """Find keypoint files that cannot be read; the images of these cameras stay usable."""
    for name in capture.cameras:
        try:
            capture.keypoints(name)
        except InputError as error:
            yield Problem(str(error))


def _damaged(capture: Capture, camera: str, frame: int) -> Iterator[Problem]:
    """Decode all files of a view, and find the damaged ones."""
    reader = capture.reader(camera)
    image, mask = capture.file(camera, frame), capture.file(camera, frame, "mask")
    # Image and mask together: their product is what a training reads, and a wrong background shows only there.
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


def lost_share(camera: Camera, distortion: Distortion) -> float:
    """Return the fraction of a distorted image that its undistorted image, of the same K and size, cuts off."""
    # Undistort the centres of a grid of 64 x 64 cells, and count those that fall outside.
    grid = 64
    middles = (np.arange(grid) + 0.5) / grid
    x, y = np.meshgrid(middles * camera.width, middles * camera.height)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    K, size = camera.K, (camera.width, camera.height)
    with np.errstate(over="ignore", invalid="ignore"):  # principal points far away
        seen = distortion.undistort((pixels - K[:2, 2]) @ np.linalg.inv(K[:2, :2]).T) @ K[:2, :2].T + K[:2, 2]
    return float(1.0 - ((seen >= 0) & (seen <= size)).all(axis=1).mean())  # NaN is outside


def lens_problems(cameras: Mapping[str, Camera], distortions: Mapping[str, Distortion]) -> list[Problem]:
    """Find wide-angle lenses whose undistorted images cut off more than 5 % of the distorted ones, and folds.

    Smaller losses are margins that every undistortion has. A fold is a radius from which a polynomial of OpenCV's model
    turns back; it is named where 1 % of the undistorted image lies outside of it.
    """
    # One computation for all cameras of the same lens and intrinsics.
    alike: dict[tuple, list[str]] = {}
    for name, distortion in distortions.items():
        if name in cameras and not isinstance(distortion, RationalDistortion):
            camera = cameras[name]
            key = (distortion, camera.K.tobytes(), camera.width, camera.height)
            alike.setdefault(key, []).append(name)
    found = []
    for (distortion, *_), names in alike.items():
        share = lost_share(cameras[names[0]], distortion)
        if share >= 0.05:
            shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
            found.append(Problem(f"camera {shown}: {share:.0%} of the picture is outside of the undistorted one"))
    for name, distortion in distortions.items():
        if name in cameras and isinstance(distortion, RationalDistortion):
            # On a grid of 64 x 64 cells, because a rig has many cameras.
            grid = np.diag([64 / cameras[name].width, 64 / cameras[name].height, 1.0])
            share = float(beyond_fold(distortion, grid @ cameras[name].K, (64, 64)).mean())
            if share >= 0.01:
                text = "its lens turns back within the picture, where the pattern that calibrated it was not"
                found.append(Problem(f"camera {name}: {text}: {share:.0%} of the undistorted one stay black"))
    return found
