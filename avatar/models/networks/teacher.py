"""The teacher: residuals of all Gaussians of a body from maps of its pose; sizes of it and of the field by preset."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.networks.sparse_lookups import MapSampler
from avatar.models.networks.styleunet import Head, StyleUNet, StyleUNetConfig
from smplxpp.core import InputError, require_between, require_choice, require_positive

# Output channels: position, colour, and opacity (1) with tangential log scales (2) and quaternion (4).
POSITION, COLOUR, OTHER = 3, 3, 1 + 2 + 4


@dataclass(frozen=True)
class TeacherConfig:
    """Sizes of the teacher. The defaults are the paper's.

    Attributes:
        networks: "separate", three StyleUNets for position, colour and the other attributes; or "shared", one whose
            finest scale alone is split into shape (position and others) and colour.
        semantics: how the semantic colours join the positions: "sum" (6 input channels) or "concatenate" (12).
        sees_view: colour depends on the viewing direction.
        position_scale: metres of displacement for an output of 1.
        position_size: side in pixels of the output of a smaller network for the position alone, which has half the
            channels, sees the input at half that size and is enlarged to `out_size`; 0: the position is one of the
            others' outputs. Displacements are smoother than colours, and the smaller network learns them many times
            faster.
        centred: standardise the position maps by mean and standard deviation of the training frames; False: metres.
        in_size: side of the input, pixels. It and the following are of each StyleUNet, see `StyleUNetConfig`.
        out_size: side of the output, pixels.
        bottleneck: side of the coarsest feature map.
        channel_base: channels times side of a feature map.
        channel_max: upper limit of the channels.
        style_size: length of the style.
        style_layers: depth of its mapping network.
        noise: add noise in the decoder.
        zero_output: the output starts at zero.

    Raises:
        InputError: sizes that are no powers of two or do not fit each other, an unknown choice.
    """

    networks: str = "separate"
    semantics: str = "sum"
    sees_view: bool = True
    position_scale: float = 0.05
    position_size: int = 0
    centred: bool = False
    in_size: int = 512
    out_size: int = 1024
    bottleneck: int = 8
    channel_base: int = 32768
    channel_max: int = 512
    style_size: int = 512
    style_layers: int = 2
    noise: bool = True
    zero_output: bool = False

    def __post_init__(self) -> None:
        require_choice("teacher networks", self.networks, ("separate", "shared"))
        require_choice("teacher semantics", self.semantics, ("sum", "concatenate"))
        require_positive("teacher position_scale", self.position_scale)
        require_between("teacher position_size", self.position_size, 0, min(2 * self.in_size, self.out_size))
        self.network_configs()

    def network_configs(self) -> dict[str, StyleUNetConfig]:
        """Return the configurations of the StyleUNets by name."""
        # Which residuals each network gives.
        heads: dict[str, tuple[Head, ...]]
        position, other, colour = (Head(POSITION),), (Head(OTHER),), Head(COLOUR, sees_view=self.sees_view)
        if self.networks == "separate":
            heads = {"position": position, "colour": (colour,), "other": other}
        elif self.position_size:
            heads = {"position": position, "all": (*other, colour)}
        else:
            heads = {"all": (Head(POSITION + OTHER), colour)}
        configs = {name: self._network_config(its_heads) for name, its_heads in heads.items()}
        # A smaller network for the position.
        if self.position_size:
            configs["position"] = replace(
                configs["position"],
                in_size=self.position_size // 2,
                out_size=self.position_size,
                channel_base=max(1, self.channel_base // 2),
                channel_max=max(1, self.channel_max // 2),
            )
        return configs

    def _network_config(self, heads: tuple[Head, ...]) -> StyleUNetConfig:
        return StyleUNetConfig(
            in_channels=6 if self.semantics == "sum" else 12,
            heads=heads,
            in_size=self.in_size,
            out_size=self.out_size,
            bottleneck=self.bottleneck,
            channel_base=self.channel_base,
            channel_max=self.channel_max,
            style_size=self.style_size,
            style_layers=self.style_layers,
            noise=self.noise,
            zero_output=self.zero_output,
        )


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals that the teacher adds to the attributes, as maps (B, 2, R, R, ...) or of Gaussians (B, N, ...).

    Attributes:
        shape: position in units of `position_scale`, opacity, log scales and quaternion, side by side.
        colour: added to the colour that does not depend on the view; V views in the place of B poses if the
            teacher was given V view maps.
        position_scale: metres.
    """

    shape: Float[Tensor, "*B 10"]
    colour: Float[Tensor, "*V 3"]
    position_scale: float

    @property
    def position(self) -> Float[Tensor, "*B 3"]:
        """Displacements, metres along the axes of the canonical pose."""
        return self.position_scale * self.shape[..., :3]

    @property
    def opacity_logit(self) -> Float[Tensor, "*B"]:
        """Residuals of the opacities, added before the sigmoid."""
        return self.shape[..., 3]

    @property
    def log_scales(self) -> Float[Tensor, "*B 2"]:
        """Residuals of the logarithms of the tangential scales."""
        return self.shape[..., 4:6]

    @property
    def quats(self) -> Float[Tensor, "*B 4"]:
        """Residuals of the quaternions, wxyz, added before normalisation."""
        return self.shape[..., 6:]

    def float(self) -> Residuals:
        """Return the residuals in float32, which rasteriser and losses need."""
        return Residuals(self.shape.float(), self.colour.float(), self.position_scale)

    def sampled(self, sampler: MapSampler) -> Residuals:
        """Sample residual maps at the Gaussians of `sampler`."""
        return Residuals(sampler(self.shape), sampler(self.colour), self.position_scale)


