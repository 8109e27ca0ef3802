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
from pipelines.figures import VIEWS, encode_png, fit_cameras
from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.code import TRAINING, sha256_file
from pipelines.runs.folders import own_run_folder
from pipelines.runs.layout import PARAMS, RELIGHT_STAGE, STUDENT, TEMPLATE
from pipelines.runs.stage import Stage, StageOutput, StageRecord, run_stage
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.light import Relighting
from smplxpp.core.params import BodyParams
from smplxpp.template.template import Template

HEIGHT = 560
BEFORE = "before.png"
_WHITE = (1.0, 1.0, 1.0)


def relight(run: Path, name: str, lights: Mapping[str, Relighting], *, force: bool = False) -> StageRecord:
    """Draw a run's student from the front, as it was trained and in other lights; skipped while it stands.

    Args:
        name: of the light. lights: by what is said of each picture: the same light, turned.
        force: draw anew even if the stage stands.

    Raises:
        InputError: no template or no student, or a student of another template.
    """
    known = [PARAMS] if (run / PARAMS).is_file() else []
    stage = Stage(
        name=RELIGHT_STAGE,
        config={
            "light": name,
            "height": HEIGHT,
            "lights": {
                said: [one.light.coefficients.tolist(), one.captured.coefficients.tolist()]
                for said, one in lights.items()
            },
        },
        inputs={file: sha256_file(run / file) for file in (TEMPLATE, STUDENT, *known)},
        code=(__name__,),
        libraries=TRAINING,
    )

    def work(folder: Path) -> StageOutput:
        player = _player(run, Path(folder))
        params = load_params_of_run(run).frame(0).without_shape() if known else BodyParams.rest(betas=0)
        points = player.pose(params).means.astype(np.float64)
        camera = fit_cameras(points, directions=[VIEWS["front"]], height=HEIGHT)[0]
        files: dict[str, str] = {}
        for k, (said, relighting) in enumerate([("as captured", None), *lights.items()]):
            image, _ = player.draw(camera, background=_WHITE, relighting=relighting)
            files[said] = BEFORE if relighting is None else f"relit_{k}.png"
            picture = (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
            atomic_write_bytes(folder / files[said], encode_png(picture))
        return StageOutput(numbers={"light": name, "pictures": files})

    with own_run_folder(run, (RELIGHT_STAGE, "report")):
        return run_stage(run, stage, work, force=force)


def _player(run: Path, folder: Path) -> AvatarPlayer:
    student = load_avatar(run / STUDENT, Rig(Template.load(run / TEMPLATE)))
    if not isinstance(student, Student):
        raise InputError(f"model {run / STUDENT}", expected="a student", received="a teacher")
    with tempfile.TemporaryDirectory(dir=folder.parent) as beside:
        path = Path(beside) / "student.avatar"
        write_bundle(path, student, BundleExtras(name="student"), BundleConfig(exact=True))
        return AvatarPlayer(path)
