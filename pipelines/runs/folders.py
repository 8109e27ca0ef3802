"""Guard the folder of a run: its lock, what may not be written into, what users put there, and records read back."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

from pipelines.runs.layout import (
    ABLATION,
    ALL_STAGES,
    BUILD_FILE,
    OLD_STAGE_NAMES,
    RECONSTRUCT_FILE,
    REGISTER_FILE,
)
from smplxpp.core.errors import InputError, require_choice
from smplxpp.core.files.atomic import atomic_write_bytes, try_lock
from smplxpp.core.files.json_file import as_integer, as_list, as_number, as_object, as_text, read_json, shown
from smplxpp.core.files.paths import absolute, path_inside, read_bytes, same_place

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

RUNS_OF_A_CAPTURE = "runs"
"""The one folder of a capture in which runs may lie, because no reader of captures looks there."""
LOCK_NAME = ".lock"
_RECORDS = (LOCK_NAME, BUILD_FILE, REGISTER_FILE, RECONSTRUCT_FILE)
SCHEMA = 2
STATUSES = ("fail", "warn", "pass")  # worst first
_OBJECTS = ("inputs", "config", "code", "versions", "numbers", "files")
_DIGESTS = ("inputs", "files")


def keep_out_of_capture(out: Path, capture: Path | None, *, subject: str = "--out") -> None:
    """Refuse an output folder that would mix its files with those of a capture.

    Refused are the capture's own folder, every folder in it but those in its folder `runs`, and a folder of which the
    capture is a stage, or lies in one.

    Args:
        out: output folder, which need not exist.
        capture: folder of the capture that is read, or None.
        subject: the option that names `out`.

    Raises:
        InputError: the folder is refused.
    """
    if capture is None:
        return
    # Compare the paths as given and with links resolved: a link may lead into the capture, or out of it.
    for folder, root in ((absolute(out), absolute(capture)), (out.resolve(), capture.resolve())):
        if folder.is_relative_to(root):
            inside = folder.relative_to(root).parts
            mixed = len(inside) < 2 or inside[0] != RUNS_OF_A_CAPTURE
            received = "the capture's own folder" if not inside else f"{out}, a folder in it"
        else:
            stage = root.relative_to(folder).parts[0] if root.is_relative_to(folder) else ""
            mixed = stage in (*ALL_STAGES, ABLATION)
            received = f"{out}, in which the capture takes the place of {stage}"
        if mixed:
            raise InputError(
                subject,
                expected=f"a folder apart from the capture {capture}",
                received=received,
                remedy=f"choose another folder, as {capture / RUNS_OF_A_CAPTURE / 'NAME'} or runs/{root.name}",
            )


def refuse_old_run(folder: Path) -> None:
    """Refuse a run folder whose stages have the names that earlier versions gave them.

    Its stages would be made again under their new names beside the old ones, and half of the run would be read from
    either. `pipelines.cli` calls this for every folder that a command is given, and `own_run_folder` for every run
    that Python code writes.

    Raises:
        InputError: the folder holds a stage under an old name.
    """
    for old, new in OLD_STAGE_NAMES.items():
        if (folder / old / "manifest.json").is_file():
            raise InputError(
                f"run folder {folder}",
                expected=f"stages named as this version names them ({new})",
                received=f"{old}, which an earlier version wrote",
                remedy="build the run again in a new folder",
            )


def _at_once(path: str, flags: int) -> int:
    """Open a file without blocking, so that a pipe without a reader is an error."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0), 0o666)


@contextmanager
def own_run_folder(run: Path, names: Sequence[str]) -> Iterator[None]:
    """Create and lock the folder `run`, and remove the temporary `.NAME.*` that a killed build left.

    The lock is the operating system's, so that it ends with the process in every case.

    Args:
        names: stems of the stages and files that the caller writes.

    Raises:
        InputError: the folder cannot be written, another build works in it, or its stages have old names.
    """
    refuse_old_run(run)
    new = not run.exists()
    try:
        run.mkdir(parents=True, exist_ok=True)
        lock = open(run / LOCK_NAME, "w", opener=_at_once)
    except OSError as error:
        raise InputError(
            f"run folder {run}",
            expected="a folder that can be written",
            received=error.strerror or str(error),
            remedy="choose another folder",
        ) from None
    # The lock does not wait: a second build in the same run is refused at once.
    with lock:
        if not try_lock(lock.fileno()):
            raise InputError(
                f"run folder {run}",
                expected="no other build in it",
                received="a running one",
                remedy="wait for its end, or choose another folder",
            )
        for name in names:
            # Temporary files of a killed build are incomplete, and under the lock no other process can be writing them.
            for left in run.glob(f".{name}.*"):
                shutil.rmtree(left) if left.is_dir() else left.unlink()
        try:
            yield
        except BaseException:
            if new:
                _remove_if_empty(run)
            raise


def _remove_if_empty(run: Path) -> None:
    """Remove the folder of a first build that failed, unless it holds more than records of what was asked for.

    A finished stage, the state of one that was stopped, a picture that tells why and the user's own files are kept.
    """
    left = list(run.iterdir())
    if all(path.name in _RECORDS for path in left):
        for path in left:
            path.unlink()
        run.rmdir()


def take_file(run: Path, name: str, source: Path | None, *, read: Callable[[Path], object]) -> None:
    """Copy a user's file to its place in a run and replace an older one; None leaves the older one.

    Landmarks and label corrections are such files: stages read them, and none writes them.

    Args:
        run: folder of the run.
        name: file name of `pipelines.runs.layout`.
        source: the user's file.
        read: reader of the file, which refuses a wrong file before anything is replaced.

    Raises:
        InputError: a file that cannot be read, or another command at work in the run.
    """
    if source is None or same_place(source, run / name):
        return
    read(source)
    with own_run_folder(run, (Path(name).stem,)):
        atomic_write_bytes(run / name, read_bytes(source, subject="file", most=1 << 30))


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


_type_hints = cache(get_type_hints)  # annotations are text, which is compiled at each question


def require_plain_fields(cls: type[DataclassInstance], values: Mapping[str, Any], *, subject: str) -> None:
    """Raise `InputError` unless values are of the kinds that a dataclass's annotations name, where these are plain."""
    hints = _type_hints(cls)
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