def local_offsets(
    canonical_offsets: Float[Tensor, "*B N 3"], canonical_from_local: Float[Tensor, "N 3 3"]
) -> Float[Tensor, "*B N 3"]:
    """Return displacements in the triangles' frames, `du = R^T dU`, metres.

    Args:
        canonical_offsets: metres along the canonical axes.
        canonical_from_local: rotation of each Gaussian's triangle in the canonical pose.
    """
    # Summing over i, the canonical axes, applies the transpose of R.
    return torch.einsum("nij,...ni->...nj", canonical_from_local, canonical_offsets)


class Teacher(nn.Module):
    """StyleUNets from position maps to residual maps (Animatable Gaussians' form, as TaoAvatar uses it)."""

    def __init__(self, config: TeacherConfig) -> None:
        super().__init__()
        self.config = config
        self.networks = nn.ModuleDict({name: StyleUNet(c) for name, c in config.network_configs().items()})

    def forward(
        self,
        positions: Float[Tensor, "B 2 S S 3"],
        semantics: Float[Tensor, "#B 2 S S 3"],
        view_cosines: Float[Tensor, "V 2 S S"] | None = None,
    ) -> Residuals:
        """Return the residual maps of B poses.

        Args:
            positions: posed coordinates relative to the root, metres, on the front and back map of the canonical pose;
                0 on the background.
            semantics: semantic colours on the same maps, one for all poses or one for each.
            view_cosines: cosine between the posed normal and the direction to the camera; V = B, or B = 1
                and V views of one pose. None: no view is seen.

        Returns:
            Maps of shape (B, 2, R, R, channels), R the output size; colour (V, 2, R, R, 3).

        Raises:
            InputError: maps of another size.
        """
        # Check the shapes of the maps.
        size = self.config.in_size
        B, V = len(positions), len(positions) if view_cosines is None else len(view_cosines)
        _require_shape("position maps", positions, (B, 2, size, size, 3))
        _require_shape("semantic maps", semantics, (B if len(semantics) != 1 else 1, 2, size, size, 3))
        if view_cosines is not None:
            _require_shape("view maps", view_cosines, (V if B == 1 else B, 2, size, size))
        # One network with all heads, or a network of the position and others.
        image = self._image(positions, semantics)
        if "position" not in self.networks:
            shape, colour = self.networks["all"](image, view_cosines)
            return Residuals(shape, colour, self.config.position_scale)
        position = self._position(image)
        if "all" in self.networks:
            other, colour = self.networks["all"](image, view_cosines)
        else:
            (colour,) = self.networks["colour"](image, view_cosines)
            (other,) = self.networks["other"](image)
        return Residuals(torch.cat([position, other], dim=-1), colour, self.config.position_scale)

    def positions(
        self, positions: Float[Tensor, "B 2 S S 3"], semantics: Float[Tensor, "#B 2 S S 3"]
    ) -> Float[Tensor, "B 2 R R 3"]:
        """Return the residuals of the position alone, in units of `position_scale`.

        Args:
            positions: position maps, as in `forward`.
            semantics: semantic colours, as in `forward`.
        """
        image = self._image(positions, semantics)
        return self._position(image) if "position" in self.networks else self.networks["all"](image)[0][..., :POSITION]

    def _image(self, positions: Tensor, semantics: Tensor) -> Tensor:
        """Return the input of the StyleUNets, (B, channels, S, S)."""
        # "sum": positions and colours in the same three channels; the semantic colours tell parts apart that touch.
        if self.config.semantics == "sum":
            image = positions + semantics
        else:
            image = torch.cat([positions, semantics.expand_as(positions)], dim=-1)
        # Front and back map side by side in the channels: (B, 2, S, S, C) to (B, 2 C, S, S).
        return image.permute(0, 1, 4, 2, 3).flatten(1, 2)

    def _position(self, image: Tensor) -> Tensor:
        """Return the maps of the position's own network, (B, 2, R, R, 3)."""
        # The smaller network sees the input at half its size; its output is enlarged bilinearly.
        network, out = self.networks["position"], self.config.out_size
        assert isinstance(network, StyleUNet)
        if image.shape[-1] != network.config.in_size:
            image = F.interpolate(image, size=(network.config.in_size,) * 2, mode="area")
        (maps,) = network(image)
        if maps.shape[2] == out:
            return maps
        channels_first = maps.flatten(0, 1).permute(0, 3, 1, 2)
        larger = F.interpolate(channels_first, size=(out, out), mode="bilinear", align_corners=False)
        return larger.permute(0, 2, 3, 1).unflatten(0, maps.shape[:2])


