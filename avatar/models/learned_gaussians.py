"""Bound Gaussians whose attributes are parameters of a module."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from avatar.gaussians.binding import BoundGaussians

LEARNED = ("normal_offset", "offset", "log_scales", "quats", "opacity_logits", "dc", "sh")
"""Learned attributes; triangles and barycentric coordinates stay fixed."""


class LearnedGaussians(nn.Module):
    """Parameters named as the learned attributes of `BoundGaussians`; its other tensors are buffers.

    Args:
        start: initial attributes.
    """

    face_index: Tensor
    barycentric: Tensor
    normal_offset: nn.Parameter
    offset: nn.Parameter
    log_scales: nn.Parameter
    quats: nn.Parameter
    opacity_logits: nn.Parameter
    dc: nn.Parameter
    sh: nn.Parameter

    def __init__(self, start: BoundGaussians) -> None:
        super().__init__()
        self.face_count, self.topology = start.face_count, start.topology
        # Learned attributes become parameters, all other tensors buffers.
        for name, value in start.tensors.items():
            if name in LEARNED:
                setattr(self, name, nn.Parameter(value.detach().clone()))
            else:
                self.register_buffer(name, value.detach().clone())

    def __len__(self) -> int:
        return len(self.face_index)

    def forward(self) -> BoundGaussians:
        """Return the current Gaussians, with gradients to the attributes."""
        # Parameters keep their graph; buffers are constants. The dataclass checks the shapes each time.
        named = {**dict(self.named_parameters()), **dict(self.named_buffers())}
        return BoundGaussians(**named, face_count=self.face_count, topology=self.topology)

    def snapshot(self) -> BoundGaussians:
        """Return detached copies on the CPU."""
        bound = self()
        copies = {name: value.detach().cpu().clone() for name, value in bound.tensors.items()}
        return BoundGaussians(**copies, face_count=self.face_count, topology=self.topology)

    def take(self, other: BoundGaussians) -> None:
        """Take over the learned attributes of other Gaussians at the same places."""
        with torch.no_grad():
            for name in LEARNED:
                getattr(self, name).copy_(other.tensors[name])

    def normalise_quats(self) -> None:
        """Normalise all quaternions, so that residuals added to them have one scale."""
        with torch.no_grad():
            self.quats.div_(self.quats.norm(dim=-1, keepdim=True))
