"""A bundle's step as ONNX: joints, expression and code to Gaussians in the world, as `AvatarPlayer.pose` makes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from avatar.formats.onnx_graph import Graph
from avatar.formats.onnx_parts import blend_shapes, colors, field, known, skeleton, world
from avatar.runtime.bundle import AvatarBundle
from smplxpp.core.files.atomic import atomic_write_bytes

_BODY = slice(1, 22)  # joints of theta


def write_onnx(path: str | Path, bundle: AvatarBundle) -> None:
    """Write the step of a bundle's avatar, whole or not at all.

    Inputs, float32: `pose (J, 3)` axis-angle of all joints relative to their parents, hands complete (mean and PCA
    included), `transl (3)` metres, `expression (E)`, `eye (3)` the point that colours are seen from, and, where the
    student has a field and no regression for new poses, `code (Z)`, which may be left out: the null code. Outputs:
    `means (N, 3)`, `quats (N, 4)` wxyz, `scales (N, 3)`, `opacities (N)` and `colors (N, 3)`, sRGB towards the eye.

    Loose clothes are where field and skinning have them. Triangles without area, which the runtime gives some frame,
    give NaN here. Opset 17.

    Raises:
        MissingExtraError: no onnx.
    """
    t, sizes, about = bundle.tensors, bundle.sizes, bundle.about
    g = Graph(about.name or "avatar")
    J, N, E = sizes["J"], sizes["N"], sizes["E"]
    pose, transl, expression = g.input("pose", J, 3), g.input("transl", 3), g.input("expression", E)
    eye = g.input("eye", 3)
    transforms, rest = skeleton(g, bundle, pose, transl, expression)
    theta = g.reshape(g.gather(pose, np.arange(J)[_BODY]), 1, 63)
    if "field" in bundle:
        rest = g("Add", rest, field(g, bundle, theta))
    posed = _skinned(g, bundle, rest, transforms)
    added = None
    if "blend" in bundle:
        jaw = [g.reshape(g.gather(pose, [22]), 1, 3)] if about.jaw else []
        face = g("Concat", g.reshape(expression, 1, E), *jaw, axis=1)
        sides = (blend_shapes(g, bundle, "head", face), blend_shapes(g, bundle, "body", theta, known(g, bundle, theta)))
        added = g("Add", *sides)
    means, quats, scales, dc, frames = world(g, bundle, posed, added)
    outputs = {
        "means": (means, (N, 3)),
        "quats": (quats, (N, 4)),
        "scales": (scales, (N, 3)),
        "opacities": (g.constant(t["gaussians.opacities"]), (N,)),
        "colors": (colors(g, bundle, (means, frames, dc), eye), (N, 3)),
    }
    said = {
        "name": about.name,
        "licence": about.licence,
        "joint_names": " ".join(about.joint_names),
        "expression_names": " ".join(about.expression_names),
    }
    atomic_write_bytes(path, g.model(outputs, said))


def _skinned(g: Graph, bundle: AvatarBundle, rest: str, transforms: str) -> str:
    """Return posed vertices (V, 3)."""
    t, V = bundle.tensors, bundle.sizes["V"]
    weights = t["surface.joint_weights"] / t["surface.joint_weights"].sum(axis=1, keepdims=True)
    joints = g.gather(transforms, t["surface.joint_indices"])  # (V, k, 12)
    blended = g.reshape(g.sum(g("Mul", joints, weights[:, :, None]), 1), V, 3, 4)
    ones = g("Concat", rest, np.ones((V, 1)), axis=1)
    return g.sum(g("Mul", blended, g.reshape(ones, V, 1, 4)), 2)
