"""Write a student to a file: a bundle for players, splats of a pose or motion, or its step as ONNX."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np

from avatar.export.bundle import BundleConfig, BundleExtras, write_bundle
from avatar.formats.splats import splats_along
from avatar.models.student import Student
from avatar.runtime import AvatarBundle, AvatarPlayer, load_bundle
from avatar.runtime.bundle import SUFFIX
from smplxpp import __version__
from smplxpp.core import DEFAULT_FPS, BodyParams, InputError

_WRITERS = {
    ".ply": "avatar.formats.ply:write_splat_ply",
    ".spz": "avatar.formats.packed_splats:write_splat_spz",
    ".sog": "avatar.formats.packed_splats:write_splat_sog",
    ".glb": "avatar.formats.splat_scenes:write_splat_glb",
}
_MOVING = (".usdc", ".usda", ".usd")
SUFFIXES = (SUFFIX, *_WRITERS, *_MOVING, ".onnx")
"""Kinds of files that `export_student` writes."""


def export_student(
    student: Student,
    path: str | Path,
    *,
    params: BodyParams | None = None,
    cloth: Literal["simulate", "field", "skin"] = "simulate",
    name: str | None = None,
    licence: str = "",
    exact: bool = False,
) -> dict[str, Any]:
    """Write a student to a file, whose suffix selects the format; a failed write leaves no file.

    Args:
        student: with its loose clothes and the pose of its scan, as `avatar.train` and `avatar.load` give it.
        path: NAME.avatar (bundle), NAME.ply .spz .sog .glb (splats of a pose), NAME.usdc (splats that move), NAME.onnx.
        params: motion of a bundle or of moving splats, or pose of other splats (its first frame); None: the poses of
            the training.
        cloth: motion of loose clothes in splats along `params`: simulated, by the student's field, or by skinning.
        name: of the avatar in a bundle; None: the student's.
        licence: of the avatar, for the bundle.
        exact: keep every number of a bundle in float32.

    Returns:
        "out", "bytes" of the file (of a bundle: by its pieces, and "total") and the number of "frames".

    Raises:
        InputError: another suffix, or parameters of another body.
    """
    # The suffix decides; a bundle keeps the student's motion, every other file is made through a bundle in memory, so
    # that all files show the same avatar as a player does.
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"output {path}", expected=f"a name that ends with {', '.join(SUFFIXES)}", received=suffix)
    if suffix == SUFFIX:
        return export_bundle(student, path, name=name, licence=licence, motion=params, exact=exact)
    bundle = bundle_of_student(student, exact=True)
    frames = 1
    if suffix == ".onnx":
        import_module("avatar.formats.onnx_step").write_onnx(path, bundle=bundle)
    else:
        # The pose: that of the parameters, else the first one of the training, else the rest pose.
        player = AvatarPlayer(bundle)
        motion = params if params is not None else seen_poses(student)
        motion = BodyParams.rest(betas=0, expressions=0) if motion is None else motion
        if suffix in _MOVING and params is not None:
            frames = len(motion)
        # Poses of the training are no motion in time: nothing is simulated along them.
        mode = cloth if params is not None or cloth != "simulate" else "field"
        splats = splats_along(player, motion, range(frames), cloth=mode)
        if suffix in _MOVING:
            # A single frame is written without samples in time.
            fps = (motion.fps or DEFAULT_FPS) if frames > 1 else None
            import_module("avatar.formats.splat_scenes").write_splat_usd(path, frames=splats, fps=fps)
        else:
            module, function = _WRITERS[suffix].split(":")
            getattr(import_module(module), function)(path, splats=next(splats))
    return {"out": str(path), "bytes": path.stat().st_size, "frames": frames}


def export_bundle(
    student: Student,
    path: Path,
    *,
    name: str | None = None,
    licence: str = "",
    motion: BodyParams | None = None,
    exact: bool = False,
    provenance: Mapping[str, str] | None = None,
) -> dict[str, Any]:
    """Write a student as a bundle for players; a failed write leaves no file.

    Args:
        student: with its loose clothes.
        path: NAME.avatar.
        name: of the avatar; None: the student's.
        licence: of the avatar.
        motion: to play; None: the poses of the training.
        exact: keep float32.
        provenance: sources of the avatar; None: this version, and the digests of the student's files.

    Returns:
        The file ("out"), "bytes" of its pieces and "total", and the number of "frames" that it plays.
    """
    # The provenance ties a bundle to the files of its training by their digests.
    motion = seen_poses(student) if motion is None else motion
    origin = student.origin
    extras = BundleExtras(
        name=name or origin.name,
        licence=licence,
        provenance={"made by": f"smplxpp {__version__}", **origin.digests} if provenance is None else provenance,
        garments=origin.garments,
        motion=motion,
    )
    sizes = write_bundle(path, student, extras, BundleConfig(exact=exact))
    return {"out": str(path), "bytes": sizes, "frames": 0 if motion is None else len(motion)}


def seen_poses(student: Student) -> BodyParams | None:
    """Return the poses of the training in order, at its rate and the place of the scan; None: not known."""
    if student.pose_gate is None:
        return None
    # Stored poses are the 21 body joints alone; everything else (hands, place) comes from the pose of the scan.
    poses = student.pose_gate.poses.cpu().double().numpy()
    reference = student.origin.reference
    reference = BodyParams.rest(betas=0) if reference is None else reference
    still = reference.select(np.zeros(len(poses), dtype=np.int64))
    return replace(still, body_pose=poses, fps=student.fps or DEFAULT_FPS)


def bundle_of_student(student: Student, *, exact: bool = False) -> AvatarBundle:
    """Return a student as a bundle in memory, as it would be read from its file.

    Args:
        student: with its loose clothes.
        exact: keep every number in float32.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"student{SUFFIX}"
        export_bundle(student, path, exact=exact)
        return load_bundle(path)
