"""Read the models and the motion of a run for its window."""

from __future__ import annotations

import logging
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

from pipelines.runs.artefacts import load_params_of_run
from pipelines.runs.layout import (
    ALL_STAGES,
    BAKED,
    GARMENTS,
    GAUSSIANS,
    MODEL_STAGES,
    PARAMS,
    REFINE_STAGE,
    STUDENT,
    TEACHER,
)
from pipelines.runs.stage import STATE_RECORD
from pipelines.stages.build_config import load_build, load_register
from pipelines.stages.run_inputs import params_in_use
from smplxpp.body import load_params
from smplxpp.capture import Capture, open_capture
from smplxpp.cloth.garment_file import load_garments
from smplxpp.core import DEFAULT_FPS, BodyParams, InputError
from smplxpp.template.template import Template

if TYPE_CHECKING:
    from avatar.models.student import Student
    from avatar.models.tracked_surface import Track
    from avatar.rig.rig import Rig
    from avatar.runtime import AvatarPlayer

_WORK = "_work"
_STATE = "state.safetensors"
_SHOWN = {"psnr_crop": "PSNR {:.1f} dB", "loss": "loss {:.4g}"}


@dataclass(frozen=True)
class TrainingNow:
    """Progress of a running training.

    Attributes:
        stage: name of the stage.
        words: step and figures as text.
        age: seconds since its log grew.
        picture: newest preview, or None.
        state: checkpoint, or None.
    """

    stage: str
    words: str
    age: float
    picture: Path | None
    state: Path | None

    def __str__(self) -> str:
        """Return one line of text for the window."""
        old = 120.0
        still = "" if self.age < old else f", and nothing for {self.age / 60:.0f} minutes: it may have been stopped"
        return f"training {self.stage}: {self.words}{still}"


def training_now(run: Path, *, clock: float | None = None) -> TrainingNow | None:
    """Return the progress of the last unfinished stage of a run that has state, or None.

    Args:
        run: folder of the run.
        clock: current time in seconds; None for now.
    """
    # The last stage with a log is the one that runs; earlier work folders are left over from killed trainings.
    for name in reversed((REFINE_STAGE, *MODEL_STAGES)):
        folder = run / f"{name}{_WORK}"
        logs = _by_age(folder, "*metrics.jsonl") or _by_age(folder, STATE_RECORD)
        if not logs:
            continue
        log = logs[-1]
        age = (time.time() if clock is None else clock) - _time(log)
        pictures = _by_age(folder / "previews", "*.png")
        state = folder / _STATE
        words = _words(log, folder) if log.name != STATE_RECORD else "begun"
        return TrainingNow(name, words, age, pictures[-1] if pictures else None, state if state.is_file() else None)
    return None


def _by_age(folder: Path, pattern: str) -> list[Path]:
    return sorted((path for path in folder.rglob(pattern) if path.is_file()), key=_time)


