"""Random weights of LPIPS on the networks that it takes features of."""

from __future__ import annotations

from itertools import pairwise

import torch

# The two networks as torchvision defines them: number in `features`, channels, pixels of the kernel,
# step; "max" stands for a maximum over so many pixels with a step of 2, "out" for features that LPIPS compares.
NETWORKS = {
    "alex": [
        *((0, 3, 64, 11, 4, 2), "out", ("max", 3), (3, 64, 192, 5, 1, 2), "out", ("max", 3)),
        *((6, 192, 384, 3, 1, 1), "out", (8, 384, 256, 3, 1, 1), "out", (10, 256, 256, 3, 1, 1), "out"),
    ],
    "vgg": [
        *((0, 3, 64, 3, 1, 1), (2, 64, 64, 3, 1, 1), "out", ("max", 2)),
        *((5, 64, 128, 3, 1, 1), (7, 128, 128, 3, 1, 1), "out", ("max", 2)),
        *((10, 128, 256, 3, 1, 1), (12, 256, 256, 3, 1, 1), (14, 256, 256, 3, 1, 1), "out", ("max", 2)),
        *((17, 256, 512, 3, 1, 1), (19, 512, 512, 3, 1, 1), (21, 512, 512, 3, 1, 1), "out", ("max", 2)),
        *((24, 512, 512, 3, 1, 1), (26, 512, 512, 3, 1, 1), (28, 512, 512, 3, 1, 1), "out"),
    ],
}


def lpips_weights(backbone: str) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Random weights under the names of torchvision's file, and of that of the package `lpips`."""
    generator = torch.Generator().manual_seed(3)
    backbone_file, own = {}, {}
    convs = [one for one in NETWORKS[backbone] if isinstance(one[0], int)]
    for number, inputs, outputs, width, _, _ in convs:
        spread = (2.0 / (inputs * width**2)) ** 0.5  # which keeps the features' size from layer to layer
        kernel = spread * torch.randn(outputs, inputs, width, width, generator=generator)
        backbone_file[f"features.{number}.weight"] = kernel
        backbone_file[f"features.{number}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
    backbone_file["classifier.6.bias"] = torch.zeros(10)  # of the part that LPIPS leaves out
    last = [before[2] for before, after in pairwise(NETWORKS[backbone]) if after == "out"]
    for k, channels in enumerate(last):
        own[f"lin{k}.model.1.weight"] = torch.rand(1, channels, 1, 1, generator=generator)
    return backbone_file, own
