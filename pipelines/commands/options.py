"""What commands share: types of options that may be left out, bounds, the check that an optional package is there."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Literal

import tyro

from smplxpp.core import InputError, MissingExtraError, require_positive
from smplxpp.core.files.panorama_file import read_panorama
from smplxpp.core.light import Irradiance, Relighting

# Types of optional values; the help shows the plain type instead of a union with None.
OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="(optional)")]
OptionalInt = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(optional)")]
OptionalFloat = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="(optional)")]
OptionalText = Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="(optional)")]
ClothMode = Literal["simulate", "field", "skin"]
"""What moves loose clothes: a simulation, a student's own field, the joints alone."""

LARGEST_PORT = 65535
MOST_AVATAR_BYTES = 1 << 30
"""Largest size in bytes of a bundle that is read into memory: 1 GiB."""

_AVATAR_PACKAGES = ("torch", "safetensors", "threadpoolctl")


def require_avatar(purpose: str) -> None:
    """Check that the packages of the extra `avatar` are installed, before anything imports them.

    Raises:
        MissingExtraError: one of them is not installed.
    """
    for package in _AVATAR_PACKAGES:
        if find_spec(package) is None:
            raise MissingExtraError(package, extra="avatar", purpose=purpose)


@dataclass(frozen=True)
class Lighting:
    """Options of the light in which a person is shown."""

    environment: OptionalPath = None
    """Show the person in the light of this panorama: equirectangular, Radiance (.hdr) or OpenEXR (.exr, extra
    `exr`), straight up in its first row."""
    environment_turn: float = 0.0
    """Rotation of that light about the vertical, degrees."""
    exposure: OptionalFloat = None
    """Factor on that light; by default its mean equals that of white light, so that colours keep their brightness."""
    capture_light: OptionalPath = None
    """Panorama of the light of the capture, which is divided out; by default uniform white light."""

    def relighting(self) -> Relighting | None:
        """Read the light; None where none is asked for.

        Raises:
            InputError: no such picture, no light in it; options of a light without one.
        """
        if self.exposure is not None:
            require_positive("option exposure", self.exposure)
        if self.environment is None:
            if self.environment_turn or self.exposure is not None or self.capture_light is not None:
                raise InputError(
                    "option environment",
                    expected="a panorama, for --environment-turn, --exposure and --capture-light",
                    received="none",
                )
            return None
        light = read_light(self.environment, turn=self.environment_turn).exposed(self.exposure)
        captured = Irradiance.uniform() if self.capture_light is None else read_light(self.capture_light).exposed()
        return Relighting(light, captured)


def read_light(path: Path, *, turn: float = 0.0) -> Irradiance:
    """Read a panorama as light.

    Raises:
        InputError: no such picture, or no light in it.
    """
    try:
        return Irradiance.of_environment(read_panorama(path), turn=turn)
    except InputError as error:
        if error.subject != "panorama":
            raise
        raise InputError(f"light {path}", expected=error.expected, received=error.received) from None
