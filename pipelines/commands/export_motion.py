"""A motion, for a run's or a bundle's body, in files of animation programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

from pipelines.commands.animate_student import motion_for, open_student
from pipelines.commands.export_bundle import SUFFIX
from pipelines.commands.export_request import FileRequest
from pipelines.commands.templates import load_params_for, load_run_template
from smplxpp.core.errors import InputError
from smplxpp.export.amass import write_amass
from smplxpp.export.bvh import write_bvh


def writers(request: FileRequest) -> tuple[float, Iterator[tuple[int, Callable[[Path], None]]], list[str]]:
    """Return frames a second, what writes the file with the number of frames in it, and no remarks.

    Raises:
        InputError: no motion, no body, parameters of another body, rows that are not there.
    """
    if request.params is None:
        raise InputError("option params", expected=f"a motion to write as {request.format}", received="none")
    if request.source.suffix.lower() == SUFFIX:
        from avatar.runtime.skeleton import skeleton_body

        bundle = open_student(request.source)
        body = skeleton_body(bundle)
        joints, params = body.v_template, motion_for(bundle, request.params)
    else:
        template = load_run_template(request.source)
        body, joints, params = template.body, template.joints, load_params_for(template, request.params)
    rows = request.chosen(len(params), moves=True)
    fps = request.rate(params)
    chosen = replace(params.select(list(rows)), fps=fps)
    if request.format == "bvh":
        write: Callable[[Path], None] = partial(write_bvh, body=body, params=chosen, joints=joints)
    else:
        write = partial(write_amass, body=body, params=chosen)
    return fps, iter([(len(chosen), write)]), []
