"""UV U-Net: predict the Gaussians' residuals from a UV position map of the posed body by a small U-Net.

The kind of GaussianAvatar (Hu et al. 2024): a pose encoder turns the UV position map of the posed body into a feature
map, to which one learned feature map of the person is added, and a decoder gives Gaussians their parameters. Theirs has
SMPL's artist-made atlas, one Gaussian a texel and refines the poses too; here the atlas is made from the template
(`cylinder_atlas`), Gaussians are those of all rows and look their residuals up, and poses stay as given.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from avatar.baselines.avatar_base import RESIDUALS, ResidualBaseline
from avatar.baselines.uv_atlas import cylinder_atlas
from avatar.gaussians.binding import BoundGaussians
from avatar.models.networks.stylegan2_layers import ConvLayer
from avatar.rig.rig import Pose, Rig
from smplxpp.core.validation import require_at_least


@dataclass(frozen=True)
class UVUNetConfig:
    """Sizes of the UV U-Net and of its maps.

    Attributes:
        size: side of the maps, texels.
        features: channels of the person's learned map.
        channels: of the U-Net's scales, the finest first; each next scale has half the side.
        code_size: length of a frame's code, which every texel gets.
    """

    size: int = 128
    features: int = 16
    channels: tuple[int, ...] = (24, 32, 48, 64)
    code_size: int = 16

    def __post_init__(self) -> None:
        for name in ("features", "code_size"):
            require_at_least(f"UV U-Net {name}", getattr(self, name), 1)
        require_at_least("UV U-Net scales", len(self.channels), 1)
        require_at_least("UV U-Net size", self.size, 2 ** (len(self.channels) + 1))


class UNet(nn.Module):
    """A U-Net between maps of the same side, whose output is initially zero.

    The side S has to be divisible by 2 for every scale but the first.
    """

    def __init__(self, inputs: int, channels: Sequence[int], outputs: int) -> None:
        super().__init__()
        self.first = ConvLayer(inputs, channels[0])
        # The encoder halves the side from scale to scale; the decoder doubles it and joins the encoder's maps.
        pairs = list(pairwise(channels))
        self.down = nn.ModuleList(ConvLayer(fine, coarse, down=True) for fine, coarse in pairs)
        self.up = nn.ModuleList(ConvLayer(fine + coarse, fine) for fine, coarse in reversed(pairs))
        self.last = nn.Conv2d(channels[0], outputs, 1)
        # Residuals start at 0, so that training begins with the skinned template.
        nn.init.zeros_(self.last.weight)
        assert self.last.bias is not None
        nn.init.zeros_(self.last.bias)

    def forward(self, x: Float[Tensor, "1 I S S"]) -> Float[Tensor, "1 O S S"]:
        """Apply the network to a map of positions."""
        # Skip connections carry the fine scales across the bottleneck (Ronneberger et al. 2015).
        scales = [self.first(x)]
        for layer in self.down:
            scales.append(layer(scales[-1]))
        x = scales.pop()
        for layer in self.up:
            x = layer(torch.cat([scales.pop(), F.interpolate(x, scale_factor=2, mode="bilinear")], dim=1))
        return self.last(x)


class UVUNetAvatar(ResidualBaseline):
    """`residual map = UNet(position map + learned features + z_t)`, looked up bilinearly at each Gaussian.

    Args:
        config: sizes.
        rig: of the template; the published method has the naked body.
        gaussians: on the template.
        frames: frames with a code.
    """

    texels: Tensor
    texel_corners: Tensor
    texel_weights: Tensor
    grid: Tensor

    def __init__(self, config: UVUNetConfig, rig: Rig, gaussians: BoundGaussians, frames: Sequence[int]) -> None:
        super().__init__(rig, gaussians, frames, code_size=config.code_size)
        self.config = config
        size = config.size
        # Texels without a point near them stay empty; the others interpolate the corners of their point's face.
        atlas = cylinder_atlas(
            rig.template, self.points.double().cpu().numpy(), gaussians.face_index.cpu().numpy(), size=size
        )
        anchor = torch.tensor(atlas.anchor.reshape(-1), device=rig.device)
        texels = torch.nonzero(anchor >= 0)[:, 0]
        grid = torch.tensor(2.0 * atlas.pixels / size - 1.0, dtype=torch.float32, device=rig.device)
        self.register_buffer("texels", texels, persistent=False)
        # `grid_sample` takes coordinates in [-1, 1] over the whole map.
        face = gaussians.face_index.to(rig.device)[anchor[texels]]
        self.register_buffer("texel_corners", rig.faces[face], persistent=False)
        self.register_buffer("texel_weights", self.corner_weights[anchor[texels]], persistent=False)
        self.register_buffer("grid", grid[None, None], persistent=False)
        self.person = nn.Parameter(torch.zeros(1, config.features, size, size))
        self.network = UNet(3 + config.features + config.code_size, config.channels, RESIDUALS)
        self.to(rig.device)

    def position_map(self, pose: Pose) -> Float[Tensor, "1 3 S S"]:
        """Return posed points without the root's motion, metres, 0 between the charts; a constant for gradients."""
        with torch.no_grad():
            # Without the root's rotation and place the map depends
            # on the pose alone, and learns no position in the room.
            to_root = pose.root_from_world
            vertices = self.rig.skin(pose) @ to_root[:3, :3].T + to_root[:3, 3]
            seen = (self.texel_weights[..., None] * vertices[self.texel_corners]).sum(1)
            out = vertices.new_zeros(self.config.size**2, 3).index_copy(0, self.texels, seen)
            return out.T.reshape(1, 3, self.config.size, self.config.size)

    def residuals(self, pose: Pose, code: Float[Tensor, " Z"]) -> Float[Tensor, "N 12"]:
        """Return the outputs in the order of `RESIDUALS`; `code` is that of the frame."""
        # The code is the same at every texel; each Gaussian then reads its residuals at its own place in the atlas.
        of_frame = code[None, :, None, None].expand(-1, -1, self.config.size, self.config.size)
        maps = self.network(torch.cat([self.position_map(pose), self.person, of_frame], dim=1))
        return F.grid_sample(maps, self.grid, align_corners=False)[0, :, 0].T
