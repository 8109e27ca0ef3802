"""What commands share: types of options that may be left out, bounds, the check that an optional package is there."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import tyro

from smplxpp.core.errors import MissingExtraError

# Help shows them as what they take.
OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="(optional)")]
OptionalInt = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(optional)")]
OptionalFloat = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="(optional)")]
OptionalText = Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="(optional)")]
ClothMode = Literal["simulate", "field", "skin"]
"""What moves loose clothes: a simulation, a student's own field, the joints alone."""

LARGEST_PORT = 65535
MOST_AVATAR_BYTES = 1 << 30
"""Of a bundle that is read whole."""

_AVATAR_PACKAGES = ("torch", "safetensors", "threadpoolctl")


def require_avatar(purpose: str) -> None:
    """Say which package of the extra `avatar` is missing before anything imports it.

    Raises:
        MissingExtraError: one of them is not installed.
    """
    for package in _AVATAR_PACKAGES:
        if find_spec(package) is None:
            raise MissingExtraError(package, extra="avatar", purpose=purpose)
