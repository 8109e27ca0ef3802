"""Penalties on bound Gaussians."""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from avatar.gaussians.binding import offset_penalty, scale_penalty
from avatar.gaussians.frames import triangle_frames
from tests.gaussians.bound_scenes import random_bound, sphere


def small_gaussians():
    vertices, faces = sphere()
    bound = random_bound(faces, count=10)
    return replace(bound, log_scales=torch.full((10, 2), math.log(0.5)).double()), triangle_frames(vertices, faces)


def test_small_and_near_gaussians_are_free():
    bound, frames = small_gaussians()
    assert scale_penalty(bound) == 0 and offset_penalty(bound, frames) == 0


def test_large_scales_are_penalised_by_what_they_exceed():
    bound, _ = small_gaussians()
    log_scales = bound.log_scales.clone()
    log_scales[0] = torch.log(torch.tensor([0.6 + 3.0, 0.6 + 4.0]))
    torch.testing.assert_close(scale_penalty(replace(bound, log_scales=log_scales)), torch.tensor(0.5).double())


def test_far_gaussians_are_penalised_in_edge_lengths():
    bound, frames = small_gaussians()
    edge = frames.lengths[bound.face_index]
    # Half of the way along the normal by gamma, half by the offset.
    offset = torch.zeros_like(bound.offset)
    offset[0, 0] = 1.5 * edge[0]
    gamma = torch.zeros_like(bound.normal_offset)
    gamma[0] = 1.5 * edge[0]
    far = replace(bound, offset=offset, normal_offset=gamma)
    torch.testing.assert_close(offset_penalty(far, frames), torch.tensor(0.01 * 2.0 / 10).double())


def test_gradients_pull_back_and_stay_finite_at_rest():
    bound, frames = small_gaussians()
    offset = torch.zeros_like(bound.offset)
    offset[0, 1] = 10.0
    offset.requires_grad_(True)
    log_scales = torch.full_like(bound.log_scales, math.log(0.6)).index_fill(0, torch.tensor([2]), 1.0)
    log_scales.requires_grad_(True)
    still = replace(bound, offset=offset, log_scales=log_scales, normal_offset=torch.zeros_like(bound.normal_offset))
    (offset_penalty(still, frames) + scale_penalty(still)).backward()
    assert offset.grad[0, 1] > 0 and not offset.grad[1:].any()
    assert (log_scales.grad[2] > 0).all() and torch.isfinite(log_scales.grad).all()
