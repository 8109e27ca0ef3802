"""Check numbers and choices that a user gives, with one wording of errors for all."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from smplxpp.core.errors import InputError


def require_at_least(subject: str, value: float, least: float) -> None:
    """Raise `InputError` unless `value >= least` and finite; a NaN is refused too."""
    require_between(subject, value, least, math.inf)


def require_between(subject: str, value: float, least: float, most: float) -> None:
    """Raise `InputError` unless `least <= value <= most` and finite; a NaN is refused too."""
    if not (math.isfinite(value) and least <= value <= most):
        limit = f" and at most {most:g}" if math.isfinite(most) else ""
        raise InputError(subject, expected=f"a number, at least {least:g}{limit}", received=f"{value:g}")


def require_positive(subject: str, value: float, *, finite: bool = True) -> None:
    """Raise `InputError` unless `value > 0`; infinity passes with `finite=False`."""
    if not value > 0 or (finite and not math.isfinite(value)):
        raise InputError(subject, expected="a number above 0", received=f"{value:g}")


def require_choice(subject: str, value: str, choices: Sequence[str]) -> None:
    """Raise `InputError` unless `value` is one of `choices`."""
    if value not in choices:
        raise InputError(subject, expected=" or ".join(map(repr, choices)), received=repr(value))


def require_known(subject: str, values: Iterable[object], known: Iterable[object]) -> None:
    """Raise `InputError` that names those of `values` which are not among `known`."""
    have = list(known)
    unknown = [str(value) for value in values if value not in have]
    if unknown:
        shown = ", ".join(map(str, have[:40])) + (", ..." if len(have) > 40 else "")
        raise InputError(subject, expected=f"among {shown}", received=", ".join(unknown))
