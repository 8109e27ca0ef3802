"""Differentiable operations on tensors: quaternions (w, x, y, z), rotation matrices, rows by index."""

from __future__ import annotations

import torch
from jaxtyping import Float, Int
from torch import Tensor


def quat_from_matrix(matrix: Float[Tensor, "*B 3 3"]) -> Float[Tensor, "*B 4"]:
    """Return unit quaternions wxyz of rotation matrices; their sign is free.

    `4 q q^T` is linear in the matrix. The row of its largest diagonal entry, normalised, is q. That entry is at
    least 1, so value and gradient are well conditioned everywhere (Shepperd 1978, without the branches).
    """
    # Matrix [[a, b, c], [d, e, f], [g, h, i]]: differences across the diagonal give 4 w (x, y, z), sums 4 xy, 4 xz, 4
    # yz.
    a, b, c, d, e, f, g, h, i = matrix.flatten(-2).unbind(-1)
    wx, wy, wz, xy, xz, yz = h - f, c - g, d - b, b + d, c + g, f + h
    diagonal = (1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i)
    ww, xx, yy, zz = diagonal
    rows = ((ww, wx, wy, wz), (wx, xx, xy, xz), (wy, xy, yy, yz), (wz, xz, yz, zz))
    outer = torch.stack([torch.stack(row, -1) for row in rows], -2)
    # The diagonal of 4 q q^T holds 4 w^2, 4 x^2, 4 y^2, 4 z^2; the largest keeps the division away from 0.
    best = torch.stack(diagonal, -1).argmax(-1)
    row = outer.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    return row / row.norm(dim=-1, keepdim=True)


def matrix_from_quat(quat: Float[Tensor, "*B 4"]) -> Float[Tensor, "*B 3 3"]:
    """Return the rotation matrices of quaternions wxyz of any length but zero."""
    w, x, y, z = (quat / quat.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def multiply_quats(a: Float[Tensor, "*#B 4"], b: Float[Tensor, "*#B 4"]) -> Float[Tensor, "*B 4"]:
    """Return the Hamilton product of quaternions wxyz: rotate by `b` first, then by `a`."""
    aw, ax, ay, az = a.unbind(-1)
    bw, bx, by, bz = b.unbind(-1)
    return torch.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        -1,
    )


def gather_rows(values: Float[Tensor, "V ..."], index: Int[Tensor, "*N"]) -> Tensor:
    """Return `values[index]`, with a deterministic backward pass.

    On the CPU the gradients of `values[index]` are summed in an order that depends on thread timing; those of
    `index_select` are not.
    """
    return values.index_select(0, index.flatten()).view(*index.shape, *values.shape[1:])
