"""A run's trained student to a bundle: what of the run goes into it, and what it says of where it came from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.commands.options import require_avatar
from pipelines.commands.templates import load_params_for, load_run_template
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.code import sha256_file
from pipelines.runs.layout import GARMENTS, PARAMS, STUDENT, TEMPLATE
from smplxpp import __version__
from smplxpp.cloth.garment_file import load_garments
from smplxpp.core.errors import InputError
from smplxpp.core.params import DEFAULT_FPS, BodyParams

SUFFIX = ".avatar"
# Of poses that training saw, where nobody says how fast they came.


def export_bundle(
    run: Path, out: Path, *, name: str | None, licence: str, params: Path | None, exact: bool
) -> dict[str, Any]:
    """Write the student of a run as a bundle, whole or not at all.

    Args:
        name, licence: of the avatar; no name: the run folder's.
        params: the motion that it has to play; None: the poses that training saw.
        exact: keep float32.

    Returns:
        The file, bytes of its pieces, and how many frames it plays.

    Raises:
        InputError: a run without template or student, or parameters of another body.
    """
    require_avatar("exporting a student")
    template = load_run_template(run)
    if not (run / STUDENT).is_file():
        raise InputError(
            f"run {run}",
            expected=f"a trained student in {STUDENT}",
            received="a run without it",
            remedy="train it with `smplxpp train`; `smplxpp inspect RUN` tells which stages stand",
        )
    motion = None if params is None else load_params_for(template, params)
    from avatar.export.bundle import BundleConfig, BundleExtras, write_bundle
    from avatar.models.model_file import load_avatar
    from avatar.models.student import Student
    from avatar.rig.rig import Rig

    student = load_avatar(run / STUDENT, Rig(template))
    if not isinstance(student, Student):
        raise InputError(f"model {run / STUDENT}", expected="a student", received="a teacher")
    if motion is None and student.pose_gate is not None:
        motion = _seen(run, student.pose_gate.poses.cpu().double().numpy())
    extras = BundleExtras(
        name=name or run.resolve().name,
        licence=licence,
        provenance={
            "made by": f"smplxpp {__version__}",
            "student": sha256_file(run / STUDENT),
            "template": sha256_file(run / TEMPLATE),
        },
        garments=load_garments(run / GARMENTS, template) if (run / GARMENTS).is_file() else (),
        motion=motion,
    )
    sizes = write_bundle(out, student, extras, BundleConfig(exact=exact))
    return {"out": str(out), "bytes": sizes, "frames": 0 if motion is None else len(motion)}


def _seen(run: Path, poses: np.ndarray) -> BodyParams:
    """The poses that training saw, one after the other, standing where the reference frame does."""
    if (run / PARAMS).is_file():
        reference = load_params_of_run(run).frame(0).without_shape()
    else:
        reference = BodyParams.rest(betas=0)
    still = reference.select(np.zeros(len(poses), dtype=np.int64))
    return replace(still, body_pose=poses, fps=reference.fps or DEFAULT_FPS)
