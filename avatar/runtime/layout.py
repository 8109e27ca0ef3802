"""Define and check the tensors of a bundle: kind and shape by piece and name; docs/runtime.md describes them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from smplxpp.core.errors import InputError

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


def _indices(value: np.ndarray, subject: str) -> np.ndarray:
    # The native kernels take 32-bit indices; a larger one would wrap round.
    out = value.astype(np.int32)
    if (out != value).any():
        raise InputError(subject, expected="indices of 32 bits", received="others", remedy=REMEDY)
    return out


def _floats(value: np.ndarray, step: np.ndarray | None, start: np.ndarray | None, subject: str) -> np.ndarray:
    # A quantised float is q step + start, with one step and start for all, or one for each entry of the last axes.
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
