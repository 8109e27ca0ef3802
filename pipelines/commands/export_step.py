"""A student's step, pose to Gaussians, for programs that run it themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from pipelines.commands.animate_student import open_student
from pipelines.commands.export_request import FileRequest


def writers(request: FileRequest) -> tuple[None, Iterator[tuple[int, Callable[[Path], None]]], list[str]]:
    """Return what writes the file, and no remarks.

    Raises:
        InputError: no student.
    """
    from avatar.formats.onnx_step import write_onnx

    return None, iter([(1, partial(write_onnx, bundle=open_student(request.source, exact=True)))]), []
