"""Measure perceptual distances between images: ST-LPIPS, and LPIPS if its package is installed.

Their values are not comparable, so each metric carries its name, which is printed with its values.
"""

from __future__ import annotations

import importlib.util
import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from smplxpp.core import InputError, MissingExtraError, require_choice
from smplxpp.core.files.paths import regular_file

log = logging.getLogger(__name__)

MetricName = Literal["st-lpips", "lpips", "none"]

MIN_SIZE = 32
"""Smallest side of an image, pixels; the coarsest features of a smaller one vanish."""
# The layers of AlexNet: channels, kernel sizes, and names in the authors' file.
CHANNELS = (64, 192, 384, 256, 256)
KERNELS = (11, 5, 3, 3, 3)
STORED_CONVS = ("net.slice1.0", "net.slice2.5", "net.slice3.9", "net.slice4.11", "net.slice5.13")
WEIGHT_FILE = Path("weights", "vST0.0", "alex_shift_tolerant.pth")


class MissingPackageError(MissingExtraError):
    """An error for a missing package that no extra of this project installs."""

    def __init__(self, package: str, *, command: str, purpose: str) -> None:
        ImportError.__init__(self, f"{purpose} needs {package}, which is not installed: {command}")


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


class ShiftTolerantLPIPS(PerceptualDistance):
    """ST-LPIPS (Ghildyal and Liu 2022): LPIPS on an AlexNet with a low-pass filter before every reduction.

    `sum over 5 layers of mean over pixels of w . (f/|f| - g/|g|)^2`, f and g the layer's features of the two images and
    w its learnt weights. A shift of the image by one pixel hardly changes the distance.
    """

    name = "ST-LPIPS"
    shift: Tensor
    scale: Tensor
    binomial: Tensor

    def __init__(self) -> None:
        super().__init__()
        inputs = (3, *CHANNELS[:-1])
        # The stem keeps AlexNet's padding of 2 at a stride of 1; the reduction is left to the filter.
        paddings = (2, 2, 1, 1, 1)
        self.convs = nn.ModuleList(
            nn.Conv2d(i, o, kernel, padding=padding)
            for i, o, kernel, padding in zip(inputs, CHANNELS, KERNELS, paddings, strict=True)
        )
        self.layer_weights = nn.ParameterList(torch.rand(channels) for channels in CHANNELS)
        # Mean and standard deviation of ImageNet for images in [-1, 1], rounded as LPIPS has them.
        self.register_buffer("shift", torch.tensor([-0.030, -0.088, -0.188])[:, None, None])
        self.register_buffer("scale", torch.tensor([0.458, 0.448, 0.450])[:, None, None])
        taps = torch.tensor([0.25, 0.5, 0.25])
        self.register_buffer("binomial", torch.outer(taps, taps)[None, None], persistent=False)
        self.requires_grad_(False)

    @staticmethod
    def from_weights(stored: Mapping[str, Tensor]) -> ShiftTolerantLPIPS:
        """Make the metric with the weights of the authors' file.

        Raises:
            InputError: weights of another network.
        """
        # Collect the authors' tensors under our names, then copy them only if the sizes agree; a layer's weights are
        # stored as a 1 x 1 convolution, hence the reshape.
        metric = ShiftTolerantLPIPS()
        state = {"shift": stored.get("scaling_layer.shift"), "scale": stored.get("scaling_layer.scale")}
        for k, conv in enumerate(STORED_CONVS):
            state[f"convs.{k}.weight"], state[f"convs.{k}.bias"] = (
                stored.get(f"{conv}.weight"),
                stored.get(f"{conv}.bias"),
            )
            state[f"layer_weights.{k}"] = stored.get(f"lin{k}.model.1.weight")
        for name, value in metric.state_dict().items():
            # The reshape drops axes of length 1 alone, so that equal numbers of entries are enough to check.
            given = state[name]
            if given is None or given.numel() != value.numel():
                raise InputError(
                    "ST-LPIPS weights",
                    expected=f"{name} of shape {tuple(value.shape)}",
                    received="none" if given is None else f"shape {tuple(given.shape)}",
                    remedy="use the weight file of stlpips-pytorch 0.0.2",
                )
            value.copy_(given.reshape(value.shape))
        return metric

    def distance(self, x: Float[Tensor, "B 3 H W"], y: Float[Tensor, "B 3 H W"]) -> Float[Tensor, " B"]:
        """Return the distance of each pair of images in [-1, 1]."""
        # Features of unit length a pixel; squared differences weighted by channel, averaged over the layer's pixels.
        total = x.new_zeros(len(x))
        for weight, f, g in zip(self.layer_weights, self.features(x), self.features(y), strict=True):
            difference = (_unit(f) - _unit(g)).square()
            total = total + torch.einsum("c,bchw->b", weight, difference) / (f.shape[2] * f.shape[3])
        return total

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


