"""Read TOML, XML and YAML files of bounded size, without what makes them expand, refer to others or execute.

Of YAML 1.2 it is the part that people write by hand, with its core schema (`yes` is a text): block and flow
collections, plain and quoted texts of one line, comments. Tags, anchors, aliases, texts over several lines and second
documents are refused, so that a file holds what it shows.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import parse_json
from smplxpp.core.files.paths import read_bytes, read_text

# Calibrations have some kilobytes a camera; rigs have at most some hundred cameras.
_MOST_BYTES = 64 << 20
# Marks of UTF-16 at the start of a file, which OptiTrack writes, with or without a declaration.
_UTF_16 = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"<\0": "utf-16-le", b"\0<": "utf-16-be"}
_MOST_LEVELS = 16
_QUOTED = r""""(?:[^"\\]|\\.)*"|'(?:[^']|'')*'"""
_KEY = re.compile(rf"""(?P<key>{_QUOTED}|[^\s\[\]{{}},"'#&*!|>%@`-][^#]*?|-[^\s#][^#]*?):(?=\s|$)""")
_INTEGER = re.compile(r"[-+]?[0-9]{1,18}")
_FLOAT = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]{1,3})?")
_WORDS = {"": None, "~": None, "null": None, "true": True, "false": False}
_REFUSED = {
    "&": "an anchor",
    "*": "an alias",
    "!": "a tag",
    "|": "a text over several lines",
    ">": "a text over several lines",
    "%": "a directive",
    "@": "a reserved sign",
    "`": "a reserved sign",
}


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


@dataclass(frozen=True)
class _Line:
    """A line with content: its number in the file, its indentation and its text without comment."""

    number: int
    indent: int
    text: str


def read_yaml(path: str | Path, *, subject: str = "file", remedy: str = "", most_bytes: int = 1 << 18) -> Any:
    """Read the content of a YAML file, by default of at most 256 KiB, as dictionaries, lists, texts, numbers and None.

    Raises:
        InputError: missing, no text, too large, or outside the part of YAML that is read; the message names the line.

    Example:
        >>> import tempfile
        >>> with tempfile.NamedTemporaryFile("w", suffix=".yaml") as file:
        ...     _ = file.write("names: [hat, bag]  # two")
        ...     file.flush()
        ...     read_yaml(file.name)
        {'names': ['hat', 'bag']}
    """
    # A file written by hand has some kilobytes.
    text = read_text(path, subject=subject, most=most_bytes, remedy=remedy)
    return _Parser(text, f"{subject} {path}", remedy).document()


