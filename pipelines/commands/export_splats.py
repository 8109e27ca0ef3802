"""Export a student's splats: one pose, a file a frame, a USD that moves, or the step from pose to Gaussians."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.console import Console
from rich.progress import track

from pipelines.commands.animate_student import motion_for
from pipelines.commands.export_request import FileRequest
from smplxpp.core.params import BodyParams

if TYPE_CHECKING:
    from avatar.formats import Splats
    from avatar.runtime import AvatarBundle


# Rotations from +y to the upward axis of the file.
_TURNS = {"-y": np.diag([1.0, -1.0, -1.0]), "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])}


def splat_writers(
    request: FileRequest,
) -> tuple[float | None, Iterator[tuple[int, Callable[[Path], None]]], list[str]]:
    """Return frames a second, what writes each file with the number of frames in it, and remarks.

    Raises:
        InputError: no student, parameters of another body, rows that are not there.
    """
    import avatar
    from avatar.formats.splats import splats_along
    from avatar.runtime import AvatarPlayer

    # Exact numbers (float32): the export must not contain the bundle's quantisation error.
    bundle = avatar.open_bundle(request.source, exact=True)
    player = AvatarPlayer(bundle)
    # Without parameters: the motion of the bundle, or the rest pose of a bundle without one.
    motion = player.motion if request.params is None else motion_for(bundle, request.params, fps=request.fps)
    motion = BodyParams.rest(betas=0, expressions=0) if motion is None else motion
    # A folder or a USD with parameters holds a motion; all other files hold one pose.
    moves = request.is_series or (request.format == "usd" and request.params is not None)
    rows = request.chosen(len(motion), moves=moves)
    fps = request.rate(motion) if moves and len(rows) > 1 else None
    notes = [] if request.params is None else _far_poses(bundle, motion.select(list(rows)))
    # The field knows the clothes of training poses, so that nothing is simulated there by default.
    cloth = request.cloth if request.params is not None or request.cloth != "simulate" else "field"
    # Evaluate the poses one by one while they are written.
    splats = splats_along(player, motion, rows, cloth=cloth, notes=notes)
    shown = track(
        splats,
        total=len(rows),
        description="frames",
        console=Console(stderr=True),
        disable=request.quiet or fps is None,
    )
    # A USD stores all frames in one file; the other formats get a file for each.
    if request.format == "usd":
        from avatar.formats.splat_scenes import write_splat_usd

        return fps, iter([(len(rows), partial(write_splat_usd, frames=shown, fps=fps))]), notes
    write = _writer(request)
    return fps, ((1, partial(write, splats=one)) for one in shown), notes


def _far_poses(bundle: AvatarBundle, shown: BodyParams) -> list[str]:
    """Return a note on the number of poses far from those of the training, if there are any."""
    from avatar.runtime.skeleton import pose_range

    limits = pose_range(bundle)
    outside = np.zeros(len(shown), bool) if limits is None else limits.outside(shown).any(axis=1)
    if not outside.any():
        return []
    first = f", the first at {int(np.argmax(outside))}," if len(shown) > 1 else ""
    return [
        f"{int(outside.sum())} of {len(shown)} frames{first} turn joints more than 10 degrees farther than training saw"
    ]


def _writer(request: FileRequest) -> Callable[..., None]:
    """Return the function that writes one pose: `write(path, splats=...)`."""
    from avatar import formats

    if request.format != "ply":
        return {
            "spz": formats.write_splat_spz,
            "sog": formats.write_splat_sog,
            "glb": formats.write_splat_glb,
        }[request.format]

    def write(path: Path, *, splats: Splats) -> None:
        turned = splats if request.up == "y" else splats.rotated(_TURNS[request.up])
        formats.write_splat_ply(path, turned.padded() if request.full_harmonics else turned)

    return write


def step_writers(request: FileRequest) -> tuple[None, Iterator[tuple[int, Callable[[Path], None]]], list[str]]:
    """Return the function that writes the step from pose to Gaussians as ONNX or for WebAvatar's players, and notes.

    Raises:
        InputError: no student.
    """
    import avatar

    bundle = avatar.open_bundle(request.source, exact=True)
    if request.format == "onnx":
        from avatar.formats.onnx_step import write_onnx

        return None, iter([(1, partial(write_onnx, bundle=bundle))]), []
    from avatar.formats.webavatar import NOT_FILLED, write_webavatar
    from avatar.runtime import AvatarPlayer

    notes = [f"left out: {sentence}" for sentence in NOT_FILLED]
    return None, iter([(1, partial(write_webavatar, player=AvatarPlayer(bundle)))]), notes
