"""Read JSON files and texts of bounded size and depth, check their values by type, and turn values into JSON."""

from __future__ import annotations

import json
import math
import numbers
import re
from collections.abc import Mapping
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes

# Nesting depth: the formats that are read have at most ten levels.
_MAX_LEVELS = 64
# Escapes of characters that no file name can have: NUL, and halves of a surrogate pair.
_UNUSABLE_ESCAPE = re.compile(rb"\\u(?:0000|[dD][89a-fA-F])")


def read_json(path: str | Path, *, subject: str = "file", remedy: str = "") -> Any:
    """Read the content of a JSON file of at most one GiB.

    Raises:
        InputError: missing, no regular file, too large, or what `parse_json` refuses.
    """
    # Keypoints of a long film in one file have some hundred megabytes.
    data = read_bytes(path, subject=subject, most=1 << 30, remedy=remedy)
    return parse_json(data, subject=f"{subject} {path}", remedy=remedy)


def parse_json(data: bytes | str, *, subject: str, remedy: str = "", strict: bool = False) -> Any:
    """Parse a JSON text into dictionaries, lists, texts and numbers.

    Args:
        data: the text.
        subject: what it is called in messages.
        remedy: advice in messages.
        strict: take what RFC 8259 has and browsers read: UTF-8 without a mark, no NaN and no infinity.

    Raises:
        InputError: broken JSON, more than 64 levels, integers of more than 18 digits, or texts with a NUL or half a
            surrogate pair, which no file name can have.
    """
    # Integers are bounded while they are parsed: the conversion of long digits takes quadratic time.
    try:
        text = data.decode() if strict and isinstance(data, bytes) else data
        value = json.loads(text, parse_int=_integer, parse_constant=_no_number if strict else None)
    except RecursionError:
        raise InputError(
            subject, expected=f"JSON of at most {_MAX_LEVELS} levels", received="more", remedy=remedy
        ) from None
    except ValueError as error:  # broken JSON, broken UTF-8, and long integers
        raise InputError(subject, expected="JSON", received=str(error)[:200], remedy=remedy) from None
    # Deep nesting would exhaust the stack of later recursive walks.
    if _levels(value) > _MAX_LEVELS:
        raise InputError(subject, expected=f"JSON of at most {_MAX_LEVELS} levels", received="more", remedy=remedy)
    # The search for escapes is quick and spares most files the walk through all texts.
    raw = data if isinstance(data, bytes) else data.encode(errors="surrogatepass")
    if (_UNUSABLE_ESCAPE.search(raw) or b"\0" in raw) and not _all_text_usable(value):
        raise InputError(
            subject, expected="text of whole characters", received="a NUL or half a character", remedy=remedy
        )
    return value


def as_object(value: Any, *, subject: str) -> dict[str, Any]:
    """Return the value if it is a JSON object."""
    return _of_type(value, dict, "an object {...}", subject)


def as_list(value: Any, *, subject: str) -> list[Any]:
    """Return the value if it is a JSON list."""
    return _of_type(value, list, "a list [...]", subject)


def as_text(value: Any, *, subject: str) -> str:
    """Return the value if it is a text."""
    return _of_type(value, str, "a text", subject)


def as_number(value: Any, *, subject: str, least: float = -math.inf, most: float = math.inf) -> float:
    """Return the value as a float if it is a finite number within bounds; true and false are no numbers.

    Raises:
        InputError: anything else.
    """
    try:
        # bool is a subclass of int in Python.
        number = float(value) if isinstance(value, numbers.Real) and not isinstance(value, bool) else math.nan
    except OverflowError:
        number = math.inf
    if not (math.isfinite(number) and least <= number <= most):
        bounds = "" if (least, most) == (-math.inf, math.inf) else f" from {least:g} to {most:g}"
        raise InputError(subject, expected=f"a finite number{bounds}", received=shown(value))
    return number


def as_integer(value: Any, *, subject: str, least: int = -(2**53), most: int = 2**53) -> int:
    """Return the value as an int if it is a whole number within bounds, such as 3.0.

    Raises:
        InputError: anything else.
    """
    whole = isinstance(value, numbers.Integral) and not isinstance(value, bool)
    whole = whole or (isinstance(value, float) and value.is_integer())
    if not (whole and least <= value <= most):
        raise InputError(subject, expected=f"a whole number from {least} to {most}", received=shown(value))
    return int(value)


