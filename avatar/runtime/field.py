"""The field of a bundle: displacements at its control points, which the surface's kernel interpolates."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Int32

from avatar.runtime.bundle import AvatarBundle
from avatar.runtime.kernels import FieldKernel, add_basis


class Field:
    """`dv_i = m_i S_c(g_i) + S_b(g_i)` at the control points, `g_i = phi(v_i) + theta + z_t`.

    Where the bundle has a regression, poses without a code have `dv = m + B A (clip(theta, low, high) - c)` instead.
    """

    def __init__(self, bundle: AvatarBundle) -> None:
        t = bundle.tensors
        self._sets = np.repeat(t["field.sets"], 3, axis=1).astype(np.float32)
        self._codes, about = t["field.codes"], bundle.about
        self._row = {frame: row for row, frame in enumerate(about.frames)}
        self.null_code = np.zeros_like(self._codes[0]) if about.null_code_shown else self._codes[0]
        """Of poses that training did not see."""
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
        """Tensors of the piece `regression`; None: poses without a code have the null code."""
        self._points = np.arange(bundle.sizes["C"], dtype=np.int32)
        weights = t["field.weights"]
        self.interpolation: tuple[Int32[np.ndarray, "V n"], Float32[np.ndarray, "V n"]] = (
            t["field.neighbours"],
            weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12),
        )
        """Control points of each vertex, and their weights."""

    def displacements(
        self, theta: Float32[np.ndarray, " 63"], frame: int | None, threads: int
    ) -> Float32[np.ndarray, "C 3"]:
        """Return the control points' displacements, metres; the next call writes them anew."""
        row = None if frame is None else self._row.get(frame)
        if row is None and self.regression is not None:
            return self._regressed(theta, **self.regression)
        code = self.null_code if row is None else self._codes[row]
        frames = np.concatenate([theta * self._sets, np.broadcast_to(code, (len(self._sets), len(code)))], axis=1)
        frames = np.ascontiguousarray(frames, dtype=np.float32)
        self._body(frames, self._moved, threads)
        self._cloth(frames, self._moved, threads)
        return self._moved

    def _regressed(
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
        self._moved[:] = level
        add_basis(self._moved, self._points, basis, rows @ (np.clip(theta, low, high) - center))
        return self._moved


def positional_encoding(points: Float32[np.ndarray, "C 3"], frequencies: int) -> Float32[np.ndarray, "C X"]:
    """Return `phi(v) = (v, sin(2^l pi v), cos(2^l pi v) for l < L)`."""
    bands = np.float32(np.pi) * 2.0 ** np.arange(frequencies, dtype=np.float32)
    angles = (points[:, None, :] * bands[:, None]).reshape(len(points), -1).astype(np.float32)
    return np.concatenate([points, np.sin(angles), np.cos(angles)], axis=1).astype(np.float32)
