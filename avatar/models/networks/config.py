"""Configurations of networks to and from the plain dictionaries that a checkpoint stores."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any, TypeVar

from smplxpp.core.errors import InputError

Config = TypeVar("Config")


def config_to_dict(config: Any) -> dict[str, Any]:
    """Fields of a frozen dataclass by name; every value is a number, a string or a bool."""
    return asdict(config)


def config_from_dict(cls: type[Config], stored: Mapping[str, Any]) -> Config:
    """The configuration that `config_to_dict` stored.

    Args:
        cls: dataclass whose fields all have defaults.
        stored: every field by name.

    Raises:
        InputError: a field is missing, unknown or of another type, or a value is refused by the configuration itself.
    """
    defaults = {field.name: field.default for field in fields(cls)}
    if set(stored) != set(defaults):
        raise InputError(
            f"stored {cls.__name__}",
            expected=f"the fields {', '.join(sorted(defaults))}",
            received=", ".join(sorted(map(str, stored))) or "none",
            remedy="the checkpoint was made by another version: train again, or use the version that made it",
        )
    for name, default in defaults.items():
        # 1 stands for 1.0 in JSON written by hand; True never stands for 1.
        accepted = (float, int) if type(default) is float else (type(default),)
        if type(stored[name]) not in accepted:
            raise InputError(
                f"stored {cls.__name__}.{name}", expected=type(default).__name__, received=repr(stored[name])
            )
    return cls(**{name: type(default)(stored[name]) for name, default in defaults.items()})


def require_choice(subject: str, value: str, choices: tuple[str, ...]) -> None:
    """Raise `InputError` unless `value` is one of `choices`."""
    if value not in choices:
        raise InputError(subject, expected=" or ".join(map(repr, choices)), received=repr(value))


def require_at_least(subject: str, value: float, least: float) -> None:
    """Raise `InputError` unless `value >= least` (a NaN is refused too)."""
    if not value >= least:
        raise InputError(subject, expected=f"at least {least:g}", received=f"{value:g}")
