"""Trained avatars opened from disk: a bundle, a student's file beside its template, or the folder of a training."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from avatar.models.model_file import load_avatar
from avatar.models.student import Student, StudentOrigin
from avatar.rig.rig import Rig
from avatar.runtime import AvatarPlayer
from avatar.runtime.bundle import SUFFIX
from smplxpp.body import load_params
from smplxpp.cloth.garment_file import load_garments
from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes
from smplxpp.template.template import Template


@dataclass(frozen=True)
class StudentFiles:
    """Files of a folder from which a student is opened, relative to it.

    Attributes:
        template: the clothed body.
        student: the trained student on it.
        garments: loose clothes; the file need not exist.
        reference: parameters that pose the template as its scan; the file need not exist.
    """

    template: str
    student: str
    garments: str
    reference: str


TRAINING_FILES = StudentFiles("template.npz", "compensate/student.safetensors", "cloth/garments.npz", "reference.npz")
"""Files that `avatar.train` leaves in its folder."""
RUN_FILES = StudentFiles(
    "60_assemble/smplxpp.npz", "90_compensate/student.safetensors", "83_cloth/garments.npz", "08_capture/params.npz"
)
"""Files of a run of the `smplxpp` command; `pipelines.runs.layout` has the same names."""


def load(path: str | Path, *, template: Template | None = None, device: str = "cpu") -> Student | AvatarPlayer:
    """Open a trained avatar from a bundle, a file or a folder.

    Args:
        path: a bundle `NAME.avatar`; a student's file `NAME.safetensors`; or a folder that `avatar.train` or
            `smplxpp train` wrote.
        template: of a student's file; None: the one in the file's folder or in that of the training around it.
        device: of a student's tensors or a bundle's player, see `AvatarPlayer`.

    Returns:
        A player for a bundle, else the student with its template and its loose clothes. `avatar.render` draws either.

    Raises:
        InputError: nothing there, a file of another kind, a damaged one, or a student without its template.
    """
    path = Path(path)
    if path.suffix.lower() == SUFFIX:
        return AvatarPlayer(path, device=device)
    if path.suffix.lower() != ".safetensors":
        return open_student(path, _layout_of(path), device=device)
    if template is not None:
        return _student(path, template, device)
    # The folder of a training is the one of the file or the one around it.
    for folder in (path.parent, path.parent.parent):
        for files in (TRAINING_FILES, RUN_FILES):
            if (folder / files.template).is_file():
                model = _student(path, Template.load(folder / files.template), device)
                model.origin = _origin(folder, files, model.rig.template, path)
                return model
    raise InputError(
        f"student {path}",
        expected="a template beside it",
        received=f"none in {path.parent}",
        remedy="name it: avatar.load(path, template=smplxpp.Template.load(...))",
    )


def open_student(folder: Path, files: StudentFiles, *, device: str = "cpu") -> Student:
    """Open the student of a folder with its template, its loose clothes and the pose of its scan.

    Raises:
        InputError: template or student are missing, damaged or of each other's.
    """
    # The error names the command that makes the missing file.
    for name, what in ((files.template, "template"), (files.student, "student")):
        if not (folder / name).is_file():
            raise InputError(
                f"run {folder}",
                expected=f"a trained student in {files.student}"
                if what == "student"
                else f"a finished template in {name}",
                received="no such folder" if not folder.is_dir() else "a run without it",
                remedy="train it with `smplxpp train`; `smplxpp inspect RUN` tells which stages stand"
                if what == "student"
                else "make it with `smplxpp build`; `smplxpp inspect RUN` tells which stages stand",
            )
    template = Template.load(folder / files.template)
    student = _student(folder / files.student, template, device)
    student.origin = _origin(folder, files, template, folder / files.student)
    return student


def _layout_of(folder: Path) -> StudentFiles:
    """Return which of the known layouts a folder has, that of a run where it has none."""
    return TRAINING_FILES if (folder / TRAINING_FILES.student).is_file() else RUN_FILES


def _student(path: Path, template: Template, device: str) -> Student:
    model = load_avatar(path, Rig(template, device))
    if not isinstance(model, Student):
        raise InputError(f"model {path}", expected="a student", received="a teacher")
    return model


def _origin(folder: Path, files: StudentFiles, template: Template, student: Path) -> StudentOrigin:
    garments, reference = folder / files.garments, folder / files.reference
    digests = {"student": student, "template": folder / files.template}
    # Digests name the files exactly, so that whoever reads a bundle can tell which training it came from. The
    # reference's shape is removed because the template has it in its vertices.
    return StudentOrigin(
        name=folder.resolve().name,
        garments=tuple(load_garments(garments, template)) if garments.is_file() else (),
        reference=load_params(reference).frame(0).without_shape() if reference.is_file() else None,
        digests={name: hashlib.sha256(read_bytes(path)).hexdigest() for name, path in digests.items()},
    )
