"""What of a run's models the viewer shows: the newest Gaussians as a player, and the surface that was followed."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from pipelines.runs.layout import ALL_STAGES, BAKED, GARMENTS, GAUSSIANS, STUDENT, TEACHER
from pipelines.viewer.training_now import TrainingNow
from smplxpp.cloth.garment_file import load_garments
from smplxpp.core.errors import InputError
from smplxpp.core.params import BodyParams
from smplxpp.template.template import Template

if TYPE_CHECKING:
    from avatar.models.student import Student
    from avatar.models.tracked_surface import Track
    from avatar.rig.rig import Rig
    from avatar.runtime import AvatarPlayer

log = logging.getLogger(__name__)
_NEWEST_FIRST = (STUDENT, BAKED, GAUSSIANS)
_FEWEST = 1e-6
Surface = Callable[[int, BodyParams], Float[np.ndarray, "V 3"] | None]
"""Frame and its parameters to vertices in the world, metres; None for a frame that was not followed."""


@dataclass(frozen=True)
class SplatSource:
    """The file that Gaussians come from; two that are equal have the same ones.

    Attributes:
        file: of a stage. state: checkpoint of a training whose attributes take the file's place; None: none.
        changed: when both were written.
    """

    file: Path
    state: Path | None
    changed: tuple[float, ...]

    @property
    def words(self) -> str:
        """Which stage they are of."""
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
    from avatar.gaussians.bound_file import load_bound
    from avatar.models.model_file import load_avatar
    from avatar.models.student import Student, StudentConfig

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
        return rig.places(rig.motion(params), track.displacements(frame))

    return at


def covariances(quats: Float[np.ndarray, "N 4"], scales: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3 3"]:
    """Return `R S S R^T` of rotations wxyz and standard deviations, metres."""
    w, x, y, z = (quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), _FEWEST)).T
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
