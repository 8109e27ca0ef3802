"""Define and check the tensors of a bundle: kind and shape by piece and name; docs/runtime.md describes them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from smplxpp.body.layout import JOINT_NAMES
from smplxpp.core.errors import InputError
from smplxpp.core.labels import LABELS
from smplxpp.core.params import LARGEST_PARAMETER

if TYPE_CHECKING:
    from avatar.runtime.bundle import AboutAvatar

REMEDY = "export the avatar again with `smplxpp export RUN --out NAME.avatar`"

# Piece -> tensor -> kind, shape, bound. Kinds: f floats (or integers with a step), i integers, q integers kept with
# their steps, or floats. Letters are sizes, the same in all pieces. `<J` bounds indices. A question mark marks an
# optional tensor.
_NETWORK = {
    "of_point.weight": "f W X",
    "of_frame.weight": "f W Y",
    "of_frame.bias": "f W",
    "hidden.weight": "f H W W",
    "hidden.bias": "f H W",
    "last.weight": "f 3 W",
    "last.bias": "f 3",
}
_SHAPES = {
    "rows": "i? {m} <N",
    "values": "q {n} 6 {m}",
    "step": "f? {n} 6",
    "exponent": "i? {m}",
    "first.weight": "f {w} {i}",
    "first.bias": "f {w}",
    "hidden.weight": "f {h} {w} {w}",
    "hidden.bias": "f {h} {w}",
    "last.weight": "f {o} {w}",
    "last.bias": "f {o}",
}


def _shapes(side: str) -> dict[str, str]:
    letters = {letter: f"{side}_{letter}" for letter in "mnwiho"}
    return {f"{side}.{name}": spec.format(**letters) for name, spec in _SHAPES.items()}


PIECES: Mapping[str, Mapping[str, str]] = {
    "skeleton": {
        "parents": "i J",
        "joints": "f J 3",
        "expression": "f J 3 E",
        "left_hand_mean": "f? 45",
        "right_hand_mean": "f? 45",
        "left_hand_components": "f? l 45",
        "right_hand_components": "f? r 45",
    },
    "surface": {
        "vertices": "f V 3",
        "faces": "i F 3 <V",
        "parts": "i V",
        "labels": "i V",
        "colors": "i V 3",
        "joint_indices": "i V k <J",
        "joint_weights": "f V k",
        "expression_rows": "i R <V",
        "expression": "f R 3 E",
        "pose_rows": "i? Q <V",
        "pose": "f? Q 3 P",
    },
    "gaussians": {
        "per_face": "i F",
        "barycentric": "f N 2",
        "offset": "f N 3",
        "log_scales": "f N 2",
        "quats": "f N 4",
        "opacities": "f N",
        "dc": "f N 3",
        "sh": "f N K 3",
        "covered": "i? N",
        "bare_offset": "f? N 3",
        "bare_quats": "f? N 4",
        "bare_scale": "f? N",
        "bare_dc": "f? N 3",
    },
    "field": {
        "points": "f C 3",
        "neighbours": "i V n <C",
        "weights": "f V n",
        "cloth": "i c <C",
        "sets": "i S 21",
        "member": "i C <S",
        "codes": "f T Z",
        **{f"{net}.{name}": spec for net in ("body", "cloth") for name, spec in _NETWORK.items()},
    },
    "regression": {
        "level": "f C 3",
        "basis": "f C 3 a",
        "rows": "f a 63",
        "center": "f 63",
        "low": "f 63",
        "high": "f 63",
    },
    "blend": {**_shapes("head"), **_shapes("body"), "part": "i? N"},
    "poses": {"known": "f D 63", "scale": "f"},
}
"""Tensors of all pieces; `garments` and `motion` have their own readers."""
BARE = ("bare_offset", "bare_quats", "bare_scale", "bare_dc")
"""Tensors of the piece `gaussians` that say how skin lies bare whose clothes a player takes off."""
NEEDED = ("skeleton", "surface", "gaussians")
MAX_GAUSSIANS = 1 << 22


def decode(tensors: Mapping[str, np.ndarray], piece: str, subject: str) -> dict[str, np.ndarray]:
    """Decode the tensors of a piece: floats to float32, integers to `step q + start`, indices to int32.

    Raises:
        InputError: a tensor of another kind, an unknown tensor, numbers that are not finite.
    """
    known = PIECES[piece]
    left = dict(tensors)
    out: dict[str, np.ndarray] = {}
    for name, spec in known.items():
        value = left.pop(name, None)
        if value is None:
            continue
        # Steps and offsets of quantised floats are tensors beside them.
        kind = spec[0]
        step, start = (left.pop(f"{name}.{word}", None) for word in ("step", "start")) if kind == "f" else (None, None)
        # Indices stay integers; int8 blend shapes stay quantised,
        # because the kernel reads them so; all else becomes float32.
        if kind == "i":
            wrong = value.dtype.kind not in "iu"
        else:
            wrong = value.dtype.kind != "f" and ((kind == "f" and step is None) or value.dtype.kind not in "iu")
        if wrong:
            raise InputError(
                f"{subject}: {name}",
                expected="integers" if kind == "i" else "floats",
                received=str(value.dtype),
                remedy=REMEDY,
            )
        if kind == "i":
            out[name] = _indices(value, f"{subject}: {name}")
        elif kind == "q" and value.dtype == np.int8:
            out[name] = value
        else:
            out[name] = _floats(value, step, start, f"{subject}: {name}")
    # A tensor without a specification is refused: a newer version may have given it a meaning.
    if left:
        raise InputError(
            subject, expected="the tensors of its version", received=", ".join(sorted(left))[:200], remedy=REMEDY
        )
    return out


def check_shapes(tensors: Mapping[str, np.ndarray], pieces: tuple[str, ...], subject: str) -> dict[str, int]:
    """Check the shapes and indices of all tensors against `PIECES`.

    Args:
        tensors: by "piece.name", decoded.
        pieces: pieces of the bundle.
        subject: name of the file in errors.

    Returns:
        The sizes by letter.

    Raises:
        InputError: a missing tensor, a wrong shape, or an index out of range.
    """
    # The first tensor with a letter defines its size. Bounds are checked last, when all sizes are known.
    sizes: dict[str, int] = {}
    bounds: list[tuple[str, str]] = []
    for piece in pieces:
        for name, spec in PIECES[piece].items():
            # A specification is a kind and one size for each axis, with a bound of indices last.
            kind, *letters = spec.split()
            full = f"{piece}.{name}"
            if letters and letters[-1].startswith("<"):
                bounds.append((full, letters.pop()[1:]))
            value = tensors.get(full)
            if value is None:
                if not kind.endswith("?"):
                    raise InputError(subject, expected=f"a tensor {full}", received="none", remedy=REMEDY)
                continue
            # A number is a fixed size; a letter that an earlier tensor defined must have the same size here.
            wanted = tuple(int(one) if one.isdigit() else sizes.get(one) for one in letters)
            if len(wanted) != value.ndim or any(a not in (None, b) for a, b in zip(wanted, value.shape, strict=True)):
                raise InputError(
                    f"{subject}: {full}",
                    expected=f"shape ({', '.join('any' if n is None else str(n) for n in wanted)})",
                    received=f"{value.shape}",
                    remedy=REMEDY,
                )
            sizes |= {one: n for one, n in zip(letters, value.shape, strict=True) if not one.isdigit()}
    for full, letter in bounds:
        value = tensors.get(full)
        if value is not None and value.size and (value.min() < 0 or value.max() >= sizes[letter]):
            raise InputError(
                f"{subject}: {full}",
                expected=f"indices below {sizes[letter]}",
                received=f"{value.min()} to {value.max()}",
                remedy=REMEDY,
            )
    return sizes


def check_consistency(
    about: AboutAvatar, tensors: Mapping[str, np.ndarray], sizes: Mapping[str, int], subject: str
) -> None:
    """Check the values of tensors, and their agreement with the description, where shapes do not suffice.

    Raises:
        InputError: a value out of bounds, or one that contradicts another.
    """

    def require(condition: bool, what: str, expected: str, received: object) -> None:
        if not condition:
            raise InputError(f"{subject}: {what}", expected=expected, received=str(received)[:200], remedy=REMEDY)

    # Skeleton, then Gaussians, surface, field, regression and blend shapes.
    parents, faces, count = tensors["skeleton.parents"], tensors["gaussians.per_face"], sizes["N"]
    require(sizes["J"] in JOINT_NAMES, "joints", f"{' or '.join(map(str, JOINT_NAMES))} of them", sizes["J"])
    for place in ("skeleton.joints", "surface.vertices"):
        near = bool((np.abs(tensors[place]) <= LARGEST_PARAMETER).all())
        require(near, place, f"metres up to {LARGEST_PARAMETER:g}", "others")
    # Forward kinematics goes through the joints once, and needs each parent before its children.
    ordered = parents[0] == -1 and bool((parents[1:] >= 0).all() and (parents[1:] < np.arange(1, sizes["J"])).all())
    require(ordered, "skeleton.parents", "the root first, every parent before its children", parents.tolist())
    for what, names, letter in (
        ("joint_names", about.joint_names, "J"),
        ("expression_names", about.expression_names, "E"),
    ):
        require(len(names) == sizes[letter], what, f"{sizes[letter]} names", len(names))
    require(0 < count <= MAX_GAUSSIANS, "gaussians", f"1 to {MAX_GAUSSIANS}", count)
    require(
        bool((faces >= 0).all()) and int(faces.sum()) == count, "gaussians.per_face", f"counts of {count}", "others"
    )
    # Spherical harmonics of degree 1 to d have (d + 1)^2 - 1 coefficients.
    require(sizes["K"] in (0, 3, 8, 15), "gaussians.sh", "0, 3, 8 or 15 coefficients", sizes["K"])
    # Rotations are normalised, for which a length needs a square in float32.
    for name in ("gaussians.quats", "gaussians.bare_quats"):
        lengths = np.sqrt(np.square(tensors.get(name, np.ones((1, 4))), dtype=np.float64).sum(1))
        usable = bool(((lengths > 1e-3) & (lengths < 1e3)).all())
        require(usable, name, "lengths from 0.001 to 1000", "others")
    covered = tensors.get("gaussians.covered", np.zeros(1, np.int32))
    within = bool(((covered >= 0) & (covered < max(1, len(about.part_names)))).all())
    require(within, "gaussians.covered", f"parts in [0, {len(about.part_names)})", "others")
    # Older bundles name the part that hides a Gaussian, but not how it lies bare.
    bare = [f"gaussians.{name}" in tensors for name in BARE]
    require(not any(bare) or all((*bare, "gaussians.covered" in tensors)), "gaussians.bare_*", "all or none", "some")
    positive = bool((tensors.get("gaussians.bare_scale", np.ones(1)) > 0.0).all())
    require(positive, "gaussians.bare_scale", "positive numbers", "others")
    # Weights are stored in 16 bits, and may miss a sum of 1 by rounding.
    opacity, weights = tensors["gaussians.opacities"], tensors["surface.joint_weights"]
    require(bool((opacity >= 0).all() and (opacity <= 1).all()), "gaussians.opacities", "values in [0, 1]", "others")
    sums = weights.sum(1)
    positive = bool((weights >= 0).all() and (np.abs(sums - 1.0) < 0.01).all())
    require(positive, "surface.joint_weights", "rows that sum to 1", "others")
    for name, most in (("parts", len(about.part_names)), ("labels", len(LABELS.items)), ("colors", 256)):
        value = tensors[f"surface.{name}"]
        require(
            not value.size or (value.min() >= 0 and value.max() < most),
            f"surface.{name}",
            f"values in [0, {most})",
            "others",
        )
    # The skin's vertices come first, since expressions and pose correctives index them alone.
    body_first = bool((np.diff(tensors["surface.parts"]) >= 0).all())
    require(body_first, "surface.parts", "the parts one after the other", "another order")
    skin = int((tensors["surface.parts"] == 0).sum())
    for basis in ("expression_rows", "pose_rows"):
        rows = tensors.get(f"surface.{basis}", np.empty(0, np.int32))
        indexes_skin = bool((np.diff(rows) > 0).all()) and rows.max(initial=-1) < skin
        require(indexes_skin, f"surface.{basis}", f"increasing indices below {skin}", "others")
    both = "surface.pose" in tensors, "surface.pose_rows" in tensors
    require(both[0] == both[1], "surface.pose", "correctives with their vertices, or neither", "one of the two")
    if "P" in sizes:
        require(sizes["P"] == 9 * (sizes["J"] - 1), "surface.pose", f"{9 * (sizes['J'] - 1)} directions", sizes["P"])
    # A positional encoding has 3 + 6 L numbers: the point, and L sines and cosines of three coordinates.
    if "field.points" in tensors:
        bands, inputs = sizes["X"] - 3, 63 + sizes["Z"]
        require(bands % 6 == 0 and 0 <= bands <= 96, "field", "bands of sines and cosines", f"{bands} inputs")
        require(sizes["Y"] == inputs, "field of_frame", f"{inputs} inputs", sizes["Y"])
        require(sizes["T"] == len(about.frames) > 0, "field.codes", f"{len(about.frames)} codes", sizes["T"])
    # Angles are clamped to [low, high], which has to be an interval.
    if "regression.level" in tensors:
        require("field.points" in tensors, "regression", "a field whose points it moves", "none")
        low, high = tensors["regression.low"], tensors["regression.high"]
        require(bool((low <= high).all()), "regression.low", "at most `high`", "more")
    if "poses.known" in tensors:
        scale, known = tensors["poses.scale"], tensors["poses.known"]
        usable = float(scale) > 0.0 and len(known) > 0 and bool((np.abs(known) <= LARGEST_PARAMETER).all())
        require(usable, "poses", f"poses of at most {LARGEST_PARAMETER:g}, a scale above 0", "others")
    if "blend.head.values" in tensors:
        _check_blend(about, tensors, sizes, require)


def _check_blend(about: AboutAvatar, tensors: Mapping[str, np.ndarray], sizes: Mapping[str, int], require: Any) -> None:
    # The head is driven by the expression, or by it and the jaw's three angles; the body by 63 pose angles.
    part = tensors.get("blend.part")
    parts = 1 if part is None else int(part.max()) + 1
    require(part is None or part.min() >= 0, "blend.part", "no negative number", "one")
    inputs = {"head": sizes["E"] + 3 * about.jaw, "body": 63}
    for side in ("head", "body"):
        shapes, rows = sizes[f"{side}_n"], tensors.get(f"blend.{side}.rows")
        outputs, values = sizes[f"{side}_o"], tensors[f"blend.{side}.values"]
        # The network gives all shapes' coefficients for each part, one part after the other.
        fits = outputs % max(shapes, 1) == 0 and outputs >= parts * shapes
        require(fits, f"blend.{side}", f"{parts} x {shapes} coefficients", outputs)
        require(sizes[f"{side}_i"] == inputs[side], f"blend.{side}", f"{inputs[side]} inputs", sizes[f"{side}_i"])
        if rows is None:
            require(sizes[f"{side}_m"] == sizes["N"], f"blend.{side}", f"{sizes['N']} rows", sizes[f"{side}_m"])
        else:
            require(bool((np.diff(rows) > 0).all()), f"blend.{side}.rows", "increasing numbers", "others")
        # Integers need steps to become numbers again; an exponent
        # of at most 24 keeps 127 * 2^24 steps well within float32.
        steps = tensors.get(f"blend.{side}.step")
        require((values.dtype == np.int8) == (steps is not None), f"blend.{side}.step", "steps of integers", "others")
        exponents = tensors.get(f"blend.{side}.exponent")
        require(
            exponents is None or bool(((exponents >= 0) & (exponents <= 24)).all()),
            f"blend.{side}.exponent",
            "0 to 24",
            "others",
        )


def _indices(value: np.ndarray, subject: str) -> np.ndarray:
    # The native kernels take 32-bit indices; a larger one would wrap round.
    out = value.astype(np.int32)
    if (out != value).any():
        raise InputError(subject, expected="indices of 32 bits", received="others", remedy=REMEDY)
    return out


def _floats(value: np.ndarray, step: np.ndarray | None, start: np.ndarray | None, subject: str) -> np.ndarray:
    # A quantised float is q step + start, with one step and start for all, or one for each entry of the last axes.
    with np.errstate(over="ignore"):
        out = value.astype(np.float32)
    for word, other in (("step", step), ("start", start)):
        if other is None:
            continue
        if other.dtype.kind != "f" or other.ndim > value.ndim or other.shape != value.shape[value.ndim - other.ndim :]:
            raise InputError(
                f"{subject}.{word}",
                expected=f"floats for the last axes of {value.shape}",
                received=f"{other.dtype} of shape {other.shape}",
                remedy=REMEDY,
            )
        # Overflow gives an infinity, which the check below reports with the tensor's name instead of a warning.
        with np.errstate(over="ignore", invalid="ignore"):
            out = out * other.astype(np.float32) if word == "step" else out + other.astype(np.float32)
    if not np.isfinite(out).all():
        raise InputError(subject, expected="finite numbers", received="NaN or infinity", remedy=REMEDY)
    return out
