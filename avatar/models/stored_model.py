"""Header of a model file, checked against its tensors before a model is made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor, nn

from avatar.gaussians.tensor_file import require_like
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.config_dict import config_from_dict
from avatar.rig.rig import THETA
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_integer, as_list, as_object

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

SHAPES = "blend_shapes."
_LAST_FRAME = 1 << 53
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
        return tuple(as_integer(value, subject="frame of a code", least=0, most=_LAST_FRAME) for value in values)

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
                state = make().state_dict()
            require_like(self.tensors, {f"{name}.{key}": value for key, value in state.items()}, subject=self.subject)

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
