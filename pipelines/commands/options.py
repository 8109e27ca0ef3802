"""What commands share: optional types, bounds, lists of frames and names, the check that a package is installed."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from smplxpp.core import InputError, MissingExtraError, require_positive
from smplxpp.core.files.panorama_file import read_panorama
from smplxpp.core.light import Irradiance, Relighting

if TYPE_CHECKING:
    from pipelines.web.access import Access
    from smplxpp.capture import Capture

# Types of optional values; the help shows the plain type instead of a union with None.
OptionalPath = Annotated[Path | None, tyro.conf.arg(metavar="PATH", help_behavior_hint="(optional)")]
OptionalInt = Annotated[int | None, tyro.conf.arg(metavar="INT", help_behavior_hint="(optional)")]
OptionalFloat = Annotated[float | None, tyro.conf.arg(metavar="FLOAT", help_behavior_hint="(optional)")]
OptionalText = Annotated[str | None, tyro.conf.arg(metavar="TEXT", help_behavior_hint="(optional)")]
ClothMode = Literal["simulate", "field", "skin"]
"""What moves loose clothes: a simulation, a student's own field, the joints alone."""

LARGEST_PORT = 65535
TOKEN_VARIABLE = "SMPLXPP_TOKEN"
"""Environment variable of a server's token, because other users of a machine see the options of commands."""
MOST_AVATAR_BYTES = 1 << 30
"""Largest size in bytes of a bundle that is read into memory: 1 GiB."""

_FRAMES = "numbers and ranges START:STOP or START:STOP:STEP (STOP not included), with commas between"
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
class Exposure:
    """Options of a server that other machines may reach; without them this machine alone does."""

    host: str = "127.0.0.1"
    """Address to listen at; with 0.0.0.0 other machines reach the server, and need the token of the printed address."""
    public_url: OptionalText = None
    """Address under which a proxy offers the server, as https://example.org/me/; it is answered under that name too."""
    no_token: bool = False
    """Let everybody in where other machines reach the server; otherwise it asks for the token of the printed address,
    a new one each time, or that of the environment variable SMPLXPP_TOKEN."""

    def access(self) -> Access:
        """Return who may ask the server.

        Raises:
            InputError: no such address, a token that can be guessed, a token that is given and not wanted.
        """
        from pipelines.web.access import Access, new_token

        given = os.environ.get(TOKEN_VARIABLE, "")
        if given and self.no_token:
            raise InputError("option no-token", expected=f"no {TOKEN_VARIABLE} beside it", received="both")
        access = Access(host=self.host, public_url=self.public_url or "", token=given)
        return replace(access, token=new_token()) if access.exposed and not given and not self.no_token else access


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


def listed_names(text: str | None) -> tuple[str, ...] | None:
    """Return the names in a text with commas between; None for None."""
    return None if text is None else tuple(name.strip() for name in text.split(","))


def selected_frames(text: str | None, capture: Capture) -> tuple[int, ...] | None:
    """Return the capture's frames that a text names: `all`, `0,5`, `0:100:10`; None for None.

    Raises:
        InputError: not understood, a number that is no frame, or a range without any.
    """
    if text is None:
        return None
    if text.strip() == "all":
        return capture.frames
    chosen: set[int] = set()
    # Each part is a number, START:STOP or START:STOP:STEP; the result is the union of all.
    for part in text.split(","):
        try:
            numbers = tuple(int(n) if n.strip() else None for n in part.split(":"))
            if len(numbers) > 3 or numbers == (None,) or numbers[2:] == (0,):
                raise ValueError
        except ValueError:
            raise InputError("--frames", expected=f"all, or {_FRAMES}", received=text) from None
        # A range is cut to the capture's frames; a range without any is an error of the user.
        if len(numbers) == 1:
            found = {frame for frame in capture.frames if frame == numbers[0]}
        else:
            last = max(capture.frames, default=-1) + 1
            start, stop, step = numbers if len(numbers) == 3 else (*numbers, None)
            found = set(range(start or 0, last if stop is None else min(stop, last), step or 1)) & set(capture.frames)
        if not found:
            have = f"{capture.frames[0]} to {capture.frames[-1]}" if capture.frames else "none"
            raise InputError("--frames", expected=f"frames that the capture has ({have})", received=part)
        chosen |= found
    return tuple(sorted(chosen))


def frame_numbers(text: str | None) -> tuple[int, ...] | None:
    """Return the numbers in a text such as `0,5` or `0:100:10`; None for None or `all`.

    Unlike `selected_frames` it needs no capture, for frames of videos that are not decoded yet.

    Raises:
        InputError: not understood.
    """
    if text is None or text.strip() == "all":
        return None
    chosen: list[int] = []
    for part in text.split(","):
        try:
            numbers = [int(n) for n in part.split(":")]
            if len(numbers) > 3 or min(numbers) < 0 or numbers[2:] == [0]:
                raise ValueError
            found = list(range(*numbers)) if len(numbers) > 1 else numbers
        except ValueError:
            raise InputError("--frames", expected=f"all, or {_FRAMES}", received=text) from None
        chosen += found
    return tuple(sorted(set(chosen)))
