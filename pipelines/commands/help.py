"""The help of every command, in groups and wrapped as text, and what was probably meant by an unknown word."""

from __future__ import annotations

import ast
import inspect
import math
import shutil
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from difflib import get_close_matches
from functools import cache
from itertools import pairwise, zip_longest
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from smplxpp.core.errors import InputError

NEED, INPUTS, QUALITY, EXPERT = GROUPS = ("what you need", "inputs", "quality and result", "expert")
"""Groups of options in the order in which help shows them."""
NEEDED_OPTIONS = frozenset(("capture", "scan", "out", "text", "audio", "preset", "serve", "single-file"))
"""Options of the first group that are not required: one of several is needed, or one starts with them."""
INPUT_OPTIONS = frozenset(
    (
        *("params", "labels", "labels-a", "labels-b", "keypoints", "masks", "landmarks", "corrections", "label-set"),
        *("protocol", "frame", "frames", "first-frame", "body", "scans", "subject", "initial", "hold-out"),
        *("hold-out-frames", "mesh", "weights", "units", "up", "whose", "detector", "cameras", "calibration"),
        *("plates", "person", "joint-map", "retarget-from", "environment", "environment-turn"),
        *("capture-light", "layout", "joints", "betas", "flat-hand-mean", "curves", "face-model"),
        *("focal-mm", "label-source", "register", "exposure"),
    )
)
EXPERT_OPTIONS = frozenset(
    (
        *("seed", "samples", "force", "device", "json", "from-stage", "until-stage", "stage", "until", "strict"),
        *("accept-failures", "no-report", "no-browser", "port", "host", "verbose", "tensorboard", "batch", "method"),
        *("iterations-share", "fit-iterations", "teacher-iterations", "bake-iterations", "compensate-iterations"),
        *("no-teacher", "keep-bridges", "keep-holes", "dissent", "cell", "hull-only", "outside", "codes", "all"),
        *("checkpoint-minutes", "surface-normals", "precision", "compile", "readers", "cache-gib", "lpips-weights"),
        *("speed-size", "speed-pictures", "perceptual", "key-variable", "truth-step", "normals-step", "sync", "offset"),
    )
)
_NAMED = {NEED: NEEDED_OPTIONS, INPUTS: INPUT_OPTIONS, EXPERT: EXPERT_OPTIONS}
_MANY = "NAME"
"""Stands for one of more choices than a line shows."""
_WIDTHS = (60, 100)
_ALIKE = 0.6
"""Similarity from which on a word is offered for another (`difflib`): a letter or two of a short word may differ."""


@dataclass(frozen=True)
class Option:
    """An option of a command, or a positional argument.

    Attributes:
        name: `--name`, or the name of a positional argument.
        value: what stands for its value; empty for a flag.
        words: its description.
        default: its default as text; empty where there is none worth showing.
        group: one of `GROUPS`.
        choices: the values that it takes; empty where any goes.
    """

    name: str
    value: str
    words: str
    default: str
    group: str
    choices: tuple[str, ...] = ()


def options_of(command: type) -> list[Option]:
    """Return the options of a command's dataclass, those of nested dataclasses without a prefix included.

    Example:
        >>> from pipelines.commands.inspect import Inspect
        >>> [(option.name, option.group) for option in options_of(Inspect)][:2]
        [('RUN', 'what you need'), ('--all', 'expert')]
    """
    hints, words = get_type_hints(command, include_extras=True), _words(command)
    out = []
    for one in fields(command):
        hint, marks = _parts(hints[one.name])
        if isinstance(hint, type) and is_dataclass(hint):
            out += options_of(hint)
        elif one.init and "Suppress" not in marks:
            required = one.default is MISSING and one.default_factory is MISSING
            positional = "Positional" in marks
            plain = one.name.replace("_", "-")
            metavar = next((mark for mark in marks if mark.startswith("=")), "=")[1:]
            if positional:
                name, value = metavar or plain.upper(), ""
            else:
                # The flag of a choice that is on by default takes it away.
                name = f"--{'no-' if one.default is True else ''}{plain}"
                value = "" if hint is bool else metavar or _value(hint)
            group = next((g for g, names in _NAMED.items() if plain in names), QUALITY)
            text = words.get(one.name, "")
            if name.startswith("--no-") and one.default is True and text:
                text = f"Leave out what is done otherwise: {text[0].lower()}{text[1:]}"
            if value == _MANY:
                text += f" One of {', '.join(map(str, _choices(hint)))}."
            asked, taken = NEED if positional or required else group, tuple(map(str, _choices(hint)))
            out.append(Option(name, value, text, _default(one, hint), asked, taken if value else ()))
    return out


def command_help(name: str, command: type, description: str, *, width: int | None = None) -> str:
    """Return the help of a command, wrapped to the terminal's width."""
    width = width or shutil.get_terminal_size().columns
    width = min(max(width, _WIDTHS[0]), _WIDTHS[1]) - 1
    options = options_of(command)
    places = " ".join(option.name for option in options if not option.name.startswith("--"))
    lines = [*textwrap.wrap(f"usage: smplxpp {name} {places} [options]".replace("  ", " "), width), ""]
    lines += textwrap.wrap(f"{description[0].upper()}{description[1:]}.", width)
    for group in GROUPS:
        of_group = [option for option in options if option.group == group]
        if of_group:
            lines += ["", f"{group}:"]
            for option in of_group:
                lines += _entry(option, width)
    if any(option.name == "--out" for option in options):
        lines += ["", "-o stands for --out."]
    return "\n".join(lines) + "\n"


def known_options(command: type) -> list[str]:
    """Return the names of a command's options, with the dashes."""
    return [option.name for option in options_of(command) if option.name.startswith("--")]


