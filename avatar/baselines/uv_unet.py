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

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float64, Int, Int64
from scipy.spatial import cKDTree
from torch import Tensor, nn

from avatar.baselines.avatar_base import RESIDUALS, ResidualBaseline
from avatar.gaussians.binding import BoundGaussians
from avatar.models.networks.stylegan2_layers import ConvLayer
from avatar.rig.rig import Pose, Rig
from smplxpp.core.errors import require_at_least
from smplxpp.template.template import Template

BODY_JOINTS = 22
"""Number of SMPL-X's body joints. Joints of face and hands belong to their nearest body ancestor."""
GUTTER = 2
"""Free texels around each chart."""
REACH = 2.5
"""Largest distance from a texel to its anchor point, texels."""


@dataclass(frozen=True, eq=False)
class Atlas:
    """N points of a template in a square of `size` texels.

    Attributes:
        size: texels a side.
        pixels: column and row of each point, texel centres at +0.5.
        anchor: nearest point of each texel within `REACH`; -1 where there is none.
        chart: the chart of each point.
    """

    size: int
    pixels: Float64[np.ndarray, "N 2"]
    anchor: Int64[np.ndarray, "S S"]
    chart: Int64[np.ndarray, " N"]


def cylinder_atlas(
    template: Template, points: Float[np.ndarray, "N 3"], faces: Int[np.ndarray, " N"], *, size: int
) -> Atlas:
    """Unwrap points on the template's faces in the T-pose.

    A chart holds the points of one part that follow one body joint most. Its axis is the direction of its largest
    variance, u the angle around it times the mean radius, and v the height along it. All charts have the same texel
    density and are packed in rows. Nested surfaces (a tongue in a mouth) have separate charts if the body labels them.

    Args:
        template: with the faces.
        points: in the T-pose, metres.
        faces: face of each point.
        size: texels a side.
    """
    # A chart for each body joint and part, renumbered without gaps; each is unrolled to metres along u and v.
    chart = _charts(template)[template.faces[faces, 0]]
    chart = np.unique(chart, return_inverse=True)[1]
    flat = np.zeros((len(points), 2))
    for k in range(chart.max() + 1):
        flat[chart == k] = _unrolled(points[chart == k])
    low = np.stack([_by_chart(np.minimum, flat[:, axis], chart) for axis in (0, 1)], axis=1)
    extent = np.stack([_by_chart(np.maximum, flat[:, axis], chart) for axis in (0, 1)], axis=1) - low
    # One density for all charts keeps texels of the same size everywhere on the body.
    corners, density = _packed(extent, size)
    pixels = corners[chart] + GUTTER + (flat - low[chart]) * density
    # Each texel takes the nearest point, so that its position can be interpolated from that point's face.
    centres = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2) + 0.5
    distance, nearest = cKDTree(pixels).query(centres)
    anchor = np.where(distance <= REACH, nearest, -1).reshape(size, size)
    return Atlas(size, pixels, anchor, chart)


def _charts(template: Template) -> np.ndarray:
    """Return the (V,) chart of each vertex, by its part, the body's label and its heaviest body joint."""
    # Fingers and face have many joints and small areas: move up the tree until a joint of the body is reached.
    joint = np.argmax(template.weights.dense(), axis=1)
    while (outside := joint >= BODY_JOINTS).any():
        joint = np.where(outside, template.body.parents[joint], joint)
    label = template.body.part_labels[template.body_index]
    return (template.vertex_part * len(template.body.part_label_names) + label) * BODY_JOINTS + joint


def _unrolled(points: np.ndarray) -> np.ndarray:
    """Return (n, 2) metres along the circumference and along the axis of (n, 3) points; the seam lies at the back."""
    # The axis is the direction of the largest variance, the last eigenvector of the scatter matrix.
    centred = points - points.mean(axis=0)
    axis = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    # Front is +z of the T-pose without its component along the axis; for limbs along z (feet) it is +y.
    towards = np.eye(3)[1] if abs(axis[2]) > 0.7 else np.eye(3)[2]
    front = towards - (towards @ axis) * axis
    front /= np.linalg.norm(front)
    side = np.cross(axis, front)
    # Angle 0 points to the front, so that the jump of arctan2 from pi to -pi, the seam, lies at the back.
    x, z = centred @ side, centred @ front
    return np.stack([np.arctan2(x, z) * np.hypot(x, z).mean(), centred @ axis], axis=1)


def _by_chart(reduce: np.ufunc, values: np.ndarray, chart: np.ndarray) -> np.ndarray:
    start = np.inf if reduce is np.minimum else -np.inf
    out = np.full(chart.max() + 1, start)
    reduce.at(out, chart, values)
    return out


def _packed(extent: np.ndarray, size: int) -> tuple[np.ndarray, float]:
    """Return (K, 2) corners of K charts in texels, and the largest density, texels a metre, at which they all fit."""
    # Bisection on the density: the boxes fit at `low` and do not at `high`; 20 halvings are finer than a texel.
    low, high = 0.0, size / max(extent.max(), 1e-6)
    corners = _rows(np.ceil(low * extent) + 2 * GUTTER, size)
    for _ in range(20):
        middle = 0.5 * (low + high)
        placed = _rows(np.ceil(middle * extent) + 2 * GUTTER, size)
        if placed is None:
            high = middle
        else:
            low, corners = middle, placed
    assert corners is not None  # boxes of gutters alone fit
    return corners, low


def _rows(boxes: np.ndarray, size: int) -> np.ndarray | None:
    """Return (K, 2) corners of (K, 2) boxes put in rows, the highest first; None if they do not fit."""
    # Shelf packing: boxes in rows, sorted by height, so that little of a row's height is lost.
    corners = np.zeros_like(boxes)
    left = top = height = 0.0
    # Each box goes beside the one before it: a loop over charts, not over vertices.
    for k in np.argsort(-boxes[:, 1], kind="stable"):
        if left + boxes[k, 0] > size:
            left, top, height = 0.0, top + height, 0.0
        corners[k] = left, top
        left, height = left + boxes[k, 0], max(height, boxes[k, 1])
        if left > size or top + height > size:
            return None
    return corners


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
