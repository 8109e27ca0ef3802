"""A student for programs that take the step from pose to Gaussians themselves: ONNX, WebAvatar's players."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from pipelines.commands.animate_student import open_student
from pipelines.commands.export_request import FileRequest


def writers(request: FileRequest) -> tuple[None, Iterator[tuple[int, Callable[[Path], None]]], list[str]]:
    """Return what writes the file, and what it leaves out of the student.

    Raises:
        InputError: no student.
    """
    bundle = open_student(request.source, exact=True)
    if request.format == "onnx":
        from avatar.formats.onnx_step import write_onnx

        return None, iter([(1, partial(write_onnx, bundle=bundle))]), []
    from avatar.formats.webavatar import NOT_FILLED, write_webavatar
    from avatar.runtime import AvatarPlayer

    said = [f"left out: {sentence}" for sentence in NOT_FILLED]
    return None, iter([(1, partial(write_webavatar, player=AvatarPlayer(bundle)))]), said