def _time(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # it went while we looked
        return 0.0


def _words(log: Path, folder: Path) -> str:
    from avatar.training.engine.metrics_log import read_metrics

    entries = read_metrics(log)
    kind = "" if log.parent == folder else log.parent.name  # a training before the stage's own
    if not entries:
        return "begun"
    last: dict[str, Any] = next((e for e in reversed(entries) if e["kind"] == "step"), entries[-1])
    figures = [form.format(last[name]) for name, form in _SHOWN.items() if isinstance(last.get(name), float)]
    measured: dict[str, Any] = next((e for e in reversed(entries) if e["kind"] == "evaluation"), {})
    mean = measured.get("mean")
    if isinstance(mean, dict) and isinstance(mean.get("psnr"), float):
        figures.append(f"measured at step {measured['iteration']}: {mean['psnr']:.1f} dB")
    return ", ".join([f"{kind} step {last['iteration']}".strip(), *figures])


log = logging.getLogger(__name__)
_NEWEST_FIRST = (STUDENT, BAKED, GAUSSIANS)
Surface = Callable[[int, BodyParams], Float[np.ndarray, "V 3"] | None]
"""Returns the vertices in the world, metres, of a frame and its parameters; None for a frame that was not tracked."""


@dataclass(frozen=True)
class SplatSource:
    """Source of the Gaussians that are shown; equal sources have equal Gaussians.

    Attributes:
        file: file of a stage.
        state: checkpoint of a training whose attributes replace those of the file, or None.
        changed: modification times of both.
    """

    file: Path
    state: Path | None
    changed: tuple[float, ...]

    @property
    def words(self) -> str:
        """Return the stages of the Gaussians as text."""
        of_file = self.file.parent.name
        if self.state is None:
            return of_file
        return f"{of_file}, attributes as `{self.state.parent.name.removesuffix('_work')}` has them so far"


def newest_splats(run: Path, now: TrainingNow | None) -> SplatSource | None:
    """Find the last model of a run that has Gaussians, and the checkpoint of a later stage; None: there are none."""
    for name in _NEWEST_FIRST:
        file = run / name
        if not file.is_file():
            continue
        later = now is not None and ALL_STAGES.index(now.stage) > ALL_STAGES.index(file.parent.name)
        state = now.state if now is not None and later else None
        try:
            return SplatSource(file, state, tuple(path.stat().st_mtime for path in (file, state) if path is not None))
        except OSError:  # the stage is just being replaced
            return SplatSource(file, None, ())
    return None


def open_player(run: Path, template: Template, source: SplatSource) -> AvatarPlayer:
    """Make what plays the Gaussians of a source.

    Raises:
        InputError: files of another template, or damaged ones.
        MissingExtraError: no torch.
    """
    from avatar.export.bundle import BundleExtras, write_bundle
    from avatar.rig.rig import Rig
    from avatar.runtime import AvatarPlayer, load_bundle

    student = _student(Rig(template), source)
    garments = load_garments(run / GARMENTS, template) if (run / GARMENTS).is_file() else ()
    with tempfile.TemporaryDirectory() as folder:
        write_bundle(Path(folder) / "me.avatar", student, BundleExtras(name=run.resolve().name, garments=garments))
        return AvatarPlayer(load_bundle(Path(folder) / "me.avatar"))


def _student(rig: Rig, source: SplatSource) -> Student:
    from avatar.gaussians.tensor_file import load_bound
    from avatar.models.model_file import load_avatar
    from avatar.models.student import Student, StudentConfig

    # The fit has no networks: its Gaussians become a student without field and blend shapes.
    if source.file.name == Path(GAUSSIANS).name:
        bound = load_bound(source.file, faces=rig.template.faces)
        student = Student(StudentConfig(field=None), rig, bound, ())
    else:
        found = load_avatar(source.file, rig)
        if not isinstance(found, Student):
            raise InputError(f"model {source.file}", expected="a student", received="a teacher")
        student = found
    if source.state is not None:
        _take_attributes(student, source.state)
    return student


def _take_attributes(student: Student, state: Path) -> None:
    """Give a student's Gaussians the attributes of a checkpoint that fit; a file that is being replaced has none."""
    from avatar.gaussians.tensor_file import open_tensor_file
    from avatar.models.learned_gaussians import LEARNED

    try:
        tensors = open_tensor_file(state, subject=f"checkpoint {state}", header="training").tensors()
    except InputError as error:
        log.info("no attributes: %s", error)
        return
    own = student.gaussians.state_dict()
    for name in LEARNED:
        value = tensors.get(f"gaussians.{name}.{name}")
        if value is not None and value.shape == own[name].shape:
            own[name] = value
    student.gaussians.load_state_dict(own)


def tracked_surface(run: Path, template: Template) -> Surface | None:
    """Return the surface that a run's teacher remembers to have followed, read when it is first asked for.

    None: there is no teacher. One that followed nothing has no frame.
    """
    if not (run / TEACHER).is_file():
        return None

    @cache
    def read() -> tuple[Rig, Track | None]:
        from avatar.models.model_file import load_avatar
        from avatar.models.teacher_avatar import TeacherAvatar
        from avatar.rig.rig import Rig

        rig = Rig(template)
        teacher = load_avatar(run / TEACHER, rig)
        return rig, teacher.track if isinstance(teacher, TeacherAvatar) else None

    def at(frame: int, params: BodyParams) -> Float[np.ndarray, "V 3"] | None:
        rig, track = read()
        if track is None or frame not in track.row:
            return None
        # Displacements are along the axes of the T-pose and are added before skinning: x = T(w) (v + dv).
        return rig.skin_to_numpy(rig.pose(params), track.displacements(frame))

    return at


def covariances(quats: Float[np.ndarray, "N 4"], scales: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3 3"]:
    """Return `R S S R^T` of rotations wxyz and standard deviations, metres."""
    fewest = 1e-6
    # Columns of R are the axes of the ellipsoid, in the usual form of a unit quaternion.
    w, x, y, z = (quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), fewest)).T
    R = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        axis=1,
    )
    M = R * scales[:, None, :]
    return M @ np.swapaxes(M, 1, 2)


