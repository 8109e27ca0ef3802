"""Stage 97: the student in another light, as pictures beside the one in the capture's."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from avatar.export.bundle import BundleConfig, BundleExtras, write_bundle
from avatar.models.model_file import load_avatar
from avatar.models.student import Student
from avatar.rig.rig import Rig
from avatar.runtime import AvatarPlayer
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.code import TRAINING, sha256_file
from pipelines.runs.folders import own_run_folder
from pipelines.runs.layout import PARAMS, RELIGHT_STAGE, STUDENT, TEMPLATE
from pipelines.runs.stage import Stage, StageOutput, StageRecord, run_stage
from smplxpp.core import BodyParams, InputError
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.light import Relighting
from smplxpp.figures import VIEWS, encode_png, fit_cameras
from smplxpp.template.template import Template

HEIGHT = 560
BEFORE = "before.png"
_WHITE = (1.0, 1.0, 1.0)


def relight(run: Path, name: str, lights: Mapping[str, Relighting], *, force: bool = False) -> StageRecord:
    """Draw a run's student from the front, in the captured light and in others, unless the pictures are up to date.

    Args:
        run: folder of the run.
        name: name of the light.
        lights: lights by the caption of their picture, for instance one light in several directions.
        force: draw again even if the stage is up to date.

    Raises:
        InputError: no template or no student, or a student of another template.
    """
    known = [PARAMS] if (run / PARAMS).is_file() else []
    # The key holds the coefficients of the lights, because a light's name says nothing of its content.
    stage = Stage(
        name=RELIGHT_STAGE,
        config={
            "light": name,
            "height": HEIGHT,
            "lights": {
                caption: [one.light.coefficients.tolist(), one.captured.coefficients.tolist()]
                for caption, one in lights.items()
            },
        },
        inputs={file: sha256_file(run / file) for file in (TEMPLATE, STUDENT, *known)},
        code=(__name__,),
        libraries=TRAINING,
    )

    def work(folder: Path) -> StageOutput:
        # Draw through the bundle and the player, so that the pictures show what a viewer will show.
        player = _player(run, Path(folder))
        params = load_params_of_run(run).frame(0).without_shape() if known else BodyParams.rest(betas=0)
        points = player.pose(params).means.astype(np.float64)
        camera = fit_cameras(points, directions=[VIEWS["front"]], height=HEIGHT)[0]
        files: dict[str, str] = {}
        # The first picture has the captured light and is the reference for all others.
        for k, (caption, relighting) in enumerate([("as captured", None), *lights.items()]):
            image, _ = player.draw(camera, background=_WHITE, relighting=relighting)
            files[caption] = BEFORE if relighting is None else f"relit_{k}.png"
            # Round to 8 bits.
            picture = (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
            atomic_write_bytes(folder / files[caption], encode_png(picture))
        return StageOutput(numbers={"light": name, "pictures": files})

    with own_run_folder(run, (RELIGHT_STAGE, "report")):
        return run_stage(run, stage, work, force=force)


def _player(run: Path, folder: Path) -> AvatarPlayer:
    """Load the student of a run into a player, through a temporary bundle beside `folder`."""
    student = load_avatar(run / STUDENT, Rig(Template.load(run / TEMPLATE)))
    if not isinstance(student, Student):
        raise InputError(f"model {run / STUDENT}", expected="a student", received="a teacher")
    with tempfile.TemporaryDirectory(dir=folder.parent) as beside:
        path = Path(beside) / "student.avatar"
        write_bundle(path, student, BundleExtras(name="student"), BundleConfig(exact=True))
        return AvatarPlayer(path)
