"""Write what an export asks for: a template, a file a frame where it moves; its motion; splats and their step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

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

if TYPE_CHECKING:
    from avatar.formats import Splats
    from avatar.runtime import AvatarBundle


Writers = tuple[float | None, Iterator[tuple[int, Callable[[Path], object]]], list[str]]
# Rotations from +y to the upward axis of the file.
_TURNS = {"-y": np.diag([1.0, -1.0, -1.0]), "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])}


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


def splat_writers(
    request: FileRequest,
) -> tuple[float | None, Iterator[tuple[int, Callable[[Path], None]]], list[str]]:
    """Return frames a second, what writes each file with the number of frames in it, and remarks.

    Raises:
        InputError: no student, parameters of another body, rows that are not there.
    """
    import avatar
    from avatar.formats.splats import splats_along
    from avatar.runtime import AvatarPlayer

    # Exact numbers (float32): the export must not contain the bundle's quantisation error.
    bundle = avatar.open_bundle(request.source, exact=True)
    player = AvatarPlayer(bundle)
    # Without parameters: the motion of the bundle, or the rest pose of a bundle without one.
    motion = player.motion if request.params is None else motion_for(bundle, request.params, fps=request.fps)
    motion = BodyParams.rest(betas=0, expressions=0) if motion is None else motion
    # A folder or a USD with parameters holds a motion; all other files hold one pose.
    moves = request.is_series or (request.format == "usd" and request.params is not None)
    rows = request.chosen(len(motion), moves=moves)
    fps = request.rate(motion) if moves and len(rows) > 1 else None
    notes = [] if request.params is None else _far_poses(bundle, motion.select(list(rows)))
    # The field knows the clothes of training poses, so that nothing is simulated there by default.
    cloth = request.cloth if request.params is not None or request.cloth != "simulate" else "field"
    # Evaluate the poses one by one while they are written.
    splats = splats_along(player, motion, rows, cloth=cloth, notes=notes)
    shown = track(
        splats,
        total=len(rows),
        description="frames",
        console=Console(stderr=True),
        disable=request.quiet or fps is None,
    )
    # A USD stores all frames in one file; the other formats get a file for each.
    if request.format == "usd":
        from avatar.formats.splat_scenes import write_splat_usd

        return fps, iter([(len(rows), partial(write_splat_usd, frames=shown, fps=fps))]), notes
    write = _writer(request)
    return fps, ((1, partial(write, splats=one)) for one in shown), notes


def _far_poses(bundle: AvatarBundle, shown: BodyParams) -> list[str]:
    """Return a note on the number of poses far from those of the training, if there are any."""
    from avatar.runtime.skeleton import pose_range

    limits = pose_range(bundle)
    outside = np.zeros(len(shown), bool) if limits is None else limits.outside(shown).any(axis=1)
    if not outside.any():
        return []
    first = f", the first at {int(np.argmax(outside))}," if len(shown) > 1 else ""
    return [
        f"{int(outside.sum())} of {len(shown)} frames{first} turn joints more than 10 degrees farther than training saw"
    ]


def _writer(request: FileRequest) -> Callable[..., None]:
    """Return the function that writes one pose: `write(path, splats=...)`."""
    from avatar import formats

    if request.format != "ply":
        return {
            "spz": formats.write_splat_spz,
            "sog": formats.write_splat_sog,
            "glb": formats.write_splat_glb,
        }[request.format]

    def write(path: Path, *, splats: Splats) -> None:
        turned = splats if request.up == "y" else splats.rotated(_TURNS[request.up])
        formats.write_splat_ply(path, turned.padded() if request.full_harmonics else turned)

    return write


def step_writers(request: FileRequest) -> tuple[None, Iterator[tuple[int, Callable[[Path], None]]], list[str]]:
    """Return the function that writes the step from pose to Gaussians as ONNX or for WebAvatar's players, and notes.

    Raises:
        InputError: no student.
    """
    import avatar

    bundle = avatar.open_bundle(request.source, exact=True)
    if request.format == "onnx":
        from avatar.formats.onnx_step import write_onnx

        return None, iter([(1, partial(write_onnx, bundle=bundle))]), []
    from avatar.formats.webavatar import NOT_FILLED, write_webavatar
    from avatar.runtime import AvatarPlayer

    notes = [f"left out: {sentence}" for sentence in NOT_FILLED]
    return None, iter([(1, partial(write_webavatar, player=AvatarPlayer(bundle)))]), notes
