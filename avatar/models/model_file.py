"""Files of teacher and student: safetensors with the configuration in the header; nothing is executed."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from safetensors.torch import save
from torch import Tensor, nn

from avatar.gaussians.binding import BoundGaussians, topology_digest
from avatar.gaussians.tensor_file import bound_from_tensors, open_tensor_file, require_finite, require_like
from avatar.models.networks.blend_shapes import BlendShapeConfig, BlendShapes, mapping_networks
from avatar.models.networks.config_dict import config_from_dict, config_to_dict
from avatar.models.networks.deformation_field import FieldConfig, FieldNetwork, show_null_code
from avatar.models.networks.pose_dependence import PoseRegression
from avatar.models.networks.teacher import Teacher, TeacherConfig
from avatar.models.student import Student, StudentConfig
from avatar.models.teacher_avatar import TRACK_ERRORS, TeacherAvatar
from avatar.models.tracked_surface import ControlCage, Track
from avatar.rig.rig import THETA, Rig
from smplxpp.core.errors import InputError
from smplxpp.core.files.atomic import atomic_write_bytes
from smplxpp.core.files.json_file import as_integer, as_list, as_number, as_object, shown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SHAPES = "blend_shapes."
Config = TypeVar("Config", bound="DataclassInstance")


@dataclass(frozen=True, eq=False)
class StoredModel:
    """Header and tensors of a model file.

    Attributes:
        about: the header's values.
        tensors: by name.
        subject: of error messages.
    """

    about: Mapping[str, Any]
    tensors: Mapping[str, Tensor]
    subject: str

    def config(self, name: str, cls: type[Config], *, optional: bool = False) -> Config | None:
        """Read a configuration from the header; None for null where it is optional."""
        if name not in self.about:
            raise InputError(self.subject, expected=f"{name} in the metadata", received="none")
        value = self.about[name]
        return None if value is None and optional else config_from_dict(cls, as_object(value, subject=name))

    def frames(self) -> tuple[int, ...]:
        """Read the frames that have a code."""
        values = as_list(self.about.get("frames"), subject="frames")
        last_frame = 1 << 53
        return tuple(as_integer(value, subject="frame of a code", least=0, most=last_frame) for value in values)

    def require(self, name: str, shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> Tensor:
        """Return a tensor, checked for shape and type.

        Raises:
            InputError: a missing tensor, or one of another shape or type.
        """
        # A tensor on the device "meta" has a shape and a type, and takes no memory.
        require_like(self.tensors, {name: torch.empty(shape, dtype=dtype, device="meta")}, subject=self.subject)
        return self.tensors[name]

    def require_networks(self, makers: Mapping[str, Callable[[], nn.Module]]) -> None:
        """Require the tensors of networks by name, in their shapes, else raise `InputError`.

        The networks are made on the meta device, so that wrong sizes in the header allocate no memory.
        """
        for name, make in makers.items():
            with torch.device("meta"):
                network = make()
            state = network.state_dict(prefix=f"{name}.", keep_vars=True)
            require_like(self.tensors, state, subject=self.subject)

    def track(self, most: int) -> tuple[list[int], Tensor]:
        """Read the frames (T,) and control points (T, K, 3) of the tracked surface, K at most `most`."""
        controls = self.tensors["track_controls"]
        if controls.ndim != 3 or controls.shape[2] != 3 or not 1 <= controls.shape[1] <= most:
            raise InputError(
                "track_controls", expected=f"shape (T, K, 3), K up to {most}", received=f"shape {tuple(controls.shape)}"
            )
        self.require("track_controls", tuple(controls.shape))
        # Rows of the controls belong to these frames, in this order.
        frames = self.require("track_frames", (len(controls),), torch.int64).tolist()
        if len(set(frames)) != len(frames):
            raise InputError("track_frames", expected="each frame once", received="one of them again")
        return frames, controls

    def track_errors(self, frames: int, count: int) -> dict[str, Tensor]:
        """Read the errors of a track that the file has, "sigma" and "drift", metres, as arguments of `Track`."""
        shapes = {"sigma": (frames, count), "drift": (count,)}
        present = as_list(self.about.get("track_tells", []), subject="track_tells")  # older files: none
        return {name: self.require(f"track_{name}", shape) for name, shape in shapes.items() if name in present}

    def poses(self, name: str) -> Tensor:
        """Read poses (T, 63) of at least one frame, radians."""
        value = self.tensors[name]
        rows = len(value) if value.ndim == 2 else 0
        if not rows:
            raise InputError(name, expected="shape (T, 63)", received=f"shape {tuple(value.shape)}")
        return self.require(name, (rows, THETA))

    def directions(self, name: str) -> tuple[int, int]:
        """Return the number of points and of directions of a regression's basis; directions are at most 63."""
        value = self.tensors[name]
        if value.ndim != 3 or not 1 <= value.shape[2] <= THETA:
            raise InputError(name, expected=f"shape (K, 3, r), r up to {THETA}", received=f"shape {tuple(value.shape)}")
        return value.shape[0], value.shape[2]

    def blended(self, config: BlendShapeConfig, count: int) -> dict[str, Tensor | None]:
        """Return the tensors from which blend shapes of `count` Gaussians are made, as arguments of `BlendShapes`."""
        # Pruned blend shapes have fewer rows of U and C than Gaussians; part and head weight exist for all Gaussians.
        active = self.tensors.get(f"{SHAPES}active")
        rows = len(active) if active is not None and active.ndim == 1 else count
        self.require(f"{SHAPES}active", (rows,), torch.int64)
        for name in ("U", "C"):
            self.require(f"{SHAPES}{name}", (rows, 3, config.shapes))
        kept: dict[str, Tensor | None] = {"active": self.tensors[f"{SHAPES}active"].long()}
        several, gated = config.parts > 1, config.gated
        kept["part"] = self.require(f"{SHAPES}part", (count,), torch.int64).long() if several else None
        kept["head_weight"] = self.require(f"{SHAPES}head_weight", (count,)) if gated else None
        return kept


