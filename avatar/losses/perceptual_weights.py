"""Load perceptual distances: their weights from files, from installed packages and from torch's downloads."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Literal, get_args

import torch
from torch import Tensor

from avatar.gaussians.tensor_file import open_tensor_file
from avatar.losses.perceptual import (
    BACKBONES,
    KERNELS,
    LPIPS,
    PerceptualDistance,
    ShiftTolerantLPIPS,
    Stored,
)
from smplxpp.core import InputError, MissingExtraError, require_choice
from smplxpp.core.files.paths import regular_file

log = logging.getLogger(__name__)

MetricName = Literal["st-lpips", "lpips", "none"]
WEIGHT_FILE = Path("weights", "vST0.0", "alex_shift_tolerant.pth")


class MissingPackageError(MissingExtraError):
    """An error for a missing package that no extra of this project installs."""

    def __init__(self, package: str, *, command: str, purpose: str) -> None:
        ImportError.__init__(self, f"{purpose} needs {package}, which is not installed: {command}")


def _read(path: Path) -> Stored:
    """Read a file of weights, of torch or safetensors.

    Raises:
        InputError: another kind of file.
    """
    if path.suffix.lower() == ".safetensors":
        return open_tensor_file(path, subject=f"file {path.name}", header=None).tensors()
    path = regular_file(path)
    try:
        # `weights_only` refuses pickled code.
        stored = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise InputError(
            f"file {path.name}", expected="weights saved by torch", received=f"{type(error).__name__}"
        ) from error
    if not isinstance(stored, Mapping):
        raise InputError(f"file {path.name}", expected="tensors by name", received=type(stored).__name__)
    return {name: value for name, value in stored.items() if isinstance(value, Tensor)}


def _folder_of(package: str) -> Path | None:
    """Return the folder of an installed package without importing it, so that what it needs may be missing."""
    found = importlib.util.find_spec(package)
    return Path(found.submodule_search_locations[0]) if found and found.submodule_search_locations else None


def load_st_lpips(weights: Path | None = None) -> ShiftTolerantLPIPS:
    """Make ST-LPIPS with the authors' AlexNet weights.

    Args:
        weights: their file; None: that of the installed package `stlpips-pytorch`, without running its code.

    Raises:
        MissingPackageError: no file given and the package is not installed.
        InputError: another kind of file.
    """
    if weights is None:
        folder = _folder_of("stlpips_pytorch")
        if folder is None:
            raise MissingPackageError(
                "stlpips-pytorch", command="pip install --no-deps stlpips-pytorch", purpose="ST-LPIPS"
            )
        weights = folder / WEIGHT_FILE
    return ShiftTolerantLPIPS.from_weights(_read(weights))


def load_lpips(weights: Sequence[Path] = (), *, backbone: str = "alex") -> LPIPS:
    """Make LPIPS with weights from files, from the package `lpips` and from torch's folder of downloads.

    Args:
        weights: files of torchvision's backbone and of the package's weights/v0.1, or one of the package's whole
            state. What they lack comes from the installed package and from torch's downloads, without running code of
            either; the package is asked for the backbone, and may download it, where it is in neither.
        backbone: "alex" or "vgg"; a given one of torchvision's decides by its own.

    Raises:
        MissingPackageError: weights are missing, and so is `lpips`, or torchvision which it needs.
        InputError: another backbone, or files of other weights.
    """
    require_choice("backbone of LPIPS", backbone, tuple(BACKBONES))
    stored: dict[str, Tensor] = {}
    for path in weights:
        stored |= _read(path)
    # AlexNet's first convolution has 11 x 11 pixels, VGG16's 3 x 3.
    firsts = [stored[name] for name in ("features.0.weight", "net.slice1.0.weight") if name in stored]
    if firsts:
        backbone = "alex" if firsts[0].shape[-1] == KERNELS[0] else "vgg"
    elif (cached := _downloaded(backbone)).is_file():
        stored |= _read(cached)
    else:
        stored |= _state_of_package(backbone)
    # The package's own weights are one number a channel.
    folder = _folder_of("lpips")
    if "lin0.model.1.weight" not in stored and folder is not None:
        stored |= _read(folder / "weights" / "v0.1" / f"{backbone}.pth")
    return LPIPS.from_weights(stored, backbone)


def lpips_at_hand(backbone: str = "alex") -> bool:
    """Return whether `load_lpips` needs no file and no network."""
    return _downloaded(backbone).is_file() and _folder_of("lpips") is not None


def _downloaded(backbone: str) -> Path:
    return Path(torch.hub.get_dir(), "checkpoints", BACKBONES[backbone].file)


def _state_of_package(backbone: str) -> Stored:
    """Return all weights of the metric as the package `lpips` makes it."""
    try:
        import lpips
    except ModuleNotFoundError as error:
        if error.name not in ("lpips", "torchvision"):  # a broken package says itself what it lacks
            raise
        raise MissingPackageError("lpips", command="pip install lpips torchvision", purpose="LPIPS") from error
    return lpips.LPIPS(net=backbone, verbose=False).state_dict()


def load_metric(name: str, *, device: str = "cpu", weights: Sequence[Path] = ()) -> PerceptualDistance | None:
    """Make a metric by name; None for "none", and, with a log line, if its package is not installed.

    Args:
        name: "st-lpips", "lpips" or "none".
        device: of its weights.
        weights: files of LPIPS, see `load_lpips`.

    Raises:
        InputError: another name, or files of other weights.
    """
    require_choice("perceptual metric", name, get_args(MetricName))
    if name == "none":
        return None
    try:
        metric = load_st_lpips() if name == "st-lpips" else load_lpips(weights)
    except MissingExtraError as error:
        log.warning("no perceptual distance is measured: %s", error)
        return None
    return metric.to(device)