def as_numbers(
    value: Any, shape: tuple[int | None, ...] | None = None, *, subject: str, finite: bool = True
) -> Float64[np.ndarray, "*n"]:
    """Convert nested lists of numbers, or an array, to float64.

    Args:
        value: lists or array.
        shape: required shape, None for any length of an axis; without it any shape passes.
        subject: what the value is called in messages.
        finite: refuse NaN and infinity.

    Raises:
        InputError: anything but numbers, lists of unequal lengths, another shape.
    """
    array = _number_array(value)
    wanted = "" if shape is None else f" of shape ({', '.join('any' if n is None else str(n) for n in shape)})"
    if array is None:
        raise InputError(subject, expected=f"{'finite ' if finite else ''}numbers{wanted}", received=shown(value))
    if finite and not np.isfinite(array).all():
        bad = ~np.isfinite(array)
        received = f"NaN or infinity, {int(bad.sum())} of {bad.size}, the first at {np.argwhere(bad)[0].tolist()}"
        raise InputError(subject, expected=f"finite numbers{wanted}", received=received)
    if shape is not None and not (
        array.ndim == len(shape) and all(n is None or n == m for n, m in zip(shape, array.shape, strict=True))
    ):
        raise InputError(subject, expected=f"numbers{wanted}", received=f"shape {array.shape}")
    return array


def shown(value: Any) -> str:
    """Describe a value in a message: its kind, or its beginning where that is short."""
    if isinstance(value, dict | list):
        return f"{'an object' if isinstance(value, dict) else 'a list'} of {len(value)} entries"
    if isinstance(value, int) and value.bit_length() > 200:
        return "an integer of many digits"
    return repr(value[:80] if isinstance(value, str) else value)[:80]


def _of_type(value: Any, kind: type, expected: str, subject: str) -> Any:
    if not isinstance(value, kind):
        raise InputError(subject, expected=expected, received=shown(value))
    return value


def _integer(digits: str) -> int:
    """Parse an integer of 64 bits; arrays of longer ones would hold objects."""
    if len(digits) > 19:  # digits of 2^63 with a sign
        raise ValueError(f"an integer of {len(digits)} digits")
    return int(digits)


def _no_number(word: str) -> None:
    raise ValueError(f"{word}, which is no number")


def _levels(value: Any) -> int:
    """Return the nesting depth of containers, at most one more than allowed."""
    layer = [value] if isinstance(value, dict | list) else []
    # Breadth first, a layer at a time, so that no recursion is needed.
    for level in range(_MAX_LEVELS + 1):
        if not layer:
            return level
        layer = [
            child
            for container in layer
            for child in (container.values() if isinstance(container, dict) else container)
            if isinstance(child, dict | list)
        ]
    return _MAX_LEVELS + 1


def _all_text_usable(value: Any) -> bool:
    """Tell whether no text in a value has a NUL or half a surrogate pair."""
    pending = [value]
    while pending:
        item = pending.pop()
        if isinstance(item, dict):
            pending += [*item.keys(), *item.values()]
        elif isinstance(item, list):
            pending += item
        elif isinstance(item, str) and ("\0" in item or any("\ud800" <= c <= "\udfff" for c in item)):
            return False
    return True


def _number_array(value: Any) -> np.ndarray | None:
    """Convert nested lists to float64; None if they hold anything but numbers (numpy would accept "1" and true)."""
    # A walk with a stack of its own, since the depth of lists comes from the file.
    pending = [value]
    while pending:
        item = pending.pop()
        if isinstance(item, list | tuple):
            pending += item
        elif isinstance(item, np.ndarray):
            pending += [] if item.dtype.kind in "iuf" else [None]
        elif isinstance(item, bool) or not isinstance(item, numbers.Real):
            return None
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):  # unequal lengths, integers too large for a float
        return None


def jsonable(value: Any) -> Any:
    """Convert configs, paths and numpy values to JSON values; non-finite numbers become null."""
    # Most of a file is plain values, for which the questions below take longer than all else.
    if type(value) in (str, int, bool, type(None)):
        return value
    # Dataclasses first: their fields may hold any of the types below.
    if is_dataclass(value) and not isinstance(value, type):
        return jsonable(asdict(value))
    if isinstance(value, Mapping):
        return {str(k): jsonable(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [jsonable(v) for v in (sorted(value, key=str) if isinstance(value, set | frozenset) else value)]
    if isinstance(value, np.ndarray):
        return jsonable(value.tolist())
    if isinstance(value, np.generic):
        return jsonable(value.item())
    # JSON has no NaN and no infinity.
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return value.name
    return value
