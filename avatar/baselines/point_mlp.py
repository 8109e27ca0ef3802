"""Position MLP: predict every Gaussian's residuals from its position in the T-pose, the pose and a frame code.

The kind of 3DGS-Avatar (Qian et al. 2024): a shallow network on the canonical position, conditioned on the pose and a
latent code of the frame, moves, scales, turns and recolours each Gaussian before skinning. Theirs encodes positions in
a hash grid, learns the skinning weights and shades with a second network; here positions are encoded by sines, and
skinning and spherical harmonics are those of all rows.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, cat, nn

from avatar.baselines.avatar_base import RESIDUALS, ResidualBaseline
from avatar.gaussians.binding import BoundGaussians
from avatar.models.networks.deformation_field import positional_encoding
from avatar.rig.rig import THETA, Pose, Rig
from smplxpp.core.errors import require_at_least


@dataclass(frozen=True)
class PointMLPConfig:
    """Sizes of the position MLP and of its inputs.

    Attributes:
        frequencies: number of bands of the positional encoding.
        code_size: length of a frame's code.
        width: of the hidden layers.
        hidden_layers: number of hidden layers; one more layer gives the residuals.
    """

    frequencies: int = 6
    code_size: int = 32
    width: int = 64
    hidden_layers: int = 4

    def __post_init__(self) -> None:
        require_at_least("position MLP frequencies", self.frequencies, 0)
        for name in ("code_size", "width", "hidden_layers"):
            require_at_least(f"position MLP {name}", getattr(self, name), 1)


class PointMLPAvatar(ResidualBaseline):
    """`residuals_i = MLP(phi(u_i), theta, z_t)`, u_i the Gaussian in the T-pose; they start at zero.

    Args:
        config: sizes.
        rig: of the template.
        gaussians: on the template.
        frames: frames with a code.
    """

    encodings: Tensor

    def __init__(self, config: PointMLPConfig, rig: Rig, gaussians: BoundGaussians, frames: Sequence[int]) -> None:
        super().__init__(rig, gaussians, frames, code_size=config.code_size)
        self.config = config
        self.register_buffer("encodings", positional_encoding(self.points, config.frequencies), persistent=False)
        # One layer of all inputs, in two parts: that of pose and code is computed once a frame.
        self.of_point = nn.Linear(self.encodings.shape[1], config.width, bias=False)
        self.of_frame = nn.Linear(THETA + config.code_size, config.width)
        # Initialised as one layer over all inputs would be, by its whole fan-in; the last layer starts at 0, so that
        # training begins with the skinned template.
        bound = 1.0 / math.sqrt(self.encodings.shape[1] + THETA + config.code_size)
        for layer in (self.of_point, self.of_frame):
            nn.init.uniform_(layer.weight, -bound, bound)
        self.hidden = nn.ModuleList(nn.Linear(config.width, config.width) for _ in range(config.hidden_layers - 1))
        self.last = nn.Linear(config.width, RESIDUALS)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)
        self.to(rig.device)

    def residuals(self, pose: Pose, code: Float[Tensor, " Z"]) -> Float[Tensor, "N 12"]:
        """Return the outputs in the order of `RESIDUALS`; `code` is that of the frame."""
        # W [phi; theta; z] = W_point phi + W_frame [theta; z]: N
        # rows from the first term, and one row that is added to all.
        x = F.relu(self.of_point(self.encodings) + self.of_frame(cat([pose.body_pose, code])))
        for layer in self.hidden:
            x = F.relu(layer(x))
        return self.last(x)
