"""Measure perceptual distances between images: ST-LPIPS and LPIPS; `perceptual_weights` loads them.

Their values are not comparable, so each metric carries its name, which is printed with its values.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from smplxpp.core.errors import InputError

Stored = Mapping[str, Tensor]
"""Tensors of a file by their names there."""

MIN_SIZE = 32
"""Smallest side of an image, pixels; the coarsest features of a smaller one vanish."""
# The layers of AlexNet: channels, kernel sizes, and names in the authors' file.
CHANNELS = (64, 192, 384, 256, 256)
KERNELS = (11, 5, 3, 3, 3)
STORED_CONVS = ("net.slice1.0", "net.slice2.5", "net.slice3.9", "net.slice4.11", "net.slice5.13")


class PerceptualDistance(nn.Module, ABC):
    """Distance between features of two images; differentiable in the images, its own weights are fixed.

    Attributes:
        name: of the metric, printed with its values.
    """

    name: str

    def forward(self, image: Float[Tensor, "B H W 3"], reference: Float[Tensor, "B H W 3"]) -> Float[Tensor, " B"]:
        """Return the distance of each pair, 0 for equal images.

        Args:
            image: in [0, 1], at least 32 pixels a side.
            reference: of the same shape.

        Raises:
            InputError: images of wrong or different shapes, or too small.
        """
        if image.shape != reference.shape or image.ndim != 4 or image.shape[3] != 3 or min(image.shape[1:3]) < MIN_SIZE:
            raise InputError(
                f"images for {self.name}",
                expected=f"two of shape (B, H, W, 3), H and W at least {MIN_SIZE}",
                received=f"shapes {tuple(image.shape)} and {tuple(reference.shape)}",
            )
        # Channels first and [-1, 1], as the networks were trained.
        x, y = (2.0 * pixels.permute(0, 3, 1, 2) - 1.0 for pixels in (image, reference))
        return self.distance(x, y)

    @abstractmethod
    def distance(self, x: Float[Tensor, "B 3 H W"], y: Float[Tensor, "B 3 H W"]) -> Float[Tensor, " B"]:
        """Return the distance of each pair of images in [-1, 1]."""


class FeatureDistance(PerceptualDistance):
    """`sum over 5 layers of mean over pixels of w . (f/|f| - g/|g|)^2`.

    f and g are a layer's features of the two images, w its learnt weights (Zhang et al. 2018).

    Args:
        convs: of the network that gives the features.
        channels: of each of the layers.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, convs: Iterable[nn.Conv2d], channels: Sequence[int]) -> None:
        super().__init__()
        self.convs = nn.ModuleList(convs)
        self.layer_weights = nn.ParameterList(torch.rand(count) for count in channels)
        # Mean and standard deviation of ImageNet for images in [-1, 1], rounded as LPIPS has them.
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188])[:, None, None])
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450])[:, None, None])
        self.requires_grad_(False)

    def distance(self, x: Float[Tensor, "B 3 H W"], y: Float[Tensor, "B 3 H W"]) -> Float[Tensor, " B"]:
        """Return the distance of each pair of images in [-1, 1]."""
        # Features of unit length a pixel; squared differences weighted by channel, averaged over the layer's pixels.
        total = x.new_zeros(len(x))
        for weight, f, g in zip(self.layer_weights, self.features(x), self.features(y), strict=True):
            difference = (_unit(f) - _unit(g)).square()
            total = total + torch.einsum("c,bchw->b", weight, difference) / (f.shape[2] * f.shape[3])
        return total

    @abstractmethod
    def features(self, x: Float[Tensor, "B 3 H W"]) -> list[Tensor]:
        """Return the activations of the five layers for images in [-1, 1]."""

    def _take(self, stored: Stored, convs: Sequence[str], named: Mapping[str, str], remedy: str) -> None:
        """Copy the weights of a file, which names convolutions and some of our tensors in these ways.

        Raises:
            InputError: weights of another network.
        """
        # A layer's weights are stored as a 1 x 1 convolution, hence the reshape. It drops axes of length 1 alone, so
        # that equal numbers of entries are enough to check.
        names = {f"layer_weights.{k}": f"lin{k}.model.1.weight" for k in range(len(self.layer_weights))} | {**named}
        for k, conv in enumerate(convs):
            names |= {f"convs.{k}.weight": f"{conv}.weight", f"convs.{k}.bias": f"{conv}.bias"}
        own = self.state_dict()
        for name, source in names.items():
            given, value = stored.get(source), own[name]
            if given is None or given.numel() != value.numel():
                raise InputError(
                    f"{self.name} weights",
                    expected=f"{source}, {name} of shape {tuple(value.shape)}",
                    received="none" if given is None else f"shape {tuple(given.shape)}",
                    remedy=remedy,
                )
            value.copy_(given.reshape(value.shape))


