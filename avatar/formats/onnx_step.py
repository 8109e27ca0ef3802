"""Write a bundle's step as ONNX: pose, expression and code to Gaussians in the world, as `AvatarPlayer.pose` does."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from avatar.formats.onnx_graph import Graph
from avatar.runtime.bundle import AvatarBundle
from avatar.runtime.networks import DisplacementField, positional_encoding
from avatar.runtime.player import THICKNESS
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.spherical_harmonics import sh_basis


def write_onnx(path: str | Path, bundle: AvatarBundle) -> None:
    """Write the step of a bundle's avatar; a failed write leaves no file.

    Inputs, float32: `pose (J, 3)` axis-angle of all joints relative to their parents, hands complete (mean and PCA
    included), `transl (3)` metres, `expression (E)`, `eye (3)` the view point of the colours, and, if the student
    has a field and no regression for new poses, `code (Z)`, the null code by default. Outputs:
    `means (N, 3)`, `quats (N, 4)` wxyz, `scales (N, 3)`, `opacities (N)` and `colors (N, 3)`, sRGB towards the eye.

    Loose clothes follow field and skinning, without simulation. Triangles without area give NaN; the player gives them
    an arbitrary frame. Opset 17.

    Raises:
        MissingExtraError: onnx is not installed.
    """
    t, sizes, about = bundle.tensors, bundle.sizes, bundle.about
    g = Graph(about.name or "avatar")
    J, N, E = sizes["J"], sizes["N"], sizes["E"]
    pose, transl, expression = g.input("pose", J, 3), g.input("transl", 3), g.input("expression", E)
    eye = g.input("eye", 3)
    # T-pose with correctives and displacements, then skinning.
    transforms, rest = skeleton(g, bundle, pose, transl, expression)
    theta = g.reshape(g.gather(pose, np.arange(J)[1:22]), 1, 63)
    if "field" in bundle:
        rest = g("Add", rest, field(g, bundle, theta))
    posed = _skinned(g, bundle, rest, transforms)
    # Blend shapes add to position and colour; those of the body fade far from the training's poses.
    added = None
    if "blend" in bundle:
        jaw = [g.reshape(g.gather(pose, [22]), 1, 3)] if about.jaw else []
        face = g("Concat", g.reshape(expression, 1, E), *jaw, axis=1)
        sides = (
            blend_shapes(g, bundle, "head", face),
            blend_shapes(g, bundle, "body", theta, pose_similarity(g, bundle, theta)),
        )
        added = g("Add", *sides)
    means, quats, scales, dc, frames = world(g, bundle, posed, added)
    # Opacities are constants of the avatar; colours need the eye and the world frames of the triangles.
    outputs = {
        "means": (means, (N, 3)),
        "quats": (quats, (N, 4)),
        "scales": (scales, (N, 3)),
        "opacities": (g.constant(t["gaussians.opacities"]), (N,)),
        "colors": (colors(g, bundle, (means, frames, dc), eye), (N, 3)),
    }
    metadata = {
        "name": about.name,
        "licence": about.licence,
        "joint_names": " ".join(about.joint_names),
        "expression_names": " ".join(about.expression_names),
    }
    atomic_write_bytes(path, g.model(outputs, metadata))


def _skinned(g: Graph, bundle: AvatarBundle, rest: str, transforms: str) -> str:
    """Return the vertices after linear blend skinning (V, 3)."""
    t, V = bundle.tensors, bundle.sizes["V"]
    # x = sum_j w_j (R_j v + t_j): blend the (3, 4) matrices of the k joints of each vertex, then apply them to (v, 1).
    weights = t["surface.joint_weights"] / t["surface.joint_weights"].sum(axis=1, keepdims=True)
    joints = g.gather(transforms, t["surface.joint_indices"])  # (V, k, 12)
    blended = g.reshape(g.sum(g("Mul", joints, weights[:, :, None]), 1), V, 3, 4)
    ones = g("Concat", rest, np.ones((V, 1)), axis=1)
    return g.sum(g("Mul", blended, g.reshape(ones, V, 1, 4)), 2)


def skeleton(g: Graph, bundle: AvatarBundle, pose: str, transl: str, expression: str) -> tuple[str, str]:
    """Return the joints' transforms (J, 12), and T-pose vertices with expression and pose correctives (V, 3)."""
    # Local transforms: joints shaped by the expression, relative to their parents.
    t, J = bundle.tensors, bundle.sizes["J"]
    parents = t["skeleton.parents"]
    face = g.reshape(expression, bundle.sizes["E"], 1)
    moved = g("MatMul", t["skeleton.expression"].reshape(3 * J, -1), face)
    joints = g("Add", t["skeleton.joints"], g.reshape(moved, J, 3))
    turns = _rotations(g, pose, J)
    above = g.gather(joints, np.maximum(parents, 0))
    roots = (parents < 0)[:, None].astype(np.float32)
    # A joint's offset is its rest position relative to its parent's; the root has its own, moved by the translation.
    offsets = g("Add", g("Sub", joints, g("Mul", above, 1.0 - roots)), g("Mul", transl, roots))
    bottom = np.tile(np.eye(4, dtype=np.float32)[3], (J, 1, 1))
    local = g("Concat", g("Concat", turns, g.reshape(offsets, J, 3, 1), axis=2), bottom, axis=1)
    depth = np.zeros(J, int)
    for j in range(1, J):
        depth[j] = depth[parents[j]] + 1
    # Forward kinematics, one level of the tree at a time; `place` is the position of a joint among those done.
    done, place = g.gather(local, np.flatnonzero(depth == 0)), np.zeros(J, int)
    count = int((depth == 0).sum())
    for level in range(1, depth.max() + 1):
        own = np.flatnonzero(depth == level)
        new = g("MatMul", g.gather(done, place[parents[own]]), g.gather(local, own))
        done, place[own] = g("Concat", done, new, axis=0), count + np.arange(len(own))
        count += len(own)
    posed = g.gather(done, place)
    # Slices of the (J, 4, 4) matrices: axes 1 and 2 (the third constant) from the first to the second constant.
    R = g("Slice", posed, *(g.constant(v, np.int64) for v in ([0, 0], [3, 3], [1, 2])))
    at = g("Slice", posed, *(g.constant(v, np.int64) for v in ([0, 3], [3, 4], [1, 2])))
    # Transforms from the T-pose, and the expression and pose correctives.
    shift = g("Sub", at, g("MatMul", R, g.reshape(joints, J, 3, 1)))
    transforms = g.reshape(g("Concat", R, shift, axis=2), J, 12)
    # Pose correctives are linear in the entries of R_j - I of every joint but the root.
    features = g.reshape(g("Sub", g.gather(turns, np.arange(1, J)), np.eye(3)), 9 * (J - 1), 1)
    rest, V = g.constant(t["surface.vertices"]), bundle.sizes["V"]
    for name, drives in (("expression", face), ("pose", features)):
        basis = t.get(f"surface.{name}")
        if basis is not None and len(basis):
            own_rows = g.reshape(g("MatMul", basis.reshape(-1, basis.shape[2]), drives), len(basis), 3)
            rest = g("Add", rest, g.scatter(own_rows, t[f"surface.{name}_rows"], V, 3))
    return transforms, rest


