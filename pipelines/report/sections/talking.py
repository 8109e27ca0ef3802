"""The report's section of a film in which the person talks, where the run's folder holds one."""

from __future__ import annotations

from pathlib import Path

from pipelines.report import Film, Section
from pipelines.runs.layout import TALKING_FILM
from smplxpp.core.files.paths import read_bytes

_MOST_BYTES = 3_000_000


def talking_section(run: Path) -> tuple[Section, ...]:
    """The film with its sound; none where there is no film, or one too large to be part of a page."""
    path = run / TALKING_FILM
    if not path.is_file() or path.stat().st_size > _MOST_BYTES:
        return ()
    text = (
        "A text to a made voice; its phonemes to mouth and jaw, its stresses to gestures. The capture has none of it."
    )
    film = Film("the student, drawn by the runtime; press play for the sound", read_bytes(path, subject="film"))
    return (Section("It talks", text=(text,), films=(film,)),)
