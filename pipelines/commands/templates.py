"""Read the template of a run and motions for it, and write its student as a bundle."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.commands.driving import Driving, unshaped
from pipelines.commands.options import require_avatar
from pipelines.runs.layout import PARAMS, TEMPLATE
from smplxpp.core import BodyParams, InputError
from smplxpp.template.template import Template

if TYPE_CHECKING:
    from avatar.speech import Face, StandingBody


def load_run_template(run: Path) -> Template:
    """Load the template of a run.

    Raises:
        InputError: a run without one.
    """
    path = run / TEMPLATE
    if not path.is_file():
        raise InputError(
            f"run {run}",
            expected=f"a finished template in {TEMPLATE}",
            received="a file" if run.is_file() else "a run without it" if run.is_dir() else "no such folder",
            remedy="make it with `smplxpp build`; `smplxpp inspect RUN` tells which stages stand",
        )
    return Template.load(path)


def load_params_for(template: Template, path: Path, *, fps: float | None = None) -> BodyParams:
    """Read a motion, in any layout or of a skeleton, for the body of a template, at its own or a stated rate.

    Raises:
        InputError: no file of parameters, or of another body.
    """
    return Driving().load(path, unshaped(template.body), fps=fps)


def person_of_run(run: Path) -> tuple[Face, StandingBody]:
    """Return the face of a run's template and how its body stands in the reference frame."""
    from avatar.driving import person_of_template
    from pipelines.runs.artefacts import load_params_of_run

    seen = load_params_of_run(run) if (run / PARAMS).is_file() else None
    return person_of_template(load_run_template(run), seen)


BUNDLE_SUFFIX = ".avatar"


def export_bundle(
    run: Path,
    out: Path,
    *,
    name: str | None,
    licence: str,
    params: Path | None,
    exact: bool,
    fps: float | None = None,
) -> dict[str, Any]:
    """Write the student of a run as a bundle, whole or not at all.

    Args:
        run: folder of a training.
        out: file of the bundle.
        name: name of the avatar; None takes the run folder's.
        licence: licence of the avatar.
        params: parameters of the motion to play; None takes the poses of the training.
        exact: whether to keep float32.
        fps: frames a second of the motion; None: as its file states.

    Returns:
        The file, bytes of its pieces, and how many frames it plays.

    Raises:
        InputError: a run without template or student, or parameters of another body.
    """
    require_avatar("exporting a student")
    import avatar

    student = avatar.load(run)
    motion = None if params is None else load_params_for(student.rig.template, params, fps=fps)
    return avatar.export_student(student, out, params=motion, name=name, licence=licence, exact=exact)
