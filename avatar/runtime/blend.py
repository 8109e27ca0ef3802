"""Blend shapes of a bundle: the network that gives their coefficients, and the kernel that adds them."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32

from avatar.runtime.bundle import AvatarBundle
from avatar.runtime.kernels import BlendKernel
from smplxpp.core.errors import InputError


class BlendSide:
    """The head's or the body's blend shapes.

    Args:
        side: "head" or "body".
    """

    def __init__(self, bundle: AvatarBundle, side: str) -> None:
        prefix = f"blend.{side}."
        own = {name.removeprefix(prefix): value for name, value in bundle.tensors.items() if name.startswith(prefix)}
        self._side, self._shapes = side, own["values"].shape[0]
        hidden = zip(own["hidden.weight"], own["hidden.bias"], strict=True)
        self._layers = [
            (own["first.weight"], own["first.bias"]),
            *hidden,
            (own["last.weight"], own["last.bias"]),
        ]
        rows, part = own.get("rows"), bundle.tensors.get("blend.part")
        if part is not None and rows is not None:
            part = part[rows]
        self._kernel = BlendKernel(
            own["values"], own.get("step"), own.get("exponent"), rows, part, count=bundle.sizes["N"]
        )

    def coefficients(self, inputs: Float32[np.ndarray, " i"]) -> Float32[np.ndarray, "parts n"]:
        """Return the coefficients of every part."""
        first = self._layers[0][0]
        if first.shape[1] != len(inputs):
            raise InputError(
                f"what drives the blend shapes of the {self._side}",
                expected=f"{first.shape[1]} numbers",
                received=str(len(inputs)),
            )
        x = inputs
        for weight, bias in self._layers[:-1]:
            x = np.maximum(weight @ x + bias, 0.0)
        weight, bias = self._layers[-1]
        return (weight @ x + bias).reshape(-1, self._shapes)

    def add(
        self,
        inputs: Float32[np.ndarray, " i"],
        known: float,
        keep: Float32[np.ndarray, " N"] | None,
        added: Float32[np.ndarray, "N 6"],
        threads: int,
    ) -> None:
        """Add what the shapes move, in place.

        Args:
            known: share of all. keep: share of each Gaussian; None: all of it.
        """
        if self._shapes and known > 0.0:
            self._kernel(np.float32(known) * self.coefficients(inputs), keep, added, threads)