def _rotations(g: Graph, pose: str, J: int) -> str:
    """Return matrices (J, 3, 3) of axis-angles by Rodrigues: `R = I + a K + b K^2`, as `matrix_from_rotvec`."""
    small = 1e-4  # squared angles below this use the series of sin(t) / t
    # a = sin(t) / t and b = (1 - cos t) / t^2 = (sin(t / 2) / (t / 2))^2 / 2, both of the squared angle.
    squared = g.sum(g("Mul", pose, pose), 1, keep=True)

    def sinc(square: str) -> str:
        # The series 1 - t^2 / 6 + t^4 / 120 is exact to float32 below
        # the limit; `Max` keeps the unused branch from dividing by 0.
        angle = g("Sqrt", g("Max", square, small))
        series = g("Sub", 1.0, g("Mul", square, g("Sub", 1.0 / 6.0, g("Mul", square, 1.0 / 120.0))))
        return g("Where", g("Less", square, small), series, g("Div", g("Sin", angle), angle))

    half = sinc(g("Mul", squared, 0.25))
    a, b = sinc(squared), g("Mul", 0.5, g("Mul", half, half))
    # K is linear in the axis-angle v: K w = v x w, written as one product with a constant (3, 9) matrix.
    cross = np.zeros((3, 3, 3), np.float32)
    for x, y, z in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        cross[x, z, y], cross[x, y, z] = 1.0, -1.0
    K = g.reshape(g("MatMul", pose, cross.reshape(3, 9)), J, 3, 3)
    of_a, of_b = (g("Mul", g.reshape(one, J, 1, 1), matrix) for one, matrix in ((a, K), (b, g("MatMul", K, K))))
    return g("Add", g("Add", of_a, of_b), np.eye(3))


