"""Zip packages of texts, made in memory: the same content gives the same bytes."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping

# Zips carry a time; the oldest that they can.
_TIME = (1980, 1, 1, 0, 0, 0)


def zip_bytes(files: Mapping[str, str]) -> bytes:
    """A compressed zip of texts by their names, in their order."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as package:
        for name, text in files.items():
            entry = zipfile.ZipInfo(name, _TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            package.writestr(entry, text)
    return stream.getvalue()


def zip_member(data: bytes, name: str) -> str:
    """A text of a zip that `zip_bytes` made; nothing bounds what it unfolds to, so it is not for files of others."""
    with zipfile.ZipFile(io.BytesIO(data)) as package:
        return package.read(name).decode()