class ShiftTolerantLPIPS(FeatureDistance):
    """ST-LPIPS (Ghildyal and Liu 2022): LPIPS on an AlexNet with a low-pass filter before every reduction.

    A shift of the image by one pixel hardly changes the distance.
    """

    name = "ST-LPIPS"
    binomial: Tensor

    def __init__(self) -> None:
        # The stem keeps AlexNet's padding of 2 at a stride of 1; the reduction is left to the filter.
        layers = zip((3, *CHANNELS[:-1]), CHANNELS, KERNELS, (2, 2, 1, 1, 1), strict=True)
        super().__init__((nn.Conv2d(i, o, kernel, padding=pad) for i, o, kernel, pad in layers), CHANNELS)
        taps = torch.tensor([0.25, 0.5, 0.25])
        self.register_buffer("binomial", torch.outer(taps, taps)[None, None], persistent=False)

    @staticmethod
    def from_weights(stored: Stored) -> ShiftTolerantLPIPS:
        """Make the metric with the weights of the authors' file.

        Raises:
            InputError: weights of another network.
        """
        metric = ShiftTolerantLPIPS()
        scaling = {"shift": "scaling_layer.shift", "scale": "scaling_layer.scale"}
        metric._take(stored, STORED_CONVS, scaling, "use the weight file of stlpips-pytorch 0.0.2")
        return metric

    def features(self, x: Float[Tensor, "B 3 H W"]) -> list[Tensor]:
        """Return the activations of the five layers for images in [-1, 1]."""
        conv1, conv2, conv3, conv4, conv5 = self.convs
        # AlexNet with each stride of 2 replaced by a step of 1 and a filtered reduction: sampling without a low-pass
        # filter
        # would make the features change when the image moves by a pixel.
        first = F.relu(self._reduced(conv1((x - self.shift) / self.scale)))
        second = F.relu(conv2(self._reduced(F.max_pool2d(first, 3, stride=1))))
        third = F.relu(conv3(self._reduced(F.max_pool2d(second, 3, stride=1))))
        fourth = F.relu(conv4(third))
        return [first, second, third, fourth, F.relu(conv5(fourth))]

    def _reduced(self, x: Tensor) -> Tensor:
        channels = x.shape[1]
        # The 3x3 binomial filter (1, 2, 1) / 4 along each axis, then every second pixel.
        padded = F.pad(x, (2, 2, 2, 2), mode="reflect")
        return F.conv2d(padded, self.binomial.expand(channels, -1, -1, -1), stride=2, groups=channels)


@dataclass(frozen=True)
class Backbone:
    """A network of torchvision whose features LPIPS compares.

    Attributes:
        file: of its weights, as torchvision downloads it.
        layers: numbers of the convolutions of each layer in the network's `features`.
        channels: of each layer.
        kernels: of each layer's convolutions, pixels.
        pooling: width of the maximum before a layer, pixels; 0: none.
    """

    file: str
    layers: tuple[tuple[int, ...], ...]
    channels: tuple[int, ...]
    kernels: tuple[int, ...]
    pooling: tuple[int, ...]


BACKBONES: Mapping[str, Backbone] = {
    "alex": Backbone(
        "alexnet-owt-7be5be79.pth", ((0,), (3,), (6,), (8,), (10,)), CHANNELS, KERNELS, pooling=(0, 3, 3, 0, 0)
    ),
    "vgg": Backbone(
        "vgg16-397923af.pth",
        ((0, 2), (5, 7), (10, 12, 14), (17, 19, 21), (24, 26, 28)),
        (64, 128, 256, 512, 512),
        (3, 3, 3, 3, 3),
        pooling=(0, 2, 2, 2, 2),
    ),
}


class LPIPS(FeatureDistance):
    """LPIPS (Zhang et al. 2018), version 0.1, on AlexNet ("alex") or VGG16 ("vgg")."""

    def __init__(self, backbone: str = "alex") -> None:
        self.layout = BACKBONES[backbone]
        convs, inputs = [], 3
        for numbers, outputs, kernel in zip(self.layout.layers, self.layout.channels, self.layout.kernels, strict=True):
            for _ in numbers:
                # AlexNet's first convolution takes every fourth pixel; all others keep the size of the image.
                stride, padding = (4, 2) if kernel > 5 else (1, kernel // 2)
                convs.append(nn.Conv2d(inputs, outputs, kernel, stride=stride, padding=padding))
                inputs = outputs
        super().__init__(convs, self.layout.channels)
        self.name = f"LPIPS ({backbone})"

    def features(self, x: Float[Tensor, "B 3 H W"]) -> list[Tensor]:
        """Return the activations of the five layers for images in [-1, 1]."""
        x, convs, found = (x - self.shift) / self.scale, iter(self.convs), []
        for numbers, width in zip(self.layout.layers, self.layout.pooling, strict=True):
            x = F.max_pool2d(x, width, stride=2) if width else x
            for _ in numbers:
                x = F.relu(next(convs)(x))
            found.append(x)
        return found

    @staticmethod
    def from_weights(stored: Stored, backbone: str) -> LPIPS:
        """Make the metric from a state of the package `lpips`, or from torchvision's weights and the package's own.

        Raises:
            InputError: weights of another network.
        """
        metric = LPIPS(backbone)
        of_package = any(name.startswith("net.") for name in stored)
        names = [
            f"net.slice{layer}.{number}" if of_package else f"features.{number}"
            for layer, numbers in enumerate(metric.layout.layers, start=1)
            for number in numbers
        ]
        metric._take(stored, names, {}, f"give {metric.layout.file} of torchvision and weights/v0.1 of package lpips")
        return metric


def _unit(features: Tensor) -> Tensor:
    # Both small terms keep the quotient, and the slope of the square root, finite where all features are 0.
    return features / (features.square().sum(1, keepdim=True).clamp_min(1e-20).sqrt() + 1e-10)
