"""A trained student moving: frames of a film that the runtime draws, from a run or from a bundle."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import UInt8

from pipelines.commands.driving import Driving
from pipelines.commands.options import ClothMode
from smplxpp.cloth.play import ways
from smplxpp.cloth.quality import ClothQuality
from smplxpp.core import BodyParams, Camera, spread
from smplxpp.core.light import Relighting
from smplxpp.figures import VIEWS, fit_cameras, turntable_cameras

if TYPE_CHECKING:
    from avatar.runtime import AvatarBundle, AvatarPlayer

_BACKGROUND = (1.0, 1.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class StudentFilm:
    """View, size and light of a film of a student.

    Attributes:
        view: name of a view, or "turntable".
        height: height of the pictures, pixels.
        width: width of the pictures, pixels; None fits the motion.
        cloth: source of the motion of loose clothes: a simulation, the student's own field, or the joints alone.
        clamp: whether joint rotations are limited to the range of the training.
        numbered_from: training frame of the motion's first frame, whose latent codes are then used; None treats all
            frames as new poses.
        relighting: the light; None keeps that of the capture.
        below: height of the picture below the highest point, metres; None shows the whole person.
        device: where it is posed and drawn, see `AvatarPlayer`.
    """

    view: str
    height: int
    width: int | None
    cloth: ClothMode
    clamp: bool
    numbered_from: int | None = None
    relighting: Relighting | None = None
    below: float | None = None
    device: str = "cpu"


def motion_for(bundle: AvatarBundle, path: Path, *, fps: float | None = None) -> BodyParams:
    """Read a motion, in any layout or of a skeleton, for a bundle's body, at its own or a stated rate."""
    from avatar.runtime.skeleton import skeleton_body

    return Driving().load(path, skeleton_body(bundle), fps=fps)


def student_frames(
    bundle: AvatarBundle,
    motion: BodyParams,
    shown: range,
    film: StudentFilm,
    notes: list[str],
    quality: list[ClothQuality] | None = None,
) -> tuple[list[Camera], Iterator[UInt8[np.ndarray, "H W 3"]]]:
    """Return the cameras of a film and its pictures, drawn as they are asked for.

    Args:
        bundle: the student.
        motion: all frames that loose clothes follow, at their own frame rate.
        shown: rows of the motion that the film shows.
        film: view, size and light.
        notes: list to which remarks are added.
        quality: list to which is added, after the last picture, how well simulated clothes held.
    """
    from avatar.runtime import AvatarPlayer
    from avatar.runtime.skeleton import pose_range

    # Compare the shown frames with the joint range of the training: outside it the field extrapolates.
    limits = pose_range(bundle)
    if limits is not None:
        outside = limits.outside(motion)[list(shown)].any(axis=1)
        if outside.any():
            done = "they were held back" if film.clamp else "`--outside clamp` holds them back"
            notes.append(
                f"{int(outside.sum())} of {len(shown)} frames, the first at {int(np.argmax(outside))}, turn joints "
                f"more than 10 degrees farther than training saw: {done}"
            )
        motion = limits.clamped(motion) if film.clamp else motion
    player = AvatarPlayer(bundle, device=film.device)
    cameras = _cameras(player, motion.select(list(shown)), film)
    return cameras, _pictures(player, motion, shown, cameras, film, notes, quality)


def _cameras(player: AvatarPlayer, params: BodyParams, film: StudentFilm) -> list[Camera]:
    framing_poses = 36
    # Frame the camera by the Gaussians of a sample of poses.
    some = spread(range(len(params)), framing_poses)
    points = np.concatenate([player.pose(params.frame(k)).means.astype(np.float64) for k in some])
    if film.below is not None:
        points = points[points[:, 1] > points[:, 1].max() - film.below]
    height = film.height + film.height % 2  # h264 with 4:2:0 colour takes even sizes
    width = None if film.width is None else film.width + film.width % 2
    if film.view == "turntable":
        return turntable_cameras(points, count=len(params), height=height, width=width)
    return fit_cameras(points, directions=[VIEWS[film.view]], height=height, width=width) * len(params)


def _pictures(
    player: AvatarPlayer,
    motion: BodyParams,
    shown: range,
    cameras: list[Camera],
    film: StudentFilm,
    notes: list[str],
    quality: list[ClothQuality] | None,
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    # Step a simulation through every frame of the motion, and draw only the shown ones. Without a simulation, frames
    # that are not shown need no pose.
    picture = dict(zip(shown, cameras, strict=True))
    coded = set() if film.numbered_from is None else set(player.bundle.about.frames)
    simulate, fps = film.cloth == "simulate" and player.has_clothes, motion.fps or 1.0
    skinned = player.skinned_clothes if film.cloth == "skin" else None
    paths = ways(motion, fps) if simulate else repeat([], len(motion))
    for k, path in enumerate(paths):
        number = k + (film.numbered_from or 0)
        if simulate:
            player.step(motion.frame(k), 1.0 / fps, path=path)
        if k not in picture:
            continue
        if not simulate:
            player.pose(motion.frame(k), frame=number if number in coded else None, cloth=skinned)
        image, _ = player.draw(picture[k], background=_BACKGROUND, relighting=film.relighting)
        yield (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
    notes += player.notes
    if quality is not None and simulate:
        quality += player.cloth_quality
