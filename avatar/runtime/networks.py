"""Networks of a bundle: the displacement field at its control points, and the coefficients of its blend shapes."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int32

from avatar.runtime.bundle import AvatarBundle
from avatar.runtime.kernels import BlendKernel, FieldKernel, add_basis
from smplxpp.core.errors import InputError


class DisplacementField:
    """Displacements `dv_i = m_i S_c(g_i) + S_b(g_i)` at the control points, `g_i = phi(v_i) + theta + z_t`.

    With a regression in the bundle, poses without a code have `dv = m + B A (clip(theta, low, high) - c)` instead.
    """

    def __init__(self, bundle: AvatarBundle) -> None:
        t = bundle.tensors
        # Each control point depends on a set of joints: a mask over the
        # 21 joints, repeated for the three numbers of an axis-angle.
        self._sets = np.repeat(t["field.sets"], 3, axis=1).astype(np.float32)
        self._codes, about = t["field.codes"], bundle.about
        # A pose that training did not have takes the zero code where training showed it, else the first frame's code.
        self._row = {frame: row for row, frame in enumerate(about.frames)}
        self.null_code = np.zeros_like(self._codes[0]) if about.null_code_shown else self._codes[0]
        """Code of poses outside of the training."""
        # The networks of body and cloth, and the regression for new poses.
        encodings = positional_encoding(t["field.points"], (bundle.sizes["X"] - 3) // 6)
        member, cloth = t["field.member"], t["field.cloth"]

        def network(name: str) -> dict[str, np.ndarray]:
            prefix = f"field.{name}."
            return {key.removeprefix(prefix): value for key, value in t.items() if key.startswith(prefix)}

        self._body = FieldKernel(network("body"), encodings, member)
        self._cloth = FieldKernel(network("cloth"), encodings[cloth], member[cloth], cloth)
        self._moved = np.empty((bundle.sizes["C"], 3), np.float32)
        regression = {key.split(".")[1]: value for key, value in t.items() if key.startswith("regression.")}
        self.regression = regression or None
        """Tensors of the piece `regression`; None: poses without a code use the null code."""
        self._points = np.arange(bundle.sizes["C"], dtype=np.int32)
        # Quantised interpolation weights no longer sum to 1 exactly, so that they are normalised again.
        weights = t["field.weights"]
        self.interpolation: tuple[Int32[np.ndarray, "V n"], Float32[np.ndarray, "V n"]] = (
            t["field.neighbours"],
            weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12),
        )
        """Control points of each vertex, and their interpolation weights."""

    def code(self, frame: int | None) -> Float32[np.ndarray, " Z"] | None:
        """Return the code of a frame; None for a new pose where there is a regression, else the null code."""
        row = None if frame is None else self._row.get(frame)
        if row is None:
            return None if self.regression is not None else self.null_code
        return self._codes[row]

    def displacements(
        self, theta: Float32[np.ndarray, " 63"], frame: int | None, threads: int
    ) -> Float32[np.ndarray, "C 3"]:
        """Return the control points' displacements, metres; the next call overwrites them."""
        # The regression replaces the networks for every pose without a code of its own.
        code = self.code(frame)
        if code is None:
            assert self.regression is not None
            return self._regress(theta, **self.regression)
        # Inputs of each set: the angles of its joints (others 0), and the frame's code. The body's network writes all
        # control points, then the cloth's adds to those of clothes.
        frames = np.concatenate([theta * self._sets, np.broadcast_to(code, (len(self._sets), len(code)))], axis=1)
        frames = np.ascontiguousarray(frames, dtype=np.float32)
        self._body(frames, self._moved, threads)
        self._cloth(frames, self._moved, threads)
        return self._moved

    def _regress(
        self,
        theta: Float32[np.ndarray, " 63"],
        *,
        level: Float32[np.ndarray, "C 3"],
        basis: Float32[np.ndarray, "C 3 a"],
        rows: Float32[np.ndarray, "a 63"],
        center: Float32[np.ndarray, " 63"],
        low: Float32[np.ndarray, " 63"],
        high: Float32[np.ndarray, " 63"],
    ) -> Float32[np.ndarray, "C 3"]:
        # Clamping the angles to the range of the training bounds the extrapolation, which is linear in them.
        self._moved[:] = level
        add_basis(self._moved, self._points, basis, rows @ (np.clip(theta, low, high) - center))
        return self._moved


def positional_encoding(points: Float32[np.ndarray, "C 3"], frequencies: int) -> Float32[np.ndarray, "C X"]:
    """Return `phi(v) = (v, sin(2^l pi v), cos(2^l pi v) for l < L)`."""
    # Frequencies double from band to band, as in NeRF (Mildenhall
    # et al. 2020), so that a smooth network can represent detail.
    bands = np.float32(np.pi) * 2.0 ** np.arange(frequencies, dtype=np.float32)
    angles = (points[:, None, :] * bands[:, None]).reshape(len(points), -1).astype(np.float32)
    return np.concatenate([points, np.sin(angles), np.cos(angles)], axis=1).astype(np.float32)


class BlendShapes:
    """Blend shapes of the head or of the body: the network of their coefficients, and the kernel that adds them.

    Args:
        bundle: the avatar.
        side: "head" or "body".
    """

    def __init__(self, bundle: AvatarBundle, side: str) -> None:
        # A multilayer perceptron: a first layer, hidden layers with ReLU, and
        # a linear last one, whose outputs are the coefficients of every part.
        prefix = f"blend.{side}."
        own = {name.removeprefix(prefix): value for name, value in bundle.tensors.items() if name.startswith(prefix)}
        self._side, self._shapes = side, own["values"].shape[0]
        hidden = zip(own["hidden.weight"], own["hidden.bias"], strict=True)
        self._layers = [
            (own["first.weight"], own["first.bias"]),
            *hidden,
            (own["last.weight"], own["last.bias"]),
        ]
        # `rows` are the Gaussians that this side moves; each part of the Gaussians has coefficients of its own.
        rows, part = own.get("rows"), bundle.tensors.get("blend.part")
        if part is not None and rows is not None:
            part = part[rows]
        self._kernel = BlendKernel(
            own["values"], own.get("step"), own.get("exponent"), rows, part, count=bundle.sizes["N"]
        )

    def coefficients(self, inputs: Float32[np.ndarray, " i"]) -> Float32[np.ndarray, "parts n"]:
        """Return the coefficients of every part for the inputs of the network."""
        first = self._layers[0][0]
        if first.shape[1] != len(inputs):
            raise InputError(
                f"inputs of the blend shapes of the {self._side}",
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
        """Add the contribution of the shapes to position and colour, in place.

        Args:
            inputs: of the network.
            known: factor of the coefficients, the similarity of the pose to the training's.
            keep: factor of each Gaussian; None: 1.
            added: position and colour, changed in place.
            threads: of the kernel.
        """
        if self._shapes and known > 0.0:
            self._kernel(np.float32(known) * self.coefficients(inputs), keep, added, threads)