SCHEMA = 2
"""Version of the format; since 2 students may have a regression for new poses."""
HEADER = "avatar"
GAUSSIANS = "gaussians."
KINDS = ("teacher", "student")
_EXPECTED = "a file that `smplxpp train` wrote"
_REMEDY = "take the file as `smplxpp train` wrote it, or train again"


def save_avatar(path: str | Path, model: TeacherAvatar | Student, *, compact: bool = False) -> int:
    """Write a trained avatar to a file, atomically.

    Args:
        path: of the file.
        model: the teacher or student.
        compact: floats in half precision and indices in 32 bits, as players need them.

    Returns:
        Size of the file, bytes.
    """
    # Header: everything from which the model is made before its tensors are loaded.
    about = {"schema": SCHEMA, "face_count": model.gaussians.face_count, "topology": model.gaussians.topology}
    if isinstance(model, TeacherAvatar):
        track = model.track
        errors = [name for name in TRACK_ERRORS if track is not None and getattr(track, name) is not None]
        about |= {"kind": "teacher", "config": config_to_dict(model.config), "track_tells": errors}
    else:
        config = model.config
        about |= {
            "kind": "student",
            "frames": list(model.frames),
            "fps": model.fps,
            "null_code_shown": model.codes is not None and model.codes.null_code_shown,
            "control_points": config.control_points,
            "still_body": config.still_body,
            "field": None if config.field is None else config_to_dict(config.field),
            "blend_shapes": None if config.blend_shapes is None else config_to_dict(config.blend_shapes),
        }
    # Tensors by the names of the module's state.
    tensors = {name: _stored(value, compact) for name, value in model.state_dict().items()}
    data = save(tensors, metadata={HEADER: json.dumps(about)})
    atomic_write_bytes(path, data)
    return len(data)


def load_avatar(path: str | Path, rig: Rig) -> TeacherAvatar | Student:
    """Read a file that `save_avatar` wrote, on the rig's device.

    All sizes in the header are checked against the file's tensors before a network is made, so that a damaged header
    cannot allocate more memory than they have.

    Args:
        path: of the file.
        rig: of the template on which the avatar was trained.

    Raises:
        InputError: a missing, damaged or foreign file, one of a newer version, one of another template, numbers that
            are not finite.
    """
    subject = f"avatar {path}"
    file = open_tensor_file(path, subject=subject, header=HEADER, expected=_EXPECTED, remedy=_REMEDY)
    _check_version(file.about, subject)
    if file.about.get("topology") != topology_digest(rig.faces):
        raise InputError(
            subject,
            expected="one of this template",
            received="Gaussians on other faces",
            remedy="train again: the template was rebuilt since",
        )
    # Tensors in single precision, checked; the Gaussians among them.
    tensors = {name: value.float() if value.is_floating_point() else value for name, value in file.tensors().items()}
    require_finite(tensors, subject=subject, remedy=_REMEDY)
    own = {name.removeprefix(GAUSSIANS): value for name, value in tensors.items() if name.startswith(GAUSSIANS)}
    gaussians = bound_from_tensors(own, file.about, subject=subject)
    # Make the model from the header, then require exactly its tensors.
    stored = StoredModel(file.about, tensors, subject)
    try:
        make = _teacher if file.about["kind"] == "teacher" else _student
        model = make(stored, rig, gaussians)
    except InputError as error:
        if error.subject.startswith(subject):
            raise
        named = {name: getattr(error, name) for name in ("expected", "received", "remedy")}
        raise InputError(f"{subject}: {error.subject}", **named) from None
    state: Mapping[str, Tensor] = model.state_dict()
    # The model's own state is the list of tensors that a file must have: all of them, in their shapes, and no others.
    require_like(tensors, state, subject=subject, remedy=_REMEDY)
    unknown = sorted(set(tensors) - set(state))
    if unknown:  # ignoring them would load another avatar than the file's
        raise InputError(
            subject, expected="the tensors of the model alone", received=", ".join(unknown)[:200], remedy=_REMEDY
        )
    model.load_state_dict(dict(tensors))
    return model.eval()


