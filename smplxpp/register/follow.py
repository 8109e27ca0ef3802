"""Track a body from one frame through its neighbours by masks and scans, without keypoints: `follow`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, matrix_from_rotvec, rotvec_from_matrix
from smplxpp.core.errors import InputError, ProgressCallback, ignore_progress
from smplxpp.raster import rasterize_mesh
from smplxpp.register.fit import register
from smplxpp.register.kinematics import BodyState
from smplxpp.register.observations import Observations, RegisterConfig, StartNoise


def follow(
    body: BodyModel,
    observed: Observations,
    known: BodyParams,
    *,
    at: int,
    config: RegisterConfig | None = None,
    progress: ProgressCallback = ignore_progress,
) -> BodyParams:
    """Track a body from the fit of one frame to an initial fit of all frames.

    Frames are registered one by one, outwards from the known one, with the shape held. Each starts at two predictions
    that continue the motion of the two frames before it with much and with little momentum, because limbs swing and
    limbs stop; the fit that disagrees less with the masks is kept.

    Args:
        body: the body model.
        observed: masks and scans; its `initial` is ignored.
        known: one row, of frame `at`.
        at: number of the known frame.
        config: options of each registration; eight steps on surfaces are enough from one frame to the next.
        progress: called with the running step and its share done.

    Returns:
        One row for each of `observed.frames`.

    Raises:
        InputError: `at` is none of the frames, or no frame has any observation.
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
    # Converted to a state and back, so that this row has the same number of coefficients and the same hand convention
    # as the rows of all other frames, with which it is concatenated.
    known = BodyState.of_params(body, known).to_params(body, fps=observed.fps)
    found: dict[int, BodyParams] = {at: known}
    # Forwards from the known frame to the end, then backwards to the beginning.
    for later in (frames[place + 1 :], frames[:place][::-1]):
        past = [known]
        for frame in later:
            # Beside the known frame there is no velocity yet, hence one start; later there are two, for limbs that
            # swing on and for limbs that stop.
            starts = [predicted(body, past, momentum) for momentum in (0.8, 0.3)[: len(past)]]
            fits = [_registered(body, observed, frame, start, config) for start in starts]
            fit = min(fits, key=lambda found: disagreement(body, observed, frame, found))
            past = [past[-1], fit]
            found[frame] = fit
            progress("following", len(found) / len(frames))
    return BodyParams.concatenate([found[frame] for frame in frames])


def predicted(body: BodyModel, past: Sequence[BodyParams], momentum: float) -> BodyParams:
    """Extrapolate the last two rows by a share of the motion between them; a single row is returned as it is."""
    last = past[-1]
    if len(past) == 1:
        return last
    before, now = (BodyState.of_params(body, row) for row in past[-2:])
    # Constant-velocity extrapolation with the share m of the motion, joint by joint in the frame of the parent:
    #   R_next = exp(m log(R_now R_before^T)) R_now,    t_next = t_now + m (t_now - t_before)
    turn = rotvec_from_matrix(now.rotations @ before.rotations.transpose(0, 1, 3, 2))
    rotations = matrix_from_rotvec(momentum * turn) @ now.rotations
    moved = now.transl + momentum * (now.transl - before.transl)
    return BodyState(rotations, moved, now.betas, now.expression).to_params(body, fps=last.fps)


def _registered(
    body: BodyModel, observed: Observations, frame: int, start: BodyParams, config: RegisterConfig
) -> BodyParams:
    """Register one frame to its masks and scan; a frame without any keeps the prediction."""
    # Errors of a prediction from the last two frames; the shape is known.
    noise = StartNoise(pose=np.radians(8.0), transl=0.05, shape=1e-3)
    seen = {frame: observed.scans[frame]} if frame in observed.scans else {}
    # The frame is its own frame for the shape, which the small deviation of `noise.shape` holds at the known one.
    one = replace(
        observed,
        frames=(frame,),
        scans=seen,
        initial=start,
        initial_noise=noise,
        shape_frames=(frame,),
        keypoints={},
    )
    fit = register(body, one, config)
    return fit.params if fit.frames else start


def lost_frames(body: BodyModel, observed: Observations, params: BodyParams, *, at: int) -> tuple[str, ...]:
    """Return a note about frames whose masks disagree with the tracked body much more than those of its first frame.

    Cloth that moves changes the disagreement by less than a quarter and three hundredths; more means a lost limb.

    Args:
        body: the body model.
        observed: masks.
        params: one row a frame, as `follow` returns them.
        at: number of the frame at which the tracking began.
    """
    frames = observed.frames
    wrong = [disagreement(body, observed, frame, params.frame(row)) for row, frame in enumerate(frames)]
    # Relative to the known frame, because loose clothes make the disagreement large even there; the constant covers
    # masks that are nearly perfect, for which a quarter of almost nothing would flag every frame.
    bound = 1.25 * wrong[frames.index(at)] + 0.03
    lost = [frame for frame, share in zip(frames, wrong, strict=True) if share > bound]
    if not lost:
        return ()
    return (
        f"the body was probably lost in {len(lost)} of {len(frames)} frames, first in frame {lost[0]}: masks alone do "
        "not tell where fast limbs went; detect keypoints (`smplxpp keypoints detect`) and give them with --keypoints",
    )


def disagreement(body: BodyModel, observed: Observations, frame: int, params: BodyParams) -> float:
    """Return the number of pixels that either a body or the mask covers but not both, over the masks' size; else 0.

    Clothes make it large for every body, but least for the right one. Views are compared at about 240 rows.
    """
    if observed.mask is None:
        return 0.0
    mesh = body.mesh(body.forward(params).vertices[0])
    wrong, all_of_them = 0.0, 0.0
    for name, camera in observed.cameras.items():
        mask = observed.mask(name, frame)
        if mask is None:
            continue
        step = max(1, camera.height // 240)
        # Render at the reduced size, and take from the mask the pixel at the middle of each block: both then sample the
        # same rays up to half a pixel.
        small = camera.resized(camera.width // step, camera.height // step)
        drawn = rasterize_mesh(mesh, small, threads=1).face_id >= 0
        person = mask[step // 2 :: step, step // 2 :: step][: small.height, : small.width] > 127
        # Symmetric difference of rendered body and mask. Sums over cameras, not means, let the views that show more
        # count more.
        wrong += float((drawn[: person.shape[0], : person.shape[1]] != person).sum())
        all_of_them += float(person.sum())
    return wrong / max(all_of_them, 1.0)
