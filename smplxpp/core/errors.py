"""Report to the caller: errors about input with one wording, warnings, progress, and checks of numbers and choices."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from typing import Any, TypeAlias

ProgressCallback: TypeAlias = Callable[[str, float], None]
"""Receives the name of the running step and its share that is done, 0 to 1."""


def ignore_progress(step: str, share: float) -> None:
    """Discard a report of progress; the default where a function takes a `ProgressCallback`."""


class InputError(ValueError):
    """Input that cannot be used; raised before work starts and before anything is written.

    Args:
        subject: what was given, in the user's words ("scan vertices", "file scan.ply").
        expected: what would have been accepted.
        received: what was found instead.
        remedy: what the user can do about it (optional).

    Example:
        >>> try:
        ...     smplxpp.load_body("nothing.npz")
        ... except smplxpp.InputError as error:
        ...     print(error.expected)
        an existing file
    """

    def __init__(self, subject: str, *, expected: str, received: str, remedy: str = "") -> None:
        self.subject, self.expected, self.received, self.remedy = subject, expected, received, remedy
        message = f"{subject}: expected {expected}, received {received}."
        end = "" if remedy.endswith("?") else "."
        super().__init__(f"{message} {remedy[:1].upper()}{remedy[1:]}{end}" if remedy else message)


class ToldInputError(InputError):
    """An error that another process of the same command prints."""


class GeometryWarning(UserWarning):
    """A repair that was made or a questionable quantity: the result is usable, but should be looked at.

    Example:
        >>> with warnings.catch_warnings():
        ...     warnings.simplefilter("error", smplxpp.GeometryWarning)  # a repair is an error here
        ...     scan = smplxpp.read_scan("data/fixtures/person/scans/scan_000000.ply")
    """


def warn_of_left_out(source: str, names: Sequence[str], *, reason: str, stacklevel: int = 2) -> None:
    """Name once what a file has and its reader does not take; nothing where it takes all.

    Args:
        source: the file.
        names: of what is left out.
        reason: what they are and why they are not taken.
        stacklevel: of the warning, as for `warnings.warn` in the caller.

    Warns:
        GeometryWarning: the names, the first dozen of them.

    Example:
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warn_of_left_out("file a.npz", ["contacts"], reason="not read in the layout amass")
        >>> print(caught[0].message)
        file a.npz: not read in the layout amass: contacts
    """
    # Things that a warning names; the rest is counted.
    named = 12
    if names:
        more = f" and {len(names) - named} more" if len(names) > named else ""
        text = f"{source}: {reason}: {', '.join(names[:named])}{more}"
        warnings.warn(text, GeometryWarning, stacklevel=stacklevel + 1)


class MissingExtraError(ImportError):
    """An optional dependency that is not installed, or does not start.

    Args:
        package: name of the dependency.
        extra: extra of smplxpp that installs it.
        purpose: what needs it.
        apt: system packages that it needs on Debian and Ubuntu, for a package that is installed but does not start.
        reason: why a package that is installed does not start, in its own words.
    """

    def __init__(self, package: str, *, extra: str, purpose: str, apt: str = "", reason: str = "") -> None:
        # The packages by name, because smplxpp itself may have been installed from a folder or a wheel.
        wanted = " ".join(f"'{one}'" for one in requirements_of_extra(extra)) or f"'.[{extra}]' in its folder"
        message = f"{purpose} needs {package}, which is not installed: pip install {wanted} (extra {extra})"
        if apt:
            message = f"{purpose} needs {package}, which lacks libraries of the system: apt-get install {apt}"
        elif reason:
            message = f"{purpose} needs {package}, which is installed and does not start: {reason}"
        super().__init__(message)


def requirements_of_extra(extra: str) -> list[str]:
    """Return the packages that an extra of smplxpp installs, as pip takes them; none where the metadata lack it."""
    from importlib.metadata import PackageNotFoundError, requires  # slow to import, and seldom needed

    try:
        stated = requires("smplxpp") or []
    except PackageNotFoundError:
        return []
    out: list[str] = []
    pending = [extra]
    for name in pending:
        for requirement, marker in (one.split(";", 1) for one in stated if ";" in one):
            if re.search(rf"extra == .{re.escape(name)}.\s*$", marker) is None:
                continue
            # An extra may consist of others.
            others = re.match(r"smplxpp\[(.*)\]", requirement)
            if others:
                pending += [one for one in others[1].split(",") if one not in pending]
            elif requirement.strip() not in out:
                out.append(requirement.strip())
    return out


def one_line(result: Any) -> str:
    """Describe a dataclass in one line: arrays by type and shape, collections by their length, numbers as they are.

    It stands as `__repr__` in classes that hold arrays, which would print them.
    """
    shown = (f"{field.name}={_shown(getattr(result, field.name, None))}" for field in fields(result) if field.repr)
    return f"{type(result).__name__}({', '.join(shown)})"


def _shown(value: Any) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        size = " x ".join(map(str, value.shape))
        return f"<{str(value.dtype).removeprefix('torch.')} {size or 'scalar'}>"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, dict | list | set) or (isinstance(value, tuple) and len(value) > _SHORT):
        return f"<{type(value).__name__} of {len(value)}>"
    if isinstance(value, tuple):
        return f"({', '.join(map(_shown, value))}{',' if len(value) == 1 else ''})"
    text = repr(value)
    if len(text) <= _LONG and "\n" not in text:
        return text
    return f"{type(value).__name__}(...)" if is_dataclass(value) else f"{text.split(chr(10))[0][:_LONG]}..."


_SHORT, _LONG = 4, 80
"""Items of a tuple, and characters of any other value, that one line shows."""


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
        raise InputError(
            subject, expected=" or ".join(map(repr, choices)), received=repr(value), remedy=did_you_mean(value, choices)
        )


def did_you_mean(value: object, known: Iterable[object]) -> str:
    """Return a remedy for a misspelt name, the known one that is most like it as a question; "" if none is like it."""
    like = get_close_matches(str(value).lower(), [str(one) for one in known], n=1)
    return f"did you mean {like[0]!r}?" if like else ""


def require_known(subject: str, values: Iterable[object], known: Iterable[object]) -> None:
    """Raise `InputError` that names those of `values` which are not among `known`."""
    have = list(known)
    unknown = [str(value) for value in values if value not in have]
    if unknown:
        shown = ", ".join(map(str, have[:40])) + (", ..." if len(have) > 40 else "")
        like = did_you_mean(unknown[0], have)
        raise InputError(subject, expected=f"among {shown}", received=", ".join(unknown), remedy=like)
