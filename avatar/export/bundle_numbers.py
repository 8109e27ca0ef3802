"""Quantise the numbers of a bundle: half precision, and integers with their quantisation steps."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch
from jaxtyping import Float

from avatar.models.student import Student
from smplxpp.core import BodyParams

Tensors = dict[str, np.ndarray]
_LARGEST = 127


def halves(tensors: Mapping[str, np.ndarray]) -> Tensors:
    """Return tensors in float16, or in float32 where values exceed its range."""
    most_half = 65504.0
    return {
        name: value.astype(np.float16 if np.abs(value).max(initial=0.0) < most_half else np.float32)
        for name, value in tensors.items()
    }


def unsigned(name: str, values: Float[np.ndarray, "*N"], bits: int) -> Tensors:
    """Return values of [0, 1] quantised to 8 or 16 bits, and the step."""
    # The step is stored with the integers: a reader multiplies, and needs to know no number of bits.
    most = (1 << bits) - 1
    return {
        name: np.rint(values * most).astype(np.uint8 if bits == 8 else np.uint16),
        f"{name}.step": np.float32(1.0 / most).reshape(()),
    }


def signed(name: str, values: Float[np.ndarray, "*N"], largest: np.ndarray | np.float32) -> Tensors:
    """Return values up to a magnitude of `largest`, a number or an array of the last axes, in 8 bits with steps."""
    # Symmetric quantisation: -127 .. 127, so that 0 is exact and the error is at most half a step.
    step = np.asarray(largest, np.float32) / _LARGEST
    return {
        name: np.clip(np.rint(values / step), -_LARGEST, _LARGEST).astype(np.int8),
        f"{name}.step": np.asarray(step),
    }


def rounded(name: str, basis: Float[np.ndarray, "R 3 E"], step: float) -> Tensors:
    """Return a basis in 8 bits, in steps of `step`, or coarser ones for directions with values above 127 steps."""
    return signed(name, basis, np.maximum(np.abs(basis).max(axis=(0, 1), initial=0.0), _LARGEST * step))


def blended(side: str, values: Float[np.ndarray, "n 6 M"], steps: Float[np.ndarray, "n 6"]) -> Tensors:
    """Return blend shapes in 8 bits, in units of `steps 2^exponent` with an exponent for each Gaussian.

    Most values are a few steps, so that zip compresses them to about three bits each.
    """
    # A Gaussian whose largest value exceeds 127 steps doubles its step as often as it takes: no value is clipped, and
    # all others keep the fine step.
    units = values / steps[:, :, None]
    largest = np.abs(units).max(axis=(0, 1), initial=0.0)
    exponent = np.ceil(np.log2(np.maximum(largest / _LARGEST, 1.0))).astype(np.uint8)
    units = np.rint(units / 2.0**exponent)
    return {
        f"{side}.values": np.clip(units, -_LARGEST, _LARGEST).astype(np.int8),
        f"{side}.step": steps.astype(np.float32),
        f"{side}.exponent": exponent,
    }


def usual_coefficients(student: Student, motion: BodyParams | None) -> dict[str, np.ndarray]:
    """Return the root mean square of each blend shape's coefficients, by side, which scales its quantisation steps.

    The body's are taken over the poses of the training, the head's over random expressions and the motion. The floor
    is a fifth of the largest.
    """
    shapes = student.blend_shapes
    assert shapes is not None
    # Quantisation errors are multiplied by the coefficients: the usual
    # coefficient turns a step of position or colour into a step of the shape.
    config, rng = shapes.config, np.random.default_rng(0)
    body = rng.normal(size=(64, config.pose_size)) * 0.2
    if student.pose_gate is not None:
        body = student.pose_gate.poses.cpu().numpy()
    elif motion is not None:
        body = motion.body_pose
    head = rng.uniform(0.0, 0.5, (256, config.head_inputs))
    if motion is not None and np.abs(motion.expression).max(initial=0.0) > 0.0:
        width = min(config.expression_size, motion.expression.shape[1])
        of_motion = np.zeros((len(motion), config.head_inputs))
        of_motion[:, :width] = motion.expression[:, :width]
        if config.jaw:
            of_motion[:, config.expression_size :] = motion.jaw_pose
        head = np.concatenate([head, of_motion])
    # Root mean square over samples and parts; a floor keeps seldom used shapes from becoming arbitrarily coarse.
    out = {}
    for side, inputs, network in (("head", head, shapes.head), ("body", body, shapes.body)):
        with torch.no_grad():
            z = network(torch.tensor(inputs, dtype=torch.float32, device=shapes.U.device))
            z = z.unflatten(1, (config.parts, -1))
        size = z.square().mean(dim=(0, 1)).sqrt().cpu().numpy()
        out[side] = np.maximum(size, max(0.2 * float(size.max(initial=0.0)), 1e-3))
    return out