def checked_arguments(name: str, command: type, args: Sequence[str]) -> list[str]:
    """Return the arguments of a command with `-o` written out.

    Raises:
        InputError: an option that the command does not have, whose error names those that are written alike; a value
            that is missing, no number or none of the choices.
    """
    options = {option.name: option for option in options_of(command)}
    known = [option for option in options if option.startswith("--")]
    out = ["--out" if arg == "-o" and "--out" in known else arg for arg in args]
    for arg, following in zip_longest(out, out[1:]):
        option, equals, given = arg.partition("=")
        option = option.replace("_", "-")
        if option in known and options[option].value:
            _check_value(name, options[option], given if equals else following)
        if option.startswith("--") and len(option) > 2 and option not in known:
            meant = alike(option, known)
            raise InputError(
                f"option {option} of `smplxpp {name}`",
                expected=f"perhaps {meant}" if meant else "one that the command has",
                received="no such option",
                remedy=f"`smplxpp {name} --help` lists them",
            )
    return out


def _check_value(name: str, option: Option, given: str | None) -> None:
    """Raise InputError where what follows an option is none of its values; of several the first is looked at."""
    kind, several = option.value.removesuffix(" ..."), option.value.endswith(" ...")
    numbers = {"INT": int, "FLOAT": float}
    expected = {"INT": "a whole number", "FLOAT": "a number"}.get(kind, "a value")
    if option.choices:
        expected = f"one of {', '.join(option.choices)}"
    missing = given is None or given.startswith("--")
    if missing and several:
        return
    wrong = missing or (bool(option.choices) and given not in option.choices)
    if not missing and kind in numbers and given != "None":
        try:
            numbers[kind](given)
        except ValueError:
            wrong = True
    if wrong:
        meant = "" if missing else alike(str(given), option.choices, most=1)
        raise InputError(
            f"option {option.name} of `smplxpp {name}`",
            expected=expected + (f", perhaps {meant}" if meant else ""),
            received="none" if missing else repr(given),
            remedy=f"`smplxpp {name} --help` describes it",
        )


def alike(word: str, known: Iterable[str], *, most: int = 2) -> str:
    """Return the known words that one may have meant, `this or that`; empty where none is written alike.

    Example:
        >>> alike("bild", ["build", "train"])
        'build'
    """
    return " or ".join(get_close_matches(word, list(known), n=most, cutoff=_ALIKE))


def _entry(option: Option, width: int) -> list[str]:
    """Return the lines of an option: its name on the left, what it does on the right."""
    left = f"  {option.name} {option.value}".rstrip()
    words = " ".join(option.words.split())
    if option.default:
        words += f" (default: {option.default})"
    column = 22
    text = textwrap.wrap(words, width - column, break_on_hyphens=False) or [""]
    # A name that does not fit beside the text has a line of its own.
    first = [left] if len(left) > column - 2 else [left.ljust(column) + text.pop(0)]
    return [*first, *(" " * column + line for line in text)]


@cache  # because the interpreter parses the whole file of a class to find its source
def _words(command: type) -> dict[str, str]:
    """Read the docstrings below the fields of a dataclass and of those that it extends."""
    out: dict[str, str] = {}
    for cls in reversed(command.__mro__):
        if not is_dataclass(cls):
            continue
        body = ast.parse(textwrap.dedent(inspect.getsource(cls))).body[0].body  # type: ignore[attr-defined]
        for before, after in pairwise(body):
            if isinstance(before, ast.AnnAssign) and isinstance(after, ast.Expr):
                if isinstance(before.target, ast.Name) and isinstance(after.value, ast.Constant):
                    out[before.target.id] = str(after.value.value)
    return out


def _parts(hint: Any) -> tuple[Any, list[str]]:
    """Return a type without its marks, and the marks: `Positional`, `Suppress`, or `=` and the name of a value."""
    marks: list[str] = []
    while get_origin(hint) is Annotated:
        hint, *extra = get_args(hint)
        for mark in extra:
            metavar = getattr(mark, "metavar", None)
            if metavar:
                marks.append(f"={metavar}")
            marks += [word for word in ("Positional", "Suppress") if word.lower() in str(mark).lower()]
    return hint, marks


def _value(hint: Any) -> str:
    """Return what stands for a value of a type in the help."""
    if get_origin(hint) in (Union, UnionType):
        return _value(next(one for one in get_args(hint) if one is not type(None)))
    longest_choices = 34
    if get_origin(hint) is Literal:
        choices = f"{{{','.join(map(str, _choices(hint)))}}}"
        return choices if len(choices) <= longest_choices else _MANY
    if get_origin(hint) in (tuple, list):
        return f"{_value(get_args(hint)[0])} ..."
    return {Path: "PATH", str: "TEXT", int: "INT", float: "FLOAT", bool: "{True,False}"}.get(hint, "VALUE")


def _choices(hint: Any) -> list[Any]:
    """Return the choices of a `Literal`, or of one that may be None."""
    if get_origin(hint) in (Union, UnionType):
        return [choice for one in get_args(hint) for choice in _choices(one)]
    return [one for one in get_args(hint) if one is not None] if get_origin(hint) is Literal else []


def _default(one: Any, hint: Any) -> str:
    """Return the default of a field as text; empty for flags, for optional values and where nothing is the default."""
    value = one.default if one.default is not MISSING else None
    if value is None or hint is bool or value in ("", (), math.inf):
        return ""
    if isinstance(value, tuple):
        return " ".join(f"{part:g}" if isinstance(part, float) else str(part) for part in value)
    return f"{value:g}" if isinstance(value, float) else str(value)
