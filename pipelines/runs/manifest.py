"""The records of stages as they are read back: a record whose entries are of other kinds is none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

from smplxpp.core.errors import InputError, require_choice
from smplxpp.core.files.json_file import as_integer, as_list, as_number, as_object, as_text, read_json, shown
from smplxpp.core.files.paths import path_inside

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SCHEMA = 2
STATUSES = ("fail", "warn", "pass")  # worst first
_OBJECTS = ("inputs", "config", "code", "versions", "numbers", "files")
_DIGESTS = ("inputs", "files")


def read_record(path: Path) -> dict[str, Any]:
    """Read a stage's manifest or the record of its state; entries that are missing are empty.

    Raises:
        InputError: missing, damaged, of another version, or with entries of other kinds.
    """
    subject = f"record {path.parent.name}/{path.name}"
    content = as_object(read_json(path, subject="record of a stage"), subject=subject)
    # In Python True equals 1, so that a boolean would pass for version 1.
    if content.get("schema") != SCHEMA or isinstance(content["schema"], bool):
        raise InputError(subject, expected=f"version {SCHEMA}", received=f"version {shown(content.get('schema'))}")
    for name in _OBJECTS:
        as_object(content.setdefault(name, {}), subject=f"{subject}: {name}")
    for name in _DIGESTS:
        for file, digest in content[name].items():
            as_text(digest, subject=f"{subject}: {name}: {file}")
    # Names of files have to stay inside of the stage, because they are opened later.
    for file in content["files"]:
        path_inside("stage", file, subject=f"{subject}: files")
    most_seconds = 1e12
    as_number(content.setdefault("seconds", 0.0), subject=f"{subject}: seconds", least=0.0, most=most_seconds)
    for check in as_list(content.setdefault("checks", []), subject=f"{subject}: checks"):
        require_check(check, subject=f"{subject}: check")
    return content


def require_plain_fields(cls: type[DataclassInstance], values: Mapping[str, Any], *, subject: str) -> None:
    """Raise `InputError` unless values are of the kinds that a dataclass's annotations name, where these are plain."""
    hints = get_type_hints(cls)
    for field in fields(cls):
        value, place = values.get(field.name), f"{subject}: {field.name}"
        optional = str(field.type).endswith(" | None")
        if field.name not in values or (optional and value is None):
            continue
        if get_origin(hints[field.name]) is Literal:
            require_choice(place, as_text(value, subject=place), get_args(hints[field.name]))
        match str(field.type).removesuffix(" | None"):
            case "int":
                as_integer(value, subject=place)
            case "float":
                as_number(value, subject=place)
            case "str":
                as_text(value, subject=place)
            case "bool":
                if not isinstance(value, bool):
                    raise InputError(place, expected="true or false", received=shown(value))
            case "dict[str, int]":
                for name, number in as_object(value, subject=place).items():
                    as_integer(number, subject=f"{place}: {name}")


def require_check(value: Any, *, subject: str) -> dict[str, Any]:
    """The value, if it is the record of a check: a name, a status, a number or none.

    Raises:
        InputError: anything else.
    """
    check = as_object(value, subject=subject)
    as_text(check.get("name"), subject=f"{subject}: name")
    if check.get("status") not in STATUSES:
        raise InputError(f"{subject}: status", expected=" or ".join(STATUSES), received=shown(check.get("status")))
    if check.get("value") is not None:
        as_number(check["value"], subject=f"{subject}: value")
    return check
