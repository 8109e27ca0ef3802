"""Export a run or a bundle to a file or a series of files: options, formats, and the module that writes each."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from pipelines.commands.options import ClothMode
from pipelines.runs.layout import STUDENT
from smplxpp.core import DEFAULT_FPS, BodyParams, InputError
from smplxpp.core.files.atomic import atomic_folder
from smplxpp.export.by_suffix import ExportOptions

SERIES = ""
"""Suffix of a folder with a file a frame."""
SERIES_FILE = "sequence.json"
"""File of a series that gives the time of each frame."""
PRE_ROLL = 0.7
"""Seconds of motion before the first exported frame that loose clothes follow, so that they swing from the start."""
# Suffixes by format; a suffix of several formats needs --format.
SUFFIXES: dict[str, tuple[str, ...]] = {
    "avatar": (".avatar",),
    "ply": (".ply",),
    "spz": (".spz",),
    "sog": (".sog",),
    "glb": (".glb",),
    "usd": (".usdc", ".usda", ".usd", ".usdz"),
    "fbx": (".fbx",),
    "vrm": (".vrm",),
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
    """Options of `smplxpp export --out`.

    Attributes:
        source: a run, or a bundle of its student.
        out: the file, or the folder of a series.
        format: one of `SUFFIXES`.
        model: "student" or "template", for formats that hold either; "auto": the student where the source has one.
        params: parameters of the pose or the motion; None takes those of the source.
        rows: rows of the parameters: the first, the one after the last (None for the end), and the step.
        fps: frames a second of the parameters; None: as they state.
        cloth: what moves loose clothes along the parameters.
        full_harmonics: whether a PLY has all harmonics.
        up: upward axis of a PLY.
        quiet: whether to hide the progress bar.
        rigged: options of files with a skeleton.
        faces: faces of the template's levels of detail, a file each; () for all of its faces.
        texture_source: what paints the template's texture: "build" as it is, or the "student".
    """

    source: Path
    out: Path
    format: str
    model: str = "auto"
    params: Path | None = None
    rows: tuple[int, int | None, int] = (0, None, 1)
    fps: float | None = None
    cloth: ClothMode = "simulate"
    full_harmonics: bool = False
    up: str = "y"
    quiet: bool = True
    rigged: ExportOptions = field(default_factory=ExportOptions)
    faces: tuple[int, ...] = ()
    texture_source: str = "build"

    @property
    def is_series(self) -> bool:
        """Return whether the output is a folder with a file a frame."""
        return self.out.suffix == SERIES

    @property
    def files(self) -> list[Path]:
        """Return the files of the levels of detail: the output itself, or `NAME_LOD0` and so on for several."""
        if len(self.faces) < 2:
            return [self.out]
        return [self.out.with_name(f"{self.out.stem}_LOD{k}{self.out.suffix}") for k in range(len(self.faces))]

    def chosen(self, count: int, *, moves: bool) -> range:
        """Return the chosen rows of `count`, only the first one for outputs that do not move.

        Raises:
            InputError: no row is left.
        """
        # Negative rows would count from the end in Python; they are refused.
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
        """Return the frame rate of the output."""
        return frames_a_second(params) / self.rows[2]


def frames_a_second(params: BodyParams) -> float:
    """Return the rate of parameters, `DEFAULT_FPS` where they state none."""
    return params.fps or DEFAULT_FPS


def format_of(out: Path, named: str) -> str:
    """Return the format of an output.

    Args:
        out: output path.
        named: format chosen by the user, or "auto".

    Raises:
        InputError: an unknown suffix, one that the format does not have, or a folder for a format that holds a motion.
    """
    # A suffix of one format decides; one of several formats, or a folder, needs --format.
    suffix = out.suffix.lower()
    fitting = [name for name, suffixes in SUFFIXES.items() if suffix in suffixes]
    if suffix == SERIES:
        fitting = [*IN_SERIES]
    if named == "auto" and len(fitting) == 1:
        return fitting[0]
    if named in fitting:
        return named
    # Explain the mismatch in terms of the option that the user gave.
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


# Module and function that return the writers of a format, by model; modules are imported when they are needed.
_SPLATS = ("pipelines.commands.export_files", "splat_writers")
_TEMPLATE = ("pipelines.commands.export_files", "template_writers")
_BY_MODEL = {
    **{("student", name): _SPLATS for name in ("ply", "spz", "sog", "glb", "usd")},
    **{("template", name): _TEMPLATE for name in ("glb", "fbx", "vrm", "usd", "obj")},
}
_STEP = ("pipelines.commands.export_files", "step_writers")
_MOTION = ("pipelines.commands.export_files", "motion_writers")
_FOR_ANY_MODEL = {"onnx": _STEP, "webavatar": _STEP, "bvh": _MOTION, "amass": _MOTION}
Write = Callable[[Path], None]


def export_file(request: FileRequest) -> dict[str, Any]:
    """Write a file or a series of them, whole or not at all.

    Returns:
        "out" (all files, if there are several), "format", "frames", "fps" (None for a single pose), "bytes" and
        "notes", remarks on what was not kept.

    Raises:
        InputError: options that do not go together, a source that lacks what is asked for, parameters of another body.
        MissingExtraError: a package of an extra that is not installed.
    """
    # Find the module that writes this format; OBJ, FBX, VRM and USDZ hold the template, splats are the student's.
    model = "template" if request.out.suffix.lower() in (".obj", ".fbx", ".vrm", ".usdz") else request.model
    model = "template" if request.format == "obj" else model  # a series
    either: list[str] = []
    if model == "auto":
        of_either = ("template", request.format) in _BY_MODEL
        trained = request.source.is_file() or (request.source / STUDENT).is_file()
        model = "template" if of_either and not trained else "student"
        if of_either and trained and request.source.is_dir():
            either = ["the student's splats in a pose; `--model template` writes the rigged, textured mesh"]
    request = replace(request, model=model)
    writers = _FOR_ANY_MODEL.get(request.format) or _BY_MODEL.get((model, request.format))
    if writers is None:
        raise InputError(
            f"output {request.out}",
            expected=f"--model {'template' if model == 'student' else 'student'} for {request.format}",
            received=f"--model {model}",
        )
    # Refuse options without effect, which a user would expect to see in the file.
    for option, given in (("full-harmonics", request.full_harmonics), ("up", request.up != "y")):
        if given and request.format != "ply":
            raise InputError(f"option {option}", expected="a PLY", received=request.format)
    of_template = ("template", request.format) in _BY_MODEL
    painted = request.texture_source != "build"
    if ((request.rigged != ExportOptions() or painted) and model == "student" and of_template) or (
        request.faces and (model == "student" or not of_template or request.is_series)
    ):
        raise InputError(
            "options of the mesh",
            expected=f"--model template and {', '.join(name for model, name in _BY_MODEL if model == 'template')}",
            received=f"--model {model}, {request.format}" + (" in a folder" if request.is_series else ""),
        )
    request.rigged.check(request.out.suffix.lower() or "of a series")
    if request.is_series:
        check_series(request.out)
    # Import the writer only now: some of them need packages of an extra.
    module, function = writers
    fps, frames, notes = getattr(import_module(module), function)(request)
    count = _write_series(request, fps, frames) if request.is_series else _write_files(request, frames)
    return {
        "out": ", ".join(map(str, [request.out] if request.is_series else request.files)),
        "format": request.format,
        "frames": count,
        "fps": fps,
        "bytes": sum(path.stat().st_size for path in (request.out.iterdir() if request.is_series else request.files)),
        "notes": either + list(notes),
    }


def _write_files(request: FileRequest, frames: Iterator[tuple[int, Write]]) -> int:
    counts = []
    for path, (count, write) in zip(request.files, frames, strict=True):
        write(path)
        counts.append(count)
    return max(counts)


def _write_series(request: FileRequest, fps: float | None, frames: Iterator[tuple[int, Write]]) -> int:
    shown = []
    # The first frame is made before any file is touched, so that parameters of another body are refused early.
    first = next(frames)
    with atomic_folder(request.out) as folder:
        for k, (_, write) in enumerate(one for part in ([first], frames) for one in part):
            name = series_name(k, request.format)
            write(folder / name)
            shown.append({"file": name, "seconds": k / (fps or 1.0)})
        (folder / SERIES_FILE).write_text(json.dumps({"fps": fps, "frames": shown}, indent=1))
    return len(shown)