def _require_shape(subject: str, value: Tensor, shape: tuple[int, ...]) -> None:
    if tuple(value.shape) != shape:
        raise InputError(subject, expected=f"shape {shape}", received=f"shape {tuple(value.shape)}")


@dataclass(frozen=True)
class NetworkPreset:
    """Sizes of the teacher and of the field in a preset."""

    teacher: TeacherConfig
    field: FieldConfig


_LEAN = TeacherConfig(networks="shared", position_size=128, centred=True, style_layers=1, noise=False, zero_output=True)

# Three networks, as published.
_SMALL = TeacherConfig(centred=True, style_layers=1, noise=False, zero_output=True)

_TEACHERS = {
    "paper": TeacherConfig(),
    "gpu": replace(_LEAN, in_size=256, out_size=512, channel_base=8192, channel_max=128, style_size=64),
    "paper-small": replace(_SMALL, in_size=128, out_size=256, channel_base=2048, channel_max=64, style_size=32),
    "cpu": replace(_LEAN, in_size=128, out_size=256, channel_base=2048, channel_max=64, style_size=32),
    "demo": replace(_LEAN, in_size=64, out_size=128, channel_base=1024, channel_max=32, style_size=16),
}

# Captures have few poses for 63 numbers: a vertex depends on nearby joints alone.
_FIELDS = {name: FieldConfig(local_pose=3) for name in ("gpu", "cpu", "demo")}

NETWORK_PRESETS = {
    # The field has the paper's sizes in all presets, because it is small.
    name: NetworkPreset(teacher, _FIELDS.get(name, FieldConfig()))
    for name, teacher in _TEACHERS.items()
}


def network_preset(name: str) -> NetworkPreset:
    """Return the preset "paper", "gpu", "paper-small", "cpu" or "demo".

    Raises:
        InputError: another name.
    """
    require_choice("preset", name, tuple(NETWORK_PRESETS))
    return NETWORK_PRESETS[name]
