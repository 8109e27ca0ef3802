"""Read TOML and XML files of bounded size, without what makes XML expand: document types and entities."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes, read_text

# Calibrations have some kilobytes a camera; rigs have at most some hundred cameras.
_MOST_BYTES = 64 << 20
# Marks of UTF-16 at the start of a file, which OptiTrack writes, with or without a declaration.
_UTF_16 = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"<\0": "utf-16-le", b"\0<": "utf-16-be"}


def read_toml(path: str | Path, *, subject: str = "file", remedy: str = "") -> dict[str, Any]:
    """Read the tables of a TOML file of at most 64 MiB.

    Raises:
        InputError: missing, too large, no text, or broken TOML.
    """
    text = read_text(path, subject=subject, most=_MOST_BYTES, remedy=remedy)
    try:
        return tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise InputError(
            f"{subject} {path}", expected="TOML", received=str(error)[:200] or type(error).__name__, remedy=remedy
        ) from None


def read_xml(path: str | Path, *, subject: str = "file", remedy: str = "") -> ElementTree.Element:
    """Read the root element of an XML file of at most 64 MiB, in UTF-8 or UTF-16.

    Raises:
        InputError: missing, too large, broken XML, more than 64 levels, or a document type, whose entities could
            expand without bound.
    """
    data = read_bytes(path, subject=subject, most=_MOST_BYTES, remedy=remedy)
    name = f"{subject} {path}"
    try:
        text = data.decode(_UTF_16.get(data[:2], "utf-8-sig"))
    except UnicodeDecodeError as error:
        raise InputError(name, expected="XML in UTF-8 or UTF-16", received=str(error), remedy=remedy) from None
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise InputError(name, expected="XML without a document type", received="<!DOCTYPE", remedy=remedy)
    try:
        # The declaration names the encoding of the bytes, which are decoded already.
        root = ElementTree.fromstring(re.sub(r"^\s*<\?xml[^>]*\?>", "", text))
    except (ElementTree.ParseError, ValueError, RecursionError) as error:
        raise InputError(name, expected="XML", received=str(error)[:200], remedy=remedy) from None
    level = [root]
    # Elements within elements, as in JSON.
    max_levels = 64
    for _ in range(max_levels):
        level = [child for element in level for child in element]
    if level:
        raise InputError(name, expected=f"XML of at most {max_levels} levels", received="more", remedy=remedy)
    return root
