"""Rows of a tensor by index, with a backward pass that adds up in one order."""

from __future__ import annotations

from jaxtyping import Float, Int
from torch import Tensor


def gather_rows(values: Float[Tensor, "V ..."], index: Int[Tensor, "*N"]) -> Tensor:
    """Return `values[index]`, whose gradients are the same bits each time.

    On the CPU the gradients of `values[index]` are added up in the order in which threads happen to come; those of
    `index_select` are not.
    """
    return values.index_select(0, index.flatten()).view(*index.shape, *values.shape[1:])