def _check_version(about: Mapping[str, Any], subject: str) -> None:
    schema = as_integer(about.get("schema"), subject=f"{subject}: schema", least=1)
    if schema > SCHEMA:
        raise InputError(
            subject,
            expected=f"version {SCHEMA} or older",
            received=f"version {schema}",
            remedy="update smplxpp to the version that wrote it",
        )
    if about.get("kind") not in KINDS:
        raise InputError(
            f"{subject}: kind", expected=" or ".join(KINDS), received=shown(about.get("kind")), remedy=_REMEDY
        )


def _teacher(stored: StoredModel, rig: Rig, gaussians: BoundGaussians) -> TeacherAvatar:
    config = stored.config("config", TeacherConfig)
    assert config is not None, "a teacher has a configuration"
    require_like(stored.tensors, _networks_of(config), subject=stored.subject)
    teacher = TeacherAvatar(config, rig, gaussians)
    if "track_controls" in stored.tensors:
        frames, controls = stored.track(rig.template.vertex_count)
        # Rows of the controls by frame; the cage follows from the template and the number of control points.
        row = {frame: k for k, frame in enumerate(frames)}
        errors = stored.track_errors(*controls.shape[:2])
        teacher.remember(Track(row, controls, ControlCage(rig, controls.shape[1]), **errors))
    return teacher


@lru_cache(maxsize=4)
def _networks_of(config: TeacherConfig) -> Mapping[str, Tensor]:
    """Return the tensors of a teacher's networks, without memory: steps of a training open the same teacher again."""
    with torch.device("meta"):
        return Teacher(config).state_dict(prefix="networks.", keep_vars=True)


def _student(stored: StoredModel, rig: Rig, gaussians: BoundGaussians) -> Student:
    # Field and codes.
    field = stored.config("field", FieldConfig, optional=True)
    shapes_config = stored.config("blend_shapes", BlendShapeConfig, optional=True)
    frames = stored.frames()
    if field is not None:
        network = partial(FieldNetwork, field)
        stored.require_networks({"field.body": network, "field.cloth": network})
        stored.require("codes.codes", (len(frames), field.code_size))
    # Blend shapes.
    shapes = None
    if shapes_config is not None:
        stored.require_networks({"blend_shapes": lambda: nn.ModuleDict(mapping_networks(shapes_config))})
        extra = stored.blended(shapes_config, len(gaussians))
        shapes = BlendShapes(shapes_config, len(gaussians), **extra)
    # Control points, pose gate and regression.
    control_points = as_integer(stored.about.get("control_points"), subject="control_points", least=0)
    still_body = stored.about.get("still_body", False)  # older files: the body moves
    if not isinstance(still_body, bool):
        raise InputError("still_body", expected="true or false", received=shown(still_body), remedy=_REMEDY)
    config = StudentConfig(field, shapes_config, control_points, still_body)
    known = None if "pose_gate.poses" not in stored.tensors else stored.poses("pose_gate.poses")
    regression = None
    if field is not None and "regression.basis" in stored.tensors:
        sizes = PoseRegression.shapes(*stored.directions("regression.basis"))
        regression = PoseRegression(**{k: stored.require(f"regression.{k}", size) for k, size in sizes.items()})
    student = Student(config, rig, gaussians, frames, blend_shapes=shapes, known_poses=known, regression=regression)
    rate = stored.about.get("fps")  # older files: not known
    student.fps = None if rate is None else as_number(rate, subject="fps", least=1e-3)
    if stored.about.get("null_code_shown", True):  # older files: the null code is zero
        show_null_code(student)
    return student


def _stored(value: Tensor, compact: bool) -> Tensor:
    value = value.detach().cpu().contiguous()
    if compact:
        # Halving precision: float16 has 11 significant bits, enough for residuals; indices fit into 32 bits.
        value = value.half() if value.is_floating_point() else value.int() if value.dtype == torch.int64 else value
    return value