class _Parser:
    """Parses one document; `at` is the next line."""

    def __init__(self, text: str, subject: str, remedy: str) -> None:
        self.subject, self.remedy, self.at = subject, remedy, 0
        self.lines = self._lines(text)

    def document(self) -> Any:
        if not self.lines:
            return None
        value = self._block(self.lines[0].indent, 1)
        if self.at < len(self.lines):
            raise self._error(self.lines[self.at], "lines that belong to what is above them")
        return value

    def _lines(self, text: str) -> list[_Line]:
        out: list[_Line] = []
        for number, raw in enumerate(text.removeprefix("\ufeff").splitlines(), 1):
            content = _without_comment(raw).rstrip()
            line = _Line(number, len(content) - len(content.lstrip(" ")), content.strip())
            # One marker may open the document.
            if not line.text or (line.text == "---" and not out):
                continue
            if line.text in ("---", "...") or line.text.startswith("--- "):
                raise self._error(line, "one document")
            if content.lstrip(" ").startswith("\t"):
                raise self._error(line, "indentation by spaces")
            out.append(line)
        return out

    def _block(self, indent: int, level: int) -> Any:
        """Parse the collection or value that begins at the next line, whose lines have this indentation."""
        line = self.lines[self.at]
        if level > _MOST_LEVELS:
            raise self._error(line, f"at most {_MOST_LEVELS} levels")
        if _is_item(line.text):
            return self._list(indent, level)
        if _KEY.match(line.text):
            return self._mapping(indent, level)
        self.at += 1
        return self._value(line, line.text)

    def _list(self, indent: int, level: int) -> list[Any]:
        out = []
        while self.at < len(self.lines) and self.lines[self.at].indent == indent:
            line = self.lines[self.at]
            if not _is_item(line.text):
                break
            rest = line.text[1:].lstrip(" ")
            if rest and (_is_item(rest) or _KEY.match(rest)):
                # The collection of an item begins on the item's own line, as deep as its first sign.
                inner = indent + len(line.text) - len(rest)
                self.lines[self.at] = _Line(line.number, inner, rest)
                out.append(self._block(inner, level + 1))
                continue
            self.at += 1
            out.append(self._value(line, rest) if rest else self._nested(indent + 1, level))
        return out

    def _mapping(self, indent: int, level: int) -> dict[str, Any]:
        out: dict[str, Any] = {}
        while self.at < len(self.lines) and self.lines[self.at].indent == indent:
            line = self.lines[self.at]
            found = _KEY.match(line.text)
            if found is None or _is_item(line.text):
                break
            key = str(self._scalar(line, found["key"].strip())) if found["key"][0] in "\"'" else found["key"].strip()
            if key in out:
                raise self._error(line, f"one entry {key!r}")
            rest = line.text[found.end() :].strip()
            self.at += 1
            # The items of a list may stand as deep as its key.
            follows = self.lines[self.at] if self.at < len(self.lines) else None
            beside = follows is not None and follows.indent == indent and _is_item(follows.text)
            out[key] = self._value(line, rest) if rest else self._nested(indent + (not beside), level)
        return out

    def _nested(self, least: int, level: int) -> Any:
        """Parse what stands at least this deep after an empty key or item; None without any."""
        if self.at < len(self.lines) and self.lines[self.at].indent >= least:
            return self._block(self.lines[self.at].indent, level + 1)
        return None

    def _value(self, line: _Line, text: str) -> Any:
        if text[0] not in "[{":
            return self._scalar(line, text)
        # A flow collection continues until its brackets are closed.
        opened, rows = _open_brackets(text), [text]
        while opened > 0 and self.at < len(self.lines):
            rows.append(self.lines[self.at].text)
            opened += _open_brackets(rows[-1])
            self.at += 1
        text = " ".join(rows)
        value, end = self._flow(line, text, 0, 1)
        if text[end:].strip():
            raise self._error(line, "nothing behind a closed bracket")
        return value

    def _flow(self, line: _Line, text: str, at: int, level: int) -> tuple[Any, int]:
        """Parse a flow collection or scalar at a place of a text; returns it and the place behind it."""
        if level > _MOST_LEVELS:
            raise self._error(line, f"at most {_MOST_LEVELS} levels")
        at = _skip(text, at)
        if at < len(text) and text[at] in "[{":
            close, mapping = "]" if text[at] == "[" else "}", text[at] == "{"
            items: list[Any] = []
            pairs: dict[str, Any] = {}
            at = _skip(text, at + 1)
            while at < len(text) and text[at] != close:
                value, at = self._flow(line, text, at, level + 1)
                at = _skip(text, at)
                if mapping:
                    if at >= len(text) or text[at] != ":" or isinstance(value, list | dict) or str(value) in pairs:
                        raise self._error(line, "entries {key: value, ...}, each once")
                    pairs[str(value)], at = self._flow(line, text, at + 1, level + 1)
                    at = _skip(text, at)
                else:
                    items.append(value)
                if at < len(text) and text[at] == ",":
                    at = _skip(text, at + 1)
                elif at >= len(text) or text[at] != close:
                    break
            if at >= len(text) or text[at] != close:
                raise self._error(line, f"a closed {'{' if mapping else '['}...{close}")
            return (pairs if mapping else items), at + 1
        # A scalar ends at a sign of the collection around it.
        quoted = re.compile(_QUOTED).match(text, at)
        plain = re.compile(r"(?:[^,\[\]{}:]|:(?=\S)(?![,\[\]{}]))*").match(text, at)
        found = quoted or plain
        assert found is not None
        return self._scalar(line, found[0].strip()), found.end()

    def _scalar(self, line: _Line, text: str) -> Any:
        if text[:1] == '"' and len(text) > 1 and text[-1] == '"':
            return parse_json(text, subject=f"{self.subject}, line {line.number}")
        if text[:1] == "'" and len(text) > 1 and text[-1] == "'":
            return text[1:-1].replace("''", "'")
        if text[:1] in ('"', "'"):
            raise self._error(line, "a text whose quotes are closed on its line")
        if text[:1] in _REFUSED:
            raise self._error(line, "plain values", _REFUSED[text[0]])
        if re.search(r":(\s|$)", text):
            raise self._error(line, "one key a line, or quotes around a text with a colon")
        lowered = text.lower() if text in (text.lower(), text.upper(), text.capitalize()) else text
        if lowered in _WORDS:
            return _WORDS[lowered]
        if _INTEGER.fullmatch(text):
            return int(text)
        return float(text) if _FLOAT.fullmatch(text) else text

    def _error(self, line: _Line, expected: str, received: str = "") -> InputError:
        return InputError(
            f"{self.subject}, line {line.number}",
            expected=expected,
            received=received or repr(line.text[:60]),
            remedy=self.remedy,
        )


def _is_item(text: str) -> bool:
    return text == "-" or text.startswith("- ")


def _without_comment(line: str) -> str:
    """Return a line up to a `#` that stands first or after a space, outside of quotes."""
    quote = ""
    for k, sign in enumerate(line):
        if quote:
            quote = "" if sign == quote and (quote == "'" or line[k - 1] != "\\") else quote
        elif sign in "\"'" and (k == 0 or line[k - 1] in " [{,:-"):
            quote = sign
        elif sign == "#" and (k == 0 or line[k - 1] in " \t"):
            return line[:k]
    return line


def _open_brackets(text: str) -> int:
    bare = re.sub(_QUOTED, "", text)
    return sum(bare.count(sign) for sign in "[{") - sum(bare.count(sign) for sign in "]}")


def _skip(text: str, at: int) -> int:
    while at < len(text) and text[at] == " ":
        at += 1
    return at
