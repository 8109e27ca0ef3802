"""A body followed from one frame through its neighbours, where no keypoints say where it went: `follow`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from smplxpp.body import BodyModel
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix
from smplxpp.raster import rasterize_mesh
from smplxpp.register.config import RegisterConfig
from smplxpp.register.fit import register
from smplxpp.register.kinematics import BodyState
from smplxpp.register.observations import Observations, StartNoise

PREDICTED = StartNoise(pose=np.radians(8.0), transl=0.05, shape=1e-3)
"""How wrong the last two frames' motion, going on, is about the next; the shape is known."""
# Shares of the last turn and move that may go on: limbs swing, and limbs stop.
_MOMENTA = (0.8, 0.3)
# Disagreement that is no longer that of clothes which move: as a factor of the first frame's, and beyond it.
_LOST, _LOST_LEAST = 1.25, 0.03
# Height of the pictures in which two answers are compared.
_COMPARED_HEIGHT = 240


def follow(
    body: BodyModel,
    observed: Observations,
    known: BodyParams,
    *,
    at: int,
    config: RegisterConfig | None = None,
    progress: ProgressCallback = ignore_progress,
) -> BodyParams:
    """A start for every frame, from the fit of a single one.

    Frames are taken one by one, outwards from the known one: each begins where the motion of the two before it leads
    and is registered to its own masks, scans and keypoints with the shape held.

    Args:
        observed: what is seen; its `initial` is not looked at.
        known: one row, of frame `at`.

    Returns:
        A row for each of `observed.frames`.

    Raises:
        InputError: `at` is none of the frames, or nothing is seen in all of them.
    """
    frames = observed.frames
    if at not in frames or len(known) != 1:
        raise InputError(
            "follow",
            expected=f"one row of parameters, of a frame in {frames[0]} to {frames[-1]}",
            received=f"{len(known)} of frame {at}",
        )
    config = replace(config or RegisterConfig(), surface_steps=8)
    place = frames.index(at)
    known = BodyState.of_params(body, known).to_params(body, fps=observed.fps)
    found: dict[int, BodyParams] = {at: known}
    for way in (frames[place + 1 :], frames[:place][::-1]):
        past = [known]
        for frame in way:
            starts = [predicted(body, past, momentum) for momentum in _MOMENTA[: len(past)]]
            fits = [_one(body, observed, frame, start, config) for start in starts]
            fit = min(fits, key=lambda found: disagreement(body, observed, frame, found))
            past = [past[-1], fit]
            found[frame] = fit
            progress("following", len(found) / len(frames))
    return BodyParams.concatenate([found[frame] for frame in frames])


def predicted(body: BodyModel, past: Sequence[BodyParams], momentum: float) -> BodyParams:
    """Where a share of the motion of the last two of some rows leads; the last one where there is but one."""
    last = past[-1]
    if len(past) == 1:
        return last
    before, now = (BodyState.of_params(body, row) for row in past[-2:])
    turn = rotvec_from_matrix(now.rotations @ before.rotations.transpose(0, 1, 3, 2))
    rotations = matrix_from_rotvec(momentum * turn) @ now.rotations
    moved = now.transl + momentum * (now.transl - before.transl)
    return BodyState(rotations, moved, now.betas, now.expression).to_params(body, fps=last.fps)


def _one(body: BodyModel, observed: Observations, frame: int, start: BodyParams, config: RegisterConfig) -> BodyParams:
    """One frame registered; where nothing is seen in it, where it was expected."""
    seen = {frame: observed.scans[frame]} if frame in observed.scans else {}
    one = replace(
        observed,
        frames=(frame,),
        scans=seen,
        initial=start,
        initial_noise=PREDICTED,
        shape_frames=(frame,),
        keypoints={},
    )
    fit = register(body, one, config)
    return fit.params if fit.frames else start


def lost_frames(body: BodyModel, observed: Observations, params: BodyParams, *, at: int) -> tuple[str, ...]:
    """Words about frames whose masks a body that was followed explains much worse than those of the frame it began at.

    Args:
        params: a row a frame, as `follow` gives them.
    """
    frames = observed.frames
    wrong = [disagreement(body, observed, frame, params.frame(row)) for row, frame in enumerate(frames)]
    bound = _LOST * wrong[frames.index(at)] + _LOST_LEAST
    lost = [frame for frame, share in zip(frames, wrong, strict=True) if share > bound]
    if not lost:
        return ()
    return (
        f"the body was probably lost in {len(lost)} of {len(frames)} frames, first in frame {lost[0]}: masks alone do "
        "not tell where fast limbs went; detect keypoints (`smplxpp keypoints detect`) and give them with --keypoints",
    )


def disagreement(body: BodyModel, observed: Observations, frame: int, params: BodyParams) -> float:
    """Share of pixels, of all masks of a frame, that a body and the person do not both cover; 0 without masks.

    Clothes make it large for any body, and less so for the right one.
    """
    if observed.mask is None:
        return 0.0
    mesh = body.mesh(body.forward(params).vertices[0])
    wrong, all_of_them = 0.0, 0.0
    for name, camera in observed.cameras.items():
        mask = observed.mask(name, frame)
        if mask is None:
            continue
        step = max(1, camera.height // _COMPARED_HEIGHT)
        small = camera.resized(camera.width // step, camera.height // step)
        drawn = rasterize_mesh(mesh, small, threads=1).face_id >= 0
        person = mask[step // 2 :: step, step // 2 :: step][: small.height, : small.width] > 127
        wrong += float((drawn[: person.shape[0], : person.shape[1]] != person).sum())
        all_of_them += float(person.sum())
    return wrong / max(all_of_them, 1.0)
