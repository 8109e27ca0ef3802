"""Teacher and student as files: safetensors, their configuration in the header, nothing that is executed."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from avatar.gaussians.binding import BoundGaussians, topology_digest
from avatar.models.config_dict import config_from_dict, config_to_dict
from avatar.models.networks.blend_shapes import BlendShapeConfig, BlendShapes
from avatar.models.networks.deformation_field import FieldConfig, show_null_code
from avatar.models.networks.teacher import TeacherConfig
from avatar.models.student import Student, StudentConfig
from avatar.models.teacher_avatar import TeacherAvatar
from avatar.models.tracked_surface import ControlCage, Track
from avatar.rig.rig import Rig
from smplxpp.core.atomic import atomic_write_bytes
from smplxpp.core.errors import InputError

SCHEMA = 1
HEADER = "avatar"
GAUSSIANS = "gaussians."
SHAPES = "blend_shapes."
KINDS = ("teacher", "student")


def save_avatar(path: str | Path, model: TeacherAvatar | Student, *, compact: bool = False) -> int:
    """Write a trained avatar, whole or not at all.

    Args:
        compact: floats in half precision and indices in 32 bits, as a player needs them.

    Returns:
        Bytes of the file.
    """
    about = {"schema": SCHEMA, "face_count": model.gaussians.face_count, "topology": model.gaussians.topology}
    if isinstance(model, TeacherAvatar):
        about |= {"kind": "teacher", "config": config_to_dict(model.config)}
    else:
        config = model.config
        about |= {
            "kind": "student",
            "frames": list(model.frames),
            "null_code_shown": model.codes is not None and model.codes.null_code_shown,
            "control_points": config.control_points,
            "field": None if config.field is None else config_to_dict(config.field),
            "blend_shapes": None if config.blend_shapes is None else config_to_dict(config.blend_shapes),
        }
    tensors = {name: _stored(value, compact) for name, value in model.state_dict().items()}
    data = save(tensors, metadata={HEADER: json.dumps(about)})
    atomic_write_bytes(path, data)
    return len(data)


def load_avatar(path: str | Path, rig: Rig) -> TeacherAvatar | Student:
    """Read what `save_avatar` wrote, on the rig's device.

    Raises:
        InputError: a missing, damaged or foreign file, one of a newer version, or one of another template.
    """
    about, tensors = _read(Path(path))
    tensors = {name: value.float() if value.is_floating_point() else value for name, value in tensors.items()}
    if about["topology"] != topology_digest(rig.faces):
        raise InputError(
            f"avatar {path}",
            expected="one of this template",
            received="Gaussians on other faces",
            remedy="train again: the template was built anew since",
        )
    gaussians = _gaussians(tensors, about)
    model: TeacherAvatar | Student
    if about["kind"] == "teacher":
        model = _teacher(about, tensors, rig, gaussians)
    else:
        model = _student(about, tensors, rig, gaussians)
    _load(model, tensors, path)
    return model.eval()


def _teacher(
    about: Mapping[str, Any], tensors: Mapping[str, Tensor], rig: Rig, gaussians: BoundGaussians
) -> TeacherAvatar:
    teacher = TeacherAvatar(config_from_dict(TeacherConfig, about["config"]), rig, gaussians)
    if "track_controls" in tensors:
        frames, controls = tensors["track_frames"].tolist(), tensors["track_controls"]
        row = {frame: k for k, frame in enumerate(frames)}
        teacher.remember(Track(row, controls, ControlCage(rig, controls.shape[1])))
    return teacher


def _student(about: Mapping[str, Any], tensors: Mapping[str, Tensor], rig: Rig, gaussians: BoundGaussians) -> Student:
    field = None if about["field"] is None else config_from_dict(FieldConfig, about["field"])
    shapes = None
    if about["blend_shapes"] is not None:
        extra = {name: tensors.get(SHAPES + name) for name in ("part", "head_weight", "active")}
        extra = {
            name: value.long() if name != "head_weight" and value is not None else value
            for name, value in extra.items()
        }
        shapes = BlendShapes(config_from_dict(BlendShapeConfig, about["blend_shapes"]), len(gaussians), **extra)
    config = StudentConfig(field, None if shapes is None else shapes.config, about["control_points"])
    student = Student(config, rig, gaussians, tuple(about["frames"]), blend_shapes=shapes)
    if about.get("null_code_shown", True):  # older files do not say: their new poses stay as they were
        show_null_code(student)
    return student


def _read(path: Path) -> tuple[dict[str, Any], dict[str, Tensor]]:
    try:
        with safe_open(path, framework="pt") as file:
            about = json.loads((file.metadata() or {})[HEADER])
            newer = about["schema"] > SCHEMA
            kinds = {name: type(about[name]) for name in ("kind", "topology", "face_count")}
            if not newer and (kinds != {"kind": str, "topology": str, "face_count": int} or about["kind"] not in KINDS):
                raise ValueError(f"an unknown kind of model, {about['kind']!r}")
            tensors = {} if newer else {name: file.get_tensor(name) for name in file.keys()}
    except (OSError, SafetensorError, KeyError, ValueError, TypeError) as error:
        raise InputError(
            f"avatar {path}", expected="a file that `smplxpp train` wrote", received=str(error) or type(error).__name__
        ) from error
    if newer:
        raise InputError(
            f"avatar {path}",
            expected=f"version {SCHEMA} or older",
            received=f"version {about['schema']}",
            remedy="update smplxpp to the version that wrote it",
        )
    return about, tensors


def _gaussians(tensors: Mapping[str, Tensor], about: Mapping[str, Any]) -> BoundGaussians:
    own = {name.removeprefix(GAUSSIANS): value for name, value in tensors.items() if name.startswith(GAUSSIANS)}
    own["face_index"] = own["face_index"].long()
    return BoundGaussians(**own, face_count=about["face_count"], topology=about["topology"])


def _load(model: nn.Module, tensors: Mapping[str, Tensor], path: str | Path) -> None:
    own: Mapping[str, Tensor] = model.state_dict()
    for name, value in own.items():
        if name not in tensors or tensors[name].shape != value.shape:
            raise InputError(
                f"avatar {path}",
                expected=f"{name} of shape {tuple(value.shape)}",
                received="none" if name not in tensors else f"shape {tuple(tensors[name].shape)}",
            )
    model.load_state_dict({name: tensors[name] for name in own})


def _stored(value: Tensor, compact: bool) -> Tensor:
    value = value.detach().cpu().contiguous()
    if compact:
        value = value.half() if value.is_floating_point() else value.int() if value.dtype == torch.int64 else value
    return value
