"""One substep of cloth in float64 and plain numpy, written from the equations in docs/cloth.md, without contacts."""

from __future__ import annotations

import numpy as np

from smplxpp.cloth.model import ClothModel, Fabric

GRAVITY = 9.81


def substep(
    model: ClothModel, fabric: Fabric, x: np.ndarray, v: np.ndarray, place: np.ndarray, h: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return (n, 3) positions and velocities `h` seconds on, the held particles at their places."""
    w, before = model.inverse_mass.astype(float), x.copy()
    loose = w > 0
    v = _through_air(model, fabric, x, v, h)
    x = np.where(loose[:, None], x + h * v, place)
    for (i, j), rest, pulled, pushed in zip(
        model.edges, model.lengths.astype(float), model.stretch, model.compress, strict=True
    ):
        d = x[i] - x[j]
        error = np.linalg.norm(d) - rest
        soft = float(pushed if error < 0 else pulled) / h**2
        step = d / np.linalg.norm(d) * error / (w[i] + w[j] + soft)
        x[i] -= w[i] * step
        x[j] += w[j] * step
    for corners, c, rest, soft in zip(
        model.hinges, model.curvature.astype(float), model.rest_curvature, model.bend, strict=True
    ):
        a, b, left, right = x[corners]
        n = np.cross(b - a, left - a) + np.cross(right - a, b - a)
        n /= np.linalg.norm(n)
        error = c @ x[corners] @ n - rest
        x[corners] -= np.outer(w[corners] * c, n) * error / (w[corners] @ c**2 + soft / h**2)
    if model.spring is not None:
        soft = np.where(loose, model.spring / h**2, np.inf)
        x = x + (place - x) * (w / (w + soft))[:, None]
    for i in np.flatnonzero(loose & (model.anchor >= 0)):
        d = x[i] - x[model.anchor[i]]
        x[i] -= d * max(0.0, 1.0 - model.tether[i] / np.linalg.norm(d))
    v = (x - before) / h
    for i, j in model.edges:
        d = (v[i] - v[j]) * fabric.inner_friction * h / (w[i] + w[j])
        v[i] -= w[i] * d
        v[j] += w[j] * d
    return x, v


def _through_air(model: ClothModel, fabric: Fabric, x: np.ndarray, v: np.ndarray, h: float) -> np.ndarray:
    normal = np.zeros_like(x)
    for face in model.faces:
        normal[face] += np.cross(x[face[1]] - x[face[0]], x[face[2]] - x[face[0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    across = 1.0 - 1.0 / (1.0 + fabric.normal_drag * h)
    v = v - across * np.einsum("ni,ni->n", v, normal)[:, None] * normal
    return (v - [0.0, GRAVITY * h, 0.0]) / (1.0 + fabric.drag * h)