class PackagedLPIPS(PerceptualDistance):
    """LPIPS (Zhang et al. 2018), computed by the installed `lpips` package."""

    def __init__(self, network: nn.Module, backbone: str) -> None:
        super().__init__()
        self.name = f"LPIPS ({backbone})"
        self.network = network.requires_grad_(False).eval()

    def distance(self, x: Float[Tensor, "B 3 H W"], y: Float[Tensor, "B 3 H W"]) -> Float[Tensor, " B"]:
        """Return the distance of each pair of images in [-1, 1]."""
        return self.network(x, y).flatten()


def _unit(features: Tensor) -> Tensor:
    # Both small terms keep the quotient, and the slope of the square root, finite where all features are 0.
    return features / (features.square().sum(1, keepdim=True).clamp_min(1e-20).sqrt() + 1e-10)


def load_st_lpips(weights: Path | None = None) -> ShiftTolerantLPIPS:
    """Make ST-LPIPS with the authors' AlexNet weights.

    Args:
        weights: their file; None: that of the installed package `stlpips-pytorch`, without running its code.

    Raises:
        MissingPackageError: no file given and the package is not installed.
        InputError: another kind of file.
    """
    if weights is None:
        # Find the folder without importing the package, so that what it depends on need not be installed.
        found = importlib.util.find_spec("stlpips_pytorch")
        if found is None or not found.submodule_search_locations:
            raise MissingPackageError(
                "stlpips-pytorch", command="pip install --no-deps stlpips-pytorch", purpose="ST-LPIPS"
            )
        weights = Path(found.submodule_search_locations[0]) / WEIGHT_FILE
    weights = regular_file(weights)
    try:
        # `weights_only` refuses pickled code.
        stored = torch.load(weights, map_location="cpu", weights_only=True)
    except Exception as error:
        raise InputError(
            f"file {weights.name}", expected="weights saved by torch", received=f"{type(error).__name__}"
        ) from error
    if not isinstance(stored, Mapping):
        raise InputError(f"file {weights.name}", expected="tensors by name", received=type(stored).__name__)
    return ShiftTolerantLPIPS.from_weights(stored)


def load_lpips(backbone: str = "alex") -> PackagedLPIPS:
    """Make LPIPS by the `lpips` package, with the backbone "alex" or "vgg", which the package finds or downloads.

    Raises:
        MissingPackageError: `lpips`, or torchvision which it needs, is not installed.
        InputError: another backbone.
    """
    require_choice("backbone of LPIPS", backbone, ("alex", "vgg"))
    try:
        import lpips
    except ModuleNotFoundError as error:
        if error.name not in ("lpips", "torchvision"):  # a broken package says itself what it lacks
            raise
        raise MissingPackageError("lpips", command="pip install lpips torchvision", purpose="LPIPS") from error
    return PackagedLPIPS(lpips.LPIPS(net=backbone, verbose=False), backbone)


def load_metric(name: str, *, device: str = "cpu") -> PerceptualDistance | None:
    """Make a metric by name; None for "none", and, with a log line, if its package is not installed.

    Raises:
        InputError: another name.
    """
    require_choice("perceptual metric", name, get_args(MetricName))
    if name == "none":
        return None
    try:
        metric = load_st_lpips() if name == "st-lpips" else load_lpips()
    except MissingExtraError as error:
        log.warning("no perceptual distance is measured: %s", error)
        return None
    return metric.to(device)
