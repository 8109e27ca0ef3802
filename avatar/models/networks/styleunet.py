"""StyleUNet with two decoders: maps of the front and the back of a body from maps of its pose.

The form is that of StyleAvatar (Wang et al. 2023) and Animatable Gaussians (Li et al. 2024): an encoder of
down-sampling blocks that sees the input again at every scale, and a style-modulated decoder of StyleGAN2 with skip
connections, one for each side, whose outputs of all scales are added up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from avatar.models.networks.config_dict import LARGEST_SIDE, MOST_LAYERS
from avatar.models.networks.stylegan2_layers import (
    GAIN,
    SLOPE,
    ConvLayer,
    EqualizedLinear,
    FirFilter,
    JoiningConv,
    StyledConv,
    ToMaps,
)
from smplxpp.core import InputError, require_at_least, require_between


@dataclass(frozen=True)
class Head:
    """An output of a StyleUNet: number of channels, and whether it depends on the viewing direction."""

    channels: int
    sees_view: bool = False


@dataclass(frozen=True)
class StyleUNetConfig:
    """Sizes of a StyleUNet. The defaults are those of Animatable Gaussians.

    Attributes:
        in_channels: channels of the input image (front and back together).
        heads: outputs; everything but the finest scale of the decoder is shared between them.
        in_size: side of the input in pixels, a power of two.
        out_size: side of the output in pixels, a power of two.
        bottleneck: side of the coarsest feature map.
        channel_base: a feature map of side r has `min(channel_max, channel_base / r)` channels.
        channel_max: upper limit of the channels.
        style_size: length of the style.
        style_layers: depth of its mapping network.
        noise: add fixed noise of learnt strength in the decoder.
        zero_output: the output starts at exactly zero.
    """

    in_channels: int = 6
    heads: tuple[Head, ...] = (Head(3),)
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
        # Sides are powers of two, with room for the scales of encoder and decoder.
        for name in ("in_size", "out_size", "bottleneck"):
            value = getattr(self, name)
            if not 1 <= value <= LARGEST_SIDE or value & (value - 1):
                raise InputError(
                    f"StyleUNet {name}", expected=f"a power of two, at most {LARGEST_SIDE}", received=str(value)
                )
        require_at_least("StyleUNet in_size", self.in_size, 4 * self.bottleneck)
        require_at_least("StyleUNet out_size", self.out_size, 8 * self.bottleneck)
        for name in ("in_channels", "channel_max", "style_size"):
            require_at_least(f"StyleUNet {name}", getattr(self, name), 1)
        require_between("StyleUNet style_layers", self.style_layers, 1, MOST_LAYERS)
        require_at_least("StyleUNet channel_base", self.channel_base, max(self.in_size, self.out_size) // 2)
        if not self.heads or min(head.channels for head in self.heads) < 1:
            raise InputError(
                "StyleUNet heads", expected="at least one, of one channel or more", received=str(self.heads)
            )

    def channels(self, side: int) -> int:
        """Return the number of channels of a feature map of this side."""
        return min(self.channel_max, self.channel_base // side)


class Encoder(nn.Module):
    """Feature maps of sides in_size/2, in_size/4, ..., bottleneck; the input is added again at every scale."""

    def __init__(self, config: StyleUNetConfig) -> None:
        super().__init__()
        c = config.channels
        side = config.in_size // 2
        self.first = ConvLayer(config.in_channels, c(side), down=True)
        self.from_image, self.blocks = nn.ModuleList(), nn.ModuleList()
        while side > config.bottleneck:
            self.from_image.append(ConvLayer(config.in_channels, c(side), kernel=1))
            self.blocks.append(nn.Sequential(ConvLayer(c(side), c(side)), ConvLayer(c(side), c(side // 2), down=True)))
            side //= 2
        self.last = ConvLayer(c(side), c(side))
        self.filter = FirFilter()

    def forward(self, image: Float[Tensor, "B I S S"]) -> dict[int, Tensor]:
        """Return the feature maps, by their side in pixels."""
        x = self.first(image)
        features = {x.shape[-1]: x}
        # The input is halved beside the features and joins them by a 1 x 1 convolution, so that exact positions reach
        # every
        # scale.
        for from_image, block in zip(self.from_image, self.blocks, strict=True):
            image = self.filter.halve(image)
            x = block(x + from_image(image))
            features[x.shape[-1]] = x
        # One more convolution at the coarsest side; its output is where both decoders start.
        features[x.shape[-1]] = self.last(x)
        return features


class Merge(nn.Module):
    """Skip connections, shared by both decoders: `conv(cat(x, encoder features of the same side))`.

    The convolution of the two halves is summed, so that the encoder's half is done once for all decoders and heads. The
    coarsest side has no decoder features yet, those finer than the encoder's finest have no encoder features: they pass
    as they are.
    """

    def __init__(self, config: StyleUNetConfig) -> None:
        super().__init__()
        self.convs = nn.ModuleDict()
        side = 2 * config.bottleneck
        while side <= min(config.in_size // 2, config.out_size // 4):
            self.convs[str(side)] = JoiningConv(config.channels(side))
            side *= 2

    def skips(self, features: dict[int, Tensor]) -> dict[int, Tensor]:
        """Take encoder features by side to their half of each convolution, by side."""
        return {side: self._conv(side).skip(features[side]) for side in map(int, self.convs)}

    def _conv(self, side: int) -> JoiningConv:
        conv = self.convs[str(side)]
        assert isinstance(conv, JoiningConv)
        return conv

    def forward(self, x: Float[Tensor, "B C S S"], skips: dict[int, Tensor]) -> Float[Tensor, "_ C S S"]:
        """Join decoder features to the skip of their side, if there is one."""
        side = x.shape[-1]
        return self._conv(side)(x, skips[side]) if side in skips else x


class DecoderStep(nn.Module):
    """One scale of a decoder: features of side r to side 2r, and their part of the output, of side 4r."""

    def __init__(self, config: StyleUNetConfig, side: int, channels: int) -> None:
        super().__init__()
        inputs, outputs, style = config.channels(side), config.channels(2 * side), config.style_size
        noise_size = 2 * side if config.noise else None
        self.up = StyledConv(inputs, outputs, style, up=True, noise_size=noise_size)
        self.conv = StyledConv(outputs, outputs, style, noise_size=noise_size)
        self.to_maps = ToMaps(outputs, channels, style, zero=config.zero_output)

    def forward(
        self, x: Float[Tensor, "B I S S"], style: Float[Tensor, " Z"]
    ) -> tuple[Float[Tensor, "B O R R"], Float[Tensor, "B C T T"]]:
        """Return features of twice the side, and their part of the output, of four times the side."""
        # Double the side, convolve, then read the maps off the features.
        x = self.conv(self.up(x, style), style)
        return x, self.to_maps(x, style)


class Decoder(nn.Module):
    """Decoder of one side of the body: scales that all heads share, then the finest scale for each head."""

    def __init__(self, config: StyleUNetConfig) -> None:
        super().__init__()
        self.heads = config.heads
        self.coarse = nn.ModuleList()
        side, finest = config.bottleneck, config.out_size // 4
        while side < finest:
            self.coarse.append(DecoderStep(config, side, sum(head.channels for head in config.heads)))
            side *= 2
        self.fine = nn.ModuleList(DecoderStep(config, finest, head.channels) for head in config.heads)
        self.filter = FirFilter(gain=4.0)

    def forward(
        self,
        x: Float[Tensor, "B C S S"],
        skip: Callable[[Tensor], Tensor],
        style: Float[Tensor, " Z"],
        view_features: Float[Tensor, "V D Q Q"] | None,
    ) -> list[Tensor]:
        """Return the maps of each head.

        Args:
            x: coarsest features, S the bottleneck.
            skip: joins decoder features to the encoder's of the same side.
            style: what modulates every convolution.
            view_features: those of V views, Q a quarter of the output's side.

        Returns:
            (B, channels, out_size, out_size) for each head, (V, ...) where it sees the view.
        """
        # Coarse scales, shared by all heads: features, and the sum of their maps.
        maps: Tensor | None = None
        for step in self.coarse:
            x, part = step(skip(x), style)
            maps = part if maps is None else self.filter.enlarge(maps) + part
        assert maps is not None  # the output has at least eight times the bottleneck's side
        # The finest scale of each head, with the features of the view.
        coarse_maps = maps.split([head.channels for head in self.heads], dim=1)
        outputs = []
        for head, step, coarse in zip(self.heads, self.fine, coarse_maps, strict=True):
            seen = x + view_features if head.sees_view and view_features is not None else x
            outputs.append(self.filter.enlarge(coarse) + step(skip(seen), style)[1])
        return outputs


class ViewEncoder(nn.Module):
    """Takes maps of the cosine between normal and viewing direction to features added before the finest scale."""

    def __init__(self, config: StyleUNetConfig) -> None:
        super().__init__()
        self.side = config.out_size // 4
        channels = config.channels(self.side)
        self.first = ConvLayer(1, max(1, channels // 2), down=True)
        self.second = ConvLayer(max(1, channels // 2), channels, down=True)

    def forward(self, cosines: Float[Tensor, "V 2 S S"]) -> tuple[Float[Tensor, "V D Q Q"], Float[Tensor, "V D Q Q"]]:
        """Take cosines of front and back to their features, Q a quarter of the output's side."""
        # Two convolutions with stride 2, a quarter of the input's side, then brought to the side of the finest
        # features.
        features = self.second(self.first(cosines.flatten(0, 1)[:, None]))
        features = F.interpolate(features, size=(self.side, self.side), mode="bilinear")
        # Front and back alternate along the batch axis, because (V, 2) was flattened.
        return features[0::2], features[1::2]