def field(g: Graph, bundle: AvatarBundle, theta: str) -> str:
    """Return the displacements of the vertices (V, 3), interpolated from the field's control points."""
    t, sizes = bundle.tensors, bundle.sizes
    bundle_field = DisplacementField(bundle)
    neighbours, shares = bundle_field.interpolation
    if bundle_field.regression is not None:
        moved = _regress(g, bundle_field.regression, theta)
        return g.sum(g("Mul", g.gather(moved, neighbours), shares[:, :, None]), 1)
    # The networks of body and cloth, evaluated at the control points.
    code = g.input("code", sizes["Z"], default=bundle_field.null_code)
    sets = np.repeat(t["field.sets"], 3, axis=1)
    codes = g("Expand", g.reshape(code, 1, sizes["Z"]), g.constant([len(sets), sizes["Z"]], np.int64))
    frames = g("Concat", g("Mul", theta, sets), codes, axis=1)
    encodings = positional_encoding(t["field.points"], (sizes["X"] - 3) // 6)

    # As in `FieldKernel`, the part of the first layer that depends on the point alone is a constant of the graph.
    def network(name: str, rows: np.ndarray) -> str:
        own = {key.split(".", 2)[2]: value for key, value in t.items() if key.startswith(f"field.{name}.")}
        of_frame = g("Gemm", frames, own["of_frame.weight"], own["of_frame.bias"], transB=1)
        of_point = encodings[rows] @ own["of_point.weight"].T
        x = g("Relu", g("Add", g.gather(of_frame, t["field.member"][rows]), of_point))
        for weight, bias in zip(own["hidden.weight"], own["hidden.bias"], strict=True):
            x = g("Relu", g("Gemm", x, weight, bias, transB=1))
        return g("Gemm", x, own["last.weight"], own["last.bias"], transB=1)

    moved, cloth = network("body", np.arange(sizes["C"])), t["field.cloth"]
    if len(cloth):
        moved = g("Add", moved, g.scatter(network("cloth", cloth), cloth, sizes["C"], 3))
    return g.sum(g("Mul", g.gather(moved, neighbours), shares[:, :, None]), 1)


def _regress(g: Graph, regression: Mapping[str, np.ndarray], theta: str) -> str:
    """Return the control points' displacements (C, 3): `m + B A (clip(theta, low, high) - c)`."""
    held = g("Min", g("Max", theta, regression["low"]), regression["high"])
    turned = g.reshape(g("Sub", held, regression["center"]), len(regression["center"]), 1)
    level, basis = regression["level"], regression["basis"]
    moved = g("MatMul", basis.reshape(-1, basis.shape[2]), g("MatMul", regression["rows"], turned))
    return g("Add", level, g.reshape(moved, len(level), 3))


def pose_similarity(g: Graph, bundle: AvatarBundle, theta: str) -> str | None:
    """Return the similarity of a pose to the training's, 1 for a known pose; None if the bundle stores no poses."""
    poses = bundle.tensors.get("poses.known")
    if poses is None:
        return None
    # exp(-x^2 / 2) of the excess x of the distance to the nearest training pose over their usual one, as the player's.
    scale = float(bundle.tensors["poses.scale"])
    away = g("Sub", poses, theta)
    nearest = g("ReduceMin", g.sum(g("Mul", away, away), 1), axes=[0], keepdims=1)
    over = g("Relu", g("Div", g("Sub", g("Sqrt", nearest), scale), scale))
    return g("Exp", g("Mul", -0.5, g("Mul", over, over)))


def blend_shapes(g: Graph, bundle: AvatarBundle, side: str, drives: str, share: str | None = None) -> str:
    """Return the contribution of one side's blend shapes to position and colour (N, 6)."""
    t, N = bundle.tensors, bundle.sizes["N"]
    own = {key.split(".", 2)[2]: value for key, value in t.items() if key.startswith(f"blend.{side}.")}
    values, rows = own["values"], own.get("rows", np.arange(N))
    shapes, _, held = values.shape
    if not shapes or not held:
        return g.constant(np.zeros((N, 6)))
    # The network of the coefficients.
    x = g("Relu", g("Gemm", drives, own["first.weight"], own["first.bias"], transB=1))
    for weight, bias in zip(own["hidden.weight"], own["hidden.bias"], strict=True):
        x = g("Relu", g("Gemm", x, weight, bias, transB=1))
    x = g("Gemm", x, own["last.weight"], own["last.bias"], transB=1)
    if share is not None:
        x = g("Mul", x, share)
    steps = own.get("step", np.ones((shapes, 6), np.float32))
    scaled = g("Mul", g.reshape(x, len(own["last.bias"]) // shapes, shapes, 1), steps)
    part = t.get("blend.part")
    # (M, n, 6): coefficients of each row's part. Quantised values stay bytes in the file.
    scaled = g.gather(scaled, np.zeros(1) if part is None else part[rows])
    numbers = g("Cast", g.constant(values.transpose(2, 0, 1), values.dtype.type), to=1)
    added = g.sum(g("Mul", numbers, scaled), 1)
    if "exponent" in own:
        added = g("Mul", added, np.exp2(own["exponent"])[:, None])
    return g.scatter(added, rows, N, 6)


def world(g: Graph, bundle: AvatarBundle, posed: str, added: str | None) -> tuple[str, str, str, str, str]:
    """Return means, quats, scales and colours of the Gaussians, and their triangles' rotations (N, 3, 3)."""
    t, F, N = bundle.tensors, bundle.sizes["F"], bundle.sizes["N"]
    of = np.repeat(np.arange(F), t["gaussians.per_face"])
    faces = t["surface.faces"]
    # Corners and edges of the F triangles.
    v1, v2, v3 = (g.gather(posed, faces[:, k]) for k in range(3))
    a, b, c = g("Sub", v2, v1), g("Sub", v3, v1), g("Sub", v3, v2)
    # Frames of the triangles: normal, median and their cross product; mean edge lengths of at least a micrometre.
    normal, middle = _cross(g, a, b), g("Add", a, b)
    n, q = (g("Div", one, g.norm(one)) for one in (normal, middle))
    columns = [g.reshape(one, F, 3, 1) for one in (n, q, _cross(g, n, q))]
    R = g("Concat", *columns, axis=2)
    lengths = g("Add", g("Add", g.norm(a), g.norm(b)), g.norm(c))
    edge = g("Max", g("Div", lengths, 3.0), 1e-6)
    # Means: the barycentric point of the triangle plus the local offset in its frame, R (offset + blend shapes).
    u, v = t["gaussians.barycentric"].T
    weights = np.stack([u, v, 1.0 - u - v], axis=1)
    local, dc = g.constant(t["gaussians.offset"]), g.constant(t["gaussians.dc"])
    if added is not None:
        parts = g.split("Split", 2, added, g.constant([3, 3], np.int64), axis=1)
        local, dc = (g("Add", own, part) for own, part in zip((local, dc), parts, strict=True))
    # Means, scales and quaternions in the world.
    frames = g.gather(R, of)
    means = g.reshape(g("MatMul", frames, g.reshape(local, N, 3, 1)), N, 3)
    for corner, weight in zip((v1, v2, v3), weights.T, strict=True):
        means = g("Add", means, g("Mul", g.gather(corner, of), weight[:, None]))
    flat = np.full((N, 1), THICKNESS)
    scales = g("Mul", g.gather(edge, of), np.hstack([flat, np.exp(t["gaussians.log_scales"])]))
    # World rotation = triangle's rotation times the Gaussian's own, as a Hamilton product: all 16 products of
    # components times a constant (16, 4) matrix of signs.
    turns = g.reshape(g.gather(_quats(g, R, F), of), N, 4, 1)
    pairs = g.reshape(g("Mul", turns, t["gaussians.quats"][:, None, :]), N, 16)
    return means, g("MatMul", pairs, _hamilton()), scales, dc, frames


def colors(g: Graph, bundle: AvatarBundle, seen: tuple[str, str, str], eye: str) -> str:
    """Return colours towards a point (N, 3): `max(0, dc + sum_k sh_k Y_k(R^T d))`."""
    means, frames, dc = seen
    sh, N = bundle.tensors["gaussians.sh"], bundle.sizes["N"]
    if sh.shape[1]:
        away = g("Sub", means, eye)
        away = g.reshape(g("Div", away, g.norm(away)), N, 1, 3)
        x, y, z = g.split("Split", 3, g.reshape(g("MatMul", away, frames), N, 3), axis=1)
        basis = _harmonics(g, (x, y, z), sh.shape[1])
        dc = g("Add", dc, g.sum(g("Mul", g.reshape(basis, N, sh.shape[1], 1), sh), 1))
    return g("Relu", dc)


def _harmonics(g: Graph, xyz: tuple[str, str, str], count: int) -> str:
    """Return spherical harmonics of degree 1 and up (N, count) as linear combinations of monomials."""
    x, y, z = xyz
    # A constant 1 of the right shape, then monomials of degree 1 to 3 by one multiplication each.
    powers = {"": g("Add", g("Mul", x, 0.0), 1.0), "x": x, "y": y, "z": z}
    names = ["xx", "yy", "zz", "xy", "yz", "xz"] if count > 3 else []
    names += ["xxx", "xxy", "xxz", "xyy", "xyz", "xzz", "yyy", "yyz", "yzz", "zzz"] if count > 8 else []
    for name in names:
        powers[name] = g("Mul", powers[name[:-1]], powers[name[-1]])
    return g("MatMul", g("Concat", *powers.values(), axis=1), _coefficients(list(powers), count))


def _coefficients(names: list[str], count: int) -> np.ndarray:
    """Return the (monomials, harmonics) matrix by least squares, exact because harmonics are such polynomials."""
    # 200 random directions overdetermine the at most 20 coefficients of each harmonic.
    points = np.random.default_rng(0).normal(size=(200, 3))
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    monomials = np.stack([_product(directions, name) for name in names], axis=1)
    basis = sh_basis(directions, round((count + 1) ** 0.5) - 1)
    return np.linalg.lstsq(monomials, basis, rcond=None)[0]


def _product(directions: np.ndarray, name: str) -> np.ndarray:
    return np.prod([directions[:, "xyz".index(letter)] for letter in name] or [np.ones(len(directions))], axis=0)


def _cross(g: Graph, a: str, b: str) -> str:
    """Return the cross products of vectors (F, 3)."""
    orders = [g.constant(order, np.int32) for order in ([1, 2, 0], [2, 0, 1])]
    a1, a2, b1, b2 = (g("Gather", one, order, axis=1) for one in (a, b) for order in orders)
    return g("Sub", g("Mul", a1, b2), g("Mul", a2, b1))


def _quats(g: Graph, R: str, F: int) -> str:
    """Return unit quaternions wxyz (F, 4) from the best-conditioned row of `4 q q^T`, which is linear in the matrix."""
    # Entries of 4 q q^T as linear functions of the nine entries of R: the diagonal 1 +- R00 +- R11 +- R22 here, then
    # sums and differences of opposite entries.
    rows = np.zeros((9, 4, 4), np.float32)
    for k, signs in enumerate(((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))):
        rows[[0, 4, 8], k, k] = signs
    for i, j, plus, minus in ((0, 1, 7, 5), (0, 2, 2, 6), (0, 3, 3, 1)):
        rows[plus, [i, j], [j, i]], rows[minus, [i, j], [j, i]] = 1.0, -1.0
    for i, j, one, other in ((1, 2, 1, 3), (1, 3, 2, 6), (2, 3, 5, 7)):
        rows[one, [i, j], [j, i]] = rows[other, [i, j], [j, i]] = 1.0
    outer = g("Add", g("MatMul", g.reshape(R, F, 9), rows.reshape(9, 16)), np.eye(4).reshape(16))
    # The row with the largest diagonal entry belongs to the largest |q_k|; dividing by a small one would lose digits.
    diagonal = g("Gather", outer, g.constant([0, 5, 10, 15], np.int32), axis=1)
    best = g("Cast", g("ArgMax", diagonal, axis=1, keepdims=1), to=1)
    chosen = g("Cast", g("Equal", best, np.arange(4.0)[None]), to=1)
    row = g.sum(g("Mul", g.reshape(outer, F, 4, 4), g.reshape(chosen, F, 4, 1)), 1)
    return g("Div", row, g.norm(row))


def _hamilton() -> np.ndarray:
    """Return the (16, 4) matrix from products of two quaternions' components to their Hamilton product, wxyz."""
    out = np.zeros((4, 4, 4), np.float32)
    terms = (
        ((0, 0, 1), (1, 1, -1), (2, 2, -1), (3, 3, -1)),
        ((0, 1, 1), (1, 0, 1), (2, 3, 1), (3, 2, -1)),
        ((0, 2, 1), (1, 3, -1), (2, 0, 1), (3, 1, 1)),
        ((0, 3, 1), (1, 2, 1), (2, 1, -1), (3, 0, 1)),
    )
    for k, row in enumerate(terms):
        for i, j, sign in row:
            out[i, j, k] = sign
    return out.reshape(16, 4)