@dataclass(frozen=True, eq=False)
class ShownMotion:
    """Frames that the viewer can show.

    Attributes:
        params: T frames, without shape.
        numbers: frame numbers of the capture, or 0 to T - 1.
        fps: frames a second.
        source: description of their origin.
        photographed: whether photographs of these frames exist.
    """

    params: BodyParams
    numbers: tuple[int, ...]
    fps: float
    source: str
    photographed: bool = False


def capture_of_run(run: Path, given: Path | None) -> Capture | None:
    """Open the capture that is given, or the one that a run was made from, if it is still there.

    Raises:
        InputError: a folder that is given and is no capture.
    """
    if given is not None:
        return open_capture(given, params=params_in_use(run, None))
    for folder in _remembered(run):
        try:
            return open_capture(folder, params=params_in_use(run, None))
        except InputError as error:
            log.info("no photographs from %s: %s", folder, error)
    return None


def _remembered(run: Path) -> list[Path]:
    """Folders that a run's own records name."""
    registered, built = load_register(run), load_build(run)
    folders = [] if registered is None or registered.root is None else [registered.root]
    if built is not None and built[0].cameras is not None:
        folders += [built[0].cameras.parent]
    return [folder for folder in dict.fromkeys(folders) if folder.is_dir()]


def motion_of_run(
    run: Path, template: Template, capture: Capture | None, given: Path | None, *, fps: float | None = None
) -> ShownMotion:
    """Return the motion that is given, else the capture's frames, else the run's reference pose, else the T-pose.

    Raises:
        InputError: a file that is given and holds no motion of this body.
    """
    if given is not None:
        # The template has the identity: betas must not move the root's joint a second time.
        body = replace(template.body, shapedirs=np.zeros_like(template.body.shapedirs))
        params = load_params(given, body=body).without_shape().with_rate(fps, source=str(given))
        return ShownMotion(params, tuple(range(len(params))), params.fps or DEFAULT_FPS, given.name)
    if capture is not None:
        found = {frame: own for frame in capture.frames if (own := capture.params(frame)) is not None}
        if found:
            whole = BodyParams.concatenate([replace(one, fps=None) for one in found.values()]).without_shape()
            return ShownMotion(
                whole, tuple(found), capture.fps or DEFAULT_FPS, f"capture {capture.name}", photographed=True
            )
    if (run / PARAMS).is_file():
        return ShownMotion(load_params_of_run(run).frame(0).without_shape(), (0,), DEFAULT_FPS, "the reference frame")
    return ShownMotion(BodyParams.rest(betas=0, expressions=0), (0,), DEFAULT_FPS, "the T-pose")