class StyleUNet(nn.Module):
    """Encoder and two decoders, for the front and the back.

    Features x of side r go through `x <- conv_up(merge(x))`, `x <- conv(x)`, and the output is the sum over scales
    `maps <- double(maps) + to_maps(x)`, so that the finest convolution runs at half the output's side.
    The style is `mapping(1)`, one learnt vector.
    """

    style_seed: Tensor

    def __init__(self, config: StyleUNetConfig) -> None:
        super().__init__()
        self.config = config
        lr_multiplier = 0.01  # of the style's mapping network (Karras et al. 2019)
        self.register_buffer("style_seed", torch.ones(config.style_size), persistent=False)
        self.mapping = nn.ModuleList(
            EqualizedLinear(config.style_size, config.style_size, lr_multiplier=lr_multiplier)
            for _ in range(config.style_layers)
        )
        self.encoder = Encoder(config)
        self.merge = Merge(config)
        self.decoders = nn.ModuleList([Decoder(config), Decoder(config)])
        self.view_encoder = ViewEncoder(config) if any(head.sees_view for head in config.heads) else None

    def style(self) -> Float[Tensor, " Z"]:
        """Return the style, which modulates every convolution of the decoders."""
        # A mapping network of a constant input: it trains one style vector, at a rate that is a hundredth of the
        # others'.
        w = self.style_seed
        for layer in self.mapping:
            w = F.leaky_relu(layer(w), SLOPE) * GAIN
        return w

    def forward(
        self, image: Float[Tensor, "B I S S"], view_cosines: Float[Tensor, "V 2 S S"] | None = None
    ) -> list[Tensor]:
        """Return the maps of each head.

        Args:
            image: S is `in_size`.
            view_cosines: cosine between the normal and the direction to the camera on the
                front and the back; B = V, or B = 1 for V views of one pose. None: the heads that could see the view
                do not.

        Returns:
            (B, 2, out_size, out_size, channels) for each head, with V in place of B where the head sees the view.
        """
        # Encode the image, and the views' cosines where a head sees them.
        features = self.encoder(image.contiguous(memory_format=torch.channels_last))
        view_features = (None, None)
        if view_cosines is not None and self.view_encoder is not None:
            view_features = self.view_encoder(view_cosines)
        # The encoder's half of each skip convolution is computed once for both decoders and all heads.
        style, skips = self.style(), self.merge.skips(features)
        coarsest = features[self.config.bottleneck]
        # Decode front and back with shared skip connections.
        sides = [
            decoder(coarsest, lambda x: self.merge(x, skips), style, view)
            for decoder, view in zip(self.decoders, view_features, strict=True)
        ]
        return [
            torch.stack([maps.permute(0, 2, 3, 1) for maps in front_and_back], dim=1)
            for front_and_back in zip(*sides, strict=True)
        ]
