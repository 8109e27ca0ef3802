"""Export a template as rigged GLB, FBX or USD or as OBJ, a file a frame where it moves, and motions as BVH or AMASS."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float
from rich.console import Console
from rich.progress import track

from pipelines.commands.animate_student import motion_for
from pipelines.commands.export_request import PRE_ROLL, FileRequest, frames_a_second
from pipelines.commands.options import require_avatar
from pipelines.commands.templates import BUNDLE_SUFFIX, load_params_for, load_run_template
from pipelines.runs.layout import GARMENTS
from smplxpp.body.layout import names_of_joints
from smplxpp.build.detail import simplified_template
from smplxpp.cloth.garment_file import load_garments
from smplxpp.cloth.play import play
from smplxpp.core import BodyParams, InputError
from smplxpp.export.by_suffix import export_template, pruning_error, with_texture_size
from smplxpp.export.motion_files import write_amass, write_bvh
from smplxpp.template.template import Template

Writers = tuple[float | None, Iterator[tuple[int, Callable[[Path], object]]], list[str]]


def template_writers(request: FileRequest) -> Writers:
    """Return frames a second, what writes each file with the number of frames in it, and remarks.

    Raises:
        InputError: no template, parameters of another body, rows that are not there, a series without a motion.
    """
    # An OBJ has no skeleton: its surfaces are posed here. The others store skeleton and motion.
    template = load_run_template(request.source)
    params = None if request.params is None else load_params_for(template, request.params, fps=request.fps)
    if request.texture_source == "student":
        template = _painted(request, template)
    # A motion places the person by itself; in the T-pose she stands on the floor.
    template = template.on_floor() if params is None else template
    if request.format == "obj":
        return _surfaces(request, with_texture_size(template, request.rigged.texture_size), params)
    if request.is_series:
        raise InputError(
            f"output {request.out}",
            expected=f"a file: a template's {request.format} holds the motion itself",
            received="a folder",
        )
    chosen = None
    if params is not None:
        rows = request.chosen(len(params), moves=True)
        chosen = replace(params.select(list(rows)), fps=request.rate(params))
    levels, notes = _levels(request, template)
    if request.rigged.max_influences is not None:
        notes.append(_pruned(template, request.rigged.max_influences))
    write = partial(export_template, animation=chosen, options=request.rigged)
    count = 1 if chosen is None else len(chosen)
    files = iter([(count, partial(write, template=level)) for level in levels])
    return None if chosen is None else chosen.fps, files, notes


def _painted(request: FileRequest, template: Template) -> Template:
    """Return the template with its student's appearance as its texture."""
    require_avatar("painting the student on the template")
    import avatar
    from avatar.export.posed import student_texture

    student, asked = avatar.load(request.source), request.rigged.texture_size
    if asked == 0:
        raise InputError("option texture-source", expected="a --texture-size above 0", received="0")
    own = 2048 if template.texture is None else template.texture.size
    return replace(template, texture=student_texture(student, size=asked or own))


def _levels(request: FileRequest, template: Template) -> tuple[list[Template], list[str]]:
    """Return the levels of detail that are asked for, all before one is written, and how many faces they have."""
    if not request.faces:
        return [template], []
    levels = [simplified_template(template, faces) for faces in request.faces]
    named = zip(request.files, levels, strict=True)
    return levels, [f"{path.name}: {len(level.faces):,} faces" for path, level in named]


def _pruned(template: Template, most: int) -> str:
    """Say what fewer joints a vertex do to the template."""
    error = pruning_error(template, most)
    return (
        f"weights of at most {most} joints move vertices in stress poses by up to {error.worst_mm:.1f} mm "
        f"({error.part}, {error.pose}), 99 % of them by at most {error.p99_mm:.1f} mm"
    )


def _surfaces(request: FileRequest, template: Template, params: BodyParams | None) -> Writers:
    from smplxpp.export.obj import write_obj

    if params is None:
        if request.is_series:
            raise InputError("option params", expected="a motion, for a file a frame", received="none")
        levels, coarser = _levels(request, template)
        return None, iter([(1, partial(write_obj, template=level)) for level in levels]), coarser
    if request.faces:
        raise InputError(
            "option faces",
            expected="an OBJ of the T-pose",
            received="one of --params, whose clothes have all their faces",
        )
    rows = request.chosen(len(params), moves=request.is_series)
    notes: list[str] = []
    surfaces = track(
        _posed(request, template, params, rows, notes),
        total=len(rows),
        description="frames",
        console=Console(stderr=True),
        disable=request.quiet or len(rows) == 1,
    )
    # The generator poses one frame at a time while files are written, so that a long motion needs little memory.
    files = ((1, partial(write_obj, template=replace(template, vertices=surface))) for surface in surfaces)
    return request.rate(params) if request.is_series else None, files, notes


def _posed(
    request: FileRequest, template: Template, params: BodyParams, rows: range, notes: list[str]
) -> Iterator[Float[np.ndarray, "V 3"]]:
    """Yield the surfaces of the chosen rows; loose clothes are simulated from `PRE_ROLL` before the first."""
    # A template has no field. Without garments in the run all parts follow the joints.
    path, rate = request.source / GARMENTS, frames_a_second(params)
    if request.cloth == "field":
        raise InputError("option cloth", expected="simulate or skin for the template", received="field")
    if request.cloth == "skin" or not path.is_file():
        for k in rows:
            yield template.pose(params.frame(k))[0]
        return
    # Simulate every frame from the pre-roll on, and yield only the chosen rows.
    begin = max(0, rows[0] - round(PRE_ROLL * rate))
    whole = params.select(slice(begin, rows[-1] + 1))
    surfaces = play(template, load_garments(path, template), whole, fps=rate, notes=notes)
    for k, surface in enumerate(surfaces, start=begin):
        if k in rows:
            yield surface


def motion_writers(request: FileRequest) -> tuple[float, Iterator[tuple[int, Callable[[Path], None]]], list[str]]:
    """Return frames a second, what writes the file with the number of frames in it, and no remarks.

    Raises:
        InputError: no motion, no body, parameters of another body, rows that are not there.
    """
    if request.params is None:
        raise InputError("option params", expected=f"a motion to write as {request.format}", received="none")
    # A bundle has the student's skeleton; a run has the template with its joint positions.
    if request.source.suffix.lower() == BUNDLE_SUFFIX:
        import avatar
        from avatar.runtime.skeleton import skeleton_body

        bundle = avatar.open_bundle(request.source)
        body = skeleton_body(bundle)
        joints, params = body.v_template, motion_for(bundle, request.params, fps=request.fps)
    else:
        template = load_run_template(request.source)
        body, joints, params = (
            template.body,
            template.joints,
            load_params_for(template, request.params, fps=request.fps),
        )
    # The frame rate shrinks with the step, so that the motion keeps its speed.
    rows = request.chosen(len(params), moves=True)
    fps = request.rate(params)
    chosen = replace(params.select(list(rows)), fps=fps)
    if request.format == "bvh":
        named = replace(body, joint_names=names_of_joints(body.joint_names, request.rigged.joint_names))
        write: Callable[[Path], None] = partial(write_bvh, body=named, params=chosen, joints=joints)
    else:
        write = partial(write_amass, body=body, params=chosen)
    return fps, iter([(len(chosen), write)]), []
