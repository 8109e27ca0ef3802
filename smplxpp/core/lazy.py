"""Names that a package exports and imports only when they are first used."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


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
