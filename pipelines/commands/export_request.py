"""What a file of another program is asked for, and what all kinds of them share."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from pipelines.commands.options import ClothMode
from smplxpp.core.errors import InputError
from smplxpp.core.params import DEFAULT_FPS, BodyParams

SERIES = ""
"""The suffix of a folder with a file a frame."""
SERIES_FILE = "sequence.json"
"""Says when each of its files is shown."""
PRE_ROLL = 0.7
"""Seconds of a motion before its first frame that loose clothes follow."""
# Of the formats that a suffix names, or that stand behind others' suffixes.
SUFFIXES: dict[str, tuple[str, ...]] = {
    "avatar": (".avatar",),
    "ply": (".ply",),
    "spz": (".spz",),
    "sog": (".sog",),
    "glb": (".glb",),
    "usd": (".usdc", ".usda", ".usd"),
    "obj": (".obj",),
    "onnx": (".onnx",),
    "bvh": (".bvh",),
    "amass": (".npz",),
    "webavatar": (".npz",),
}
IN_SERIES = ("ply", "spz", "sog", "glb", "obj")
"""Formats that hold one pose, of which a folder can hold many; a USD holds a motion by itself."""


@dataclass(frozen=True, kw_only=True)
class FileRequest:
    """What `smplxpp export --out` is asked for.

    Attributes:
        source: a run, or a bundle of its student. out: the file, or the folder of a series. format: one of `SUFFIXES`.
        model: "student" or "template", for formats that hold either.
        params: of the pose or the motion; None: those of the source.
        rows: of the parameters: the first, the one after the last (None: to the end), and the step.
        cloth: what moves loose clothes along params. full_harmonics, up: of a PLY. quiet: no bar of progress.
    """

    source: Path
    out: Path
    format: str
    model: str = "student"
    params: Path | None = None
    rows: tuple[int, int | None, int] = (0, None, 1)
    cloth: ClothMode = "simulate"
    full_harmonics: bool = False
    up: str = "y"
    quiet: bool = True

    @property
    def is_series(self) -> bool:
        """Whether a folder is asked for."""
        return self.out.suffix == SERIES

    def chosen(self, count: int, *, moves: bool) -> range:
        """Return the rows of `count` that are asked for: of what does not move the first one.

        Raises:
            InputError: none of them.
        """
        first, stop, step = self.rows
        if step < 1:
            raise InputError("option step", expected="1 or more", received=str(step))
        rows = range(count)[first:stop:step] if first >= 0 else range(0)
        if not len(rows):
            raise InputError(
                "frames", expected=f"some of the {count} frames", received=f"--frame {first} --stop {stop}"
            )
        return rows if moves else rows[:1]

    def rate(self, params: BodyParams) -> float:
        """Frames a second of what is written."""
        return frames_a_second(params) / self.rows[2]


def frames_a_second(params: BodyParams) -> float:
    """Return the rate of parameters, `DEFAULT_FPS` where they state none."""
    return params.fps or DEFAULT_FPS


def format_of(out: Path, named: str) -> str:
    """Return the format of an output.

    Args:
        named: by the user, or "auto".

    Raises:
        InputError: a suffix that names none, or another than the format has; a folder of a format that moves by itself.
    """
    suffix = out.suffix.lower()
    fitting = [name for name, suffixes in SUFFIXES.items() if suffix in suffixes]
    if suffix == SERIES:
        fitting = [*IN_SERIES]
    if named == "auto" and len(fitting) == 1:
        return fitting[0]
    if named in fitting:
        return named
    if named != "auto":
        expected = f"a name that ends with {' or '.join(SUFFIXES[named])}"
        expected += ", or a folder (no suffix) with a file a frame" if named in IN_SERIES else ""
        raise InputError(f"output {out}", expected=expected, received=suffix or "no suffix")
    if fitting:
        raise InputError(
            f"output {out}",
            expected=f"--format {' or '.join(fitting)} beside it",
            received="a folder without it" if suffix == SERIES else f"{suffix}, which several formats have",
        )
    known = sorted({one for suffixes in SUFFIXES.values() for one in suffixes})
    raise InputError(
        f"output {out}",
        expected=f"a name that ends with {', '.join(known)}, or a folder with --format",
        received=suffix,
        remedy="`--solid` writes what printers take",
    )


def check_series(out: Path) -> None:
    """Raise `InputError` unless a folder may be replaced: it must not hold anything but an earlier series."""
    if not out.exists():
        return
    names = [path.name for path in out.iterdir()] if out.is_dir() else ["(a file)"]
    foreign = [name for name in names if not name.startswith("frame_") and name != SERIES_FILE]
    if foreign:
        raise InputError(
            f"output {out}",
            expected="a new folder, or one that holds frames alone",
            received=f"{foreign[0]} in it" if out.is_dir() else "a file",
        )


def series_name(number: int, format: str) -> str:
    """Return the name of a series' file."""
    return f"frame_{number:06d}{SUFFIXES[format][0]}"
