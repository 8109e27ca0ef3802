"""A page that plays a motion with its sound: one file or a folder."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from smplxpp.core import BodyParams, InputError
from smplxpp.core.files import atomic_write_bytes, read_bytes
from smplxpp.core.files.sound_file import Sound, wave_bytes

if TYPE_CHECKING:
    from avatar.runtime import AvatarBundle

PAGES = (".html", ".htm")
"""Suffixes of a page in one file."""


def check_page_path(path: Path) -> None:
    """Refuse what is neither one page nor a folder.

    Raises:
        InputError: another suffix, or a file where a folder is to be.
    """
    if path.suffix.lower() not in (*PAGES, ""):
        raise InputError(f"output {path}", expected="NAME.html or a folder", received=path.suffix)
    if not path.suffix and path.exists() and not path.is_dir():
        raise InputError(f"output {path}", expected="a folder, or nothing yet", received="a file")


def live_lips(bundle: AvatarBundle) -> bytes | None:
    """Return what moves a bundle's mouth by live sound in a page; None for a face whose mouth cannot speak."""
    from avatar.driving import face_of_bundle
    from pipelines.web.page import lips_of

    try:
        return lips_of(face_of_bundle(bundle))
    except InputError:
        return None


def write_talking_page(
    path: Path, bundle: Path, motion: BodyParams, sound: Sound, *, name: str, lips: bytes | None
) -> None:
    """Write the page, each file of it whole or not at all.

    Args:
        bundle: file of the avatar; what it plays is the motion. sound: from the motion's first frame on.
        lips: of the avatar, for live sound.
    """
    from avatar.runtime.bundle import SUFFIX, save_with_motion
    from pipelines.web.page import PageContent, single_page, write_page_folder

    with tempfile.TemporaryDirectory() as folder:
        # The page plays the motion of its bundle: write a copy of the bundle with this motion.
        talking = Path(folder) / f"me{SUFFIX}"
        save_with_motion(talking, bundle, motion)
        data = read_bytes(talking, subject="avatar")
    content = PageContent(name=name, sound=wave_bytes(sound), lips=lips)
    if path.suffix:
        atomic_write_bytes(path, single_page(data, content))
    else:
        write_page_folder(path, data, content)
