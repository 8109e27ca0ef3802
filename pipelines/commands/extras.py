"""Optional packages that commands need."""

from __future__ import annotations

from importlib.util import find_spec

from smplxpp.core.errors import MissingExtraError

AVATAR = ("torch", "safetensors", "threadpoolctl")
"""Packages of the extra `avatar`."""


def require_avatar(purpose: str) -> None:
    """Say which package is missing before anything imports it.

    Raises:
        MissingExtraError: one of `AVATAR` is not installed.
    """
    for package in AVATAR:
        if find_spec(package) is None:
            raise MissingExtraError(package, extra="avatar", purpose=purpose)
