"""A run or a bundle in files of other programs: which module writes which format."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from pipelines.commands.export_request import SERIES_FILE, FileRequest, check_series, format_of, series_name
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_folder

__all__ = ["FileRequest", "export_file", "format_of"]
_SPLATS, _TEMPLATE, _MOTION, _STEP = (
    f"pipelines.commands.export_{name}" for name in ("splats", "template", "motion", "step")
)
_ROOM = {
    ("student", "ply"): _SPLATS,
    ("student", "spz"): _SPLATS,
    ("student", "sog"): _SPLATS,
    ("student", "glb"): _SPLATS,
    ("student", "usd"): _SPLATS,
    ("template", "glb"): _TEMPLATE,
    ("template", "usd"): _TEMPLATE,
    ("template", "obj"): _TEMPLATE,
}
_ALONE = {"onnx": _STEP, "webavatar": _STEP, "bvh": _MOTION, "amass": _MOTION}
Write = Callable[[Path], None]


def export_file(request: FileRequest) -> dict[str, Any]:
    """Write a file or a series of them, whole or not at all.

    Returns:
        "out", "format", "frames", "fps" (None: nothing moves), "bytes", and sentences on what went otherwise, "said".

    Raises:
        InputError: options that do not go together, a source that lacks what is asked for, parameters of another body.
        MissingExtraError: a package of an extra that is not installed.
    """
    model = "template" if request.format == "obj" else request.model
    room = _ALONE.get(request.format) or _ROOM.get((model, request.format))
    if room is None:
        raise InputError(
            f"output {request.out}",
            expected=f"--model {'template' if model == 'student' else 'student'} for {request.format}",
            received=f"--model {model}",
        )
    for option, given in (("full-harmonics", request.full_harmonics), ("up", request.up != "y")):
        if given and request.format != "ply":
            raise InputError(f"option {option}", expected="a PLY", received=request.format)
    if request.is_series:
        check_series(request.out)
    fps, frames, said = import_module(room).writers(request)
    count = _write_series(request, fps, frames) if request.is_series else _write_one(request, frames)
    return {
        "out": str(request.out),
        "format": request.format,
        "frames": count,
        "fps": fps,
        "bytes": sum(path.stat().st_size for path in (request.out.iterdir() if request.is_series else [request.out])),
        "said": said,
    }


def _write_one(request: FileRequest, frames: Iterator[tuple[int, Write]]) -> int:
    count, write = next(frames)
    write(request.out)
    return count


def _write_series(request: FileRequest, fps: float | None, frames: Iterator[tuple[int, Write]]) -> int:
    shown = []
    # The first frame is made before any file is touched: parameters of another body are refused here.
    first = next(frames)
    with atomic_folder(request.out) as folder:
        for k, (_, write) in enumerate(one for part in ([first], frames) for one in part):
            name = series_name(k, request.format)
            write(folder / name)
            shown.append({"file": name, "seconds": k / (fps or 1.0)})
        (folder / SERIES_FILE).write_text(json.dumps({"fps": fps, "frames": shown}, indent=1))
    return len(shown)
