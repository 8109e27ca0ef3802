"""Configurations of networks as plain dictionaries in the headers of model files, and limits of their sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import TYPE_CHECKING, Any, TypeVar

from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import shown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


Config = TypeVar("Config", bound="DataclassInstance")


def config_to_dict(config: DataclassInstance) -> dict[str, Any]:
    """Return the fields of a frozen dataclass by name; every value is a number, a string or a bool."""
    return asdict(config)


def config_from_dict(cls: type[Config], stored: Mapping[str, Any]) -> Config:
    """Make the configuration that `config_to_dict` stored.

    Args:
        cls: dataclass whose fields all have defaults.
        stored: every field by name.

    Raises:
        InputError: a field is missing, unknown or of another type, or a value is refused by the configuration itself.
    """
    # Exactly the fields of the dataclass.
    defaults: dict[str, Any] = {field.name: field.default for field in fields(cls)}
    if set(stored) != set(defaults):
        raise InputError(
            f"stored {cls.__name__}",
            expected=f"the fields {', '.join(sorted(defaults))}",
            received=", ".join(sorted(map(str, stored))) or "none",
            remedy="the checkpoint was made by another version: train again, or use the version that made it",
        )
    # Check the type and size of every value before the configuration is made.
    for name, default in defaults.items():
        value = stored[name]
        # Integers are accepted for floats (JSON written by hand); bools are not accepted for numbers.
        accepted = (float, int) if type(default) is float else (type(default),)
        usable = type(value) in accepted and (not isinstance(value, int | float) or abs(value) <= LARGEST_NUMBER)
        if not usable:  # NaN is not
            raise InputError(
                f"stored {cls.__name__}.{name}",
                expected=f"{type(default).__name__}, numbers up to {LARGEST_NUMBER}",
                received=shown(value),
            )
    return cls(**{name: type(default)(stored[name]) for name, default in defaults.items()})


MOST_LAYERS = 64
"""Layers of a network, bands of an encoding, steps along a skeleton: ten times what is useful."""
LARGEST_SIDE = 8192
"""Side of a map, pixels; eight times the paper's."""
LARGEST_NUMBER = 1 << 20
"""Width of a layer, or any other number in a configuration."""
