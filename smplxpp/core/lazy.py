"""Import what is heavy or optional only when it is first used."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from types import ModuleType
from typing import Any

from smplxpp.core.errors import MissingExtraError

OPEN3D_NEEDS = "libusb-1.0-0 libgl1 libegl1 libx11-6"
"""Debian's packages without which open3d does not start."""


def import_extra(package: str, *, extra: str, purpose: str, apt: str = "", named: str = "") -> ModuleType:
    """Import an optional package, or a module of one.

    Args:
        package: its name in Python.
        extra: the extra of smplxpp that installs it.
        purpose: what needs it.
        apt: system packages without which it does not start.
        named: the name under which pip knows it, where that differs.

    Raises:
        MissingExtraError: it is not installed, or does not start.
    """
    try:
        return import_module(package)
    except (ImportError, OSError) as error:
        # Another missing module, or a library that does not load, means that the package itself is there.
        absent = (error.name or "").partition(".")[0] if isinstance(error, ModuleNotFoundError) else ""
        named = named or package.partition(".")[0]
        if absent == package.partition(".")[0]:
            raise MissingExtraError(named, extra=extra, purpose=purpose) from None
        raise MissingExtraError(named, extra=extra, purpose=purpose, apt=apt, reason=str(error)[:300]) from error


def lazy_exports(package: str, names: Mapping[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the `__getattr__` and `__dir__` of a package whose public names lie in modules that are heavy to import.

    Args:
        package: name of the package.
        names: module of each public name.

    Example:
        >>> _EXPORTS = {"rasterize": "avatar.rendering.api"}
        >>> __all__ = [*_EXPORTS]
        >>> __getattr__, __dir__ = lazy_exports("avatar.rendering", _EXPORTS)
    """

    def get(name: str) -> Any:
        if name in names:
            return getattr(import_module(names[name]), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    def listed() -> list[str]:
        return sorted(names)

    return get, listed
