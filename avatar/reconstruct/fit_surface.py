"""Fit of the neural surface to photographs: colour, mask and eikonal terms over rays that enter the hull."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from avatar.reconstruct.neural_surface import HashGrid, NeuralSurface
from smplxpp.core import InputError, ProgressCallback, TriangleMesh, ignore_progress, require_at_least, require_positive
from smplxpp.core.errors import one_line
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.raster import rasterize_mesh
from smplxpp.reconstruct import Box, PhotoView
from smplxpp.reconstruct.hull import main_body, zero_surface


@dataclass(frozen=True, eq=False)
class Rays:
    """N rays with the colour and opacity of their pixels.

    Attributes:
        origin: centre of projection in the world, metres.
        direction: unit vector in the world.
        enter: metres to the hull.
        color: of the pixel, sRGB in [0, 1].
        opacity: of the person.
    """

    origin: Float[Tensor, "N 3"]
    direction: Float[Tensor, "N 3"]
    enter: Float[Tensor, " N"]
    color: Float[Tensor, "N 3"]
    opacity: Float[Tensor, " N"]

    def __len__(self) -> int:
        return len(self.origin)

    def select(self, rows: Tensor) -> Rays:
        """Return the rays of chosen rows."""
        return Rays(self.origin[rows], self.direction[rows], self.enter[rows], self.color[rows], self.opacity[rows])


def rays_of(views: Sequence[PhotoView], hull: TriangleMesh, device: torch.device | str) -> Rays:
    """Return the rays of all pixels that the hull covers; the masks exclude all others.

    Raises:
        InputError: the hull is in no photograph.
    """
    parts: dict[str, list[np.ndarray]] = {name: [] for name in ("origin", "direction", "enter", "color", "opacity")}
    for view in views:
        # Pixels of the hull, their directions in the world, and the distance along the ray to the hull.
        depth = rasterize_mesh(hull, view.camera).depth
        row, column = np.nonzero(np.isfinite(depth))
        # Homogeneous pixel centres (R, 3); K^-1 turns them into directions with z = 1 in camera axes (OpenCV's).
        pixels = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=1)
        in_camera = pixels @ np.linalg.inv(view.camera.K).T
        length = np.linalg.norm(in_camera, axis=1)
        # Rows times R is R^T times columns: the inverse of the camera's rotation. Depths are along z, so metres along
        # the
        # ray are depth times the length of its direction with z = 1.
        parts["direction"].append(in_camera / length[:, None] @ view.camera.cam_from_world[:3, :3])
        parts["origin"].append(np.broadcast_to(view.camera.position, (len(row), 3)))
        parts["enter"].append(depth[row, column] * length)
        parts["color"].append(view.color[row, column] / 255.0)
        parts["opacity"].append(view.opacity[row, column] / 255.0)
    if not sum(map(len, parts["enter"])):
        raise InputError("photographs", expected="some that show the hull", received="none")
    tensors = {
        name: torch.from_numpy(np.concatenate(values).astype(np.float32)).to(device) for name, values in parts.items()
    }
    return Rays(**tensors)


def opacities(distance: Float[Tensor, "R S"], sharpness: Float[Tensor, ""]) -> Float[Tensor, "R T"]:
    """Return the opacity of each interval between samples, `max((s_i - s_{i+1}) / s_i, 0)`, s the logistic of f.

    Wang et al. (2021), "NeuS": unbiased at the zero of the distance f.
    """
    # s falls from 1 outside to 0 inside; the drop between samples, relative to s, is the opacity. Rising s (a ray
    # that
    # leaves the body) is clamped to 0, and the lower bound keeps the quotient finite deep inside.
    at = torch.sigmoid(distance * sharpness)
    return ((at[:, :-1] - at[:, 1:]) / at[:, :-1].clamp(min=1e-6)).clamp(0, 1)


def weights_of(opacity: Float[Tensor, "R S"]) -> Float[Tensor, "R S"]:
    """Return the weight of each interval in the pixel: its opacity times the transmittance before it."""
    # Transmittance behind each interval; the small term keeps the product's gradient finite at an opacity of 1.
    through = torch.cumprod(1 - opacity + 1e-7, dim=1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)
    return opacity * before


_CHUNK = 1 << 17  # points evaluated at once, which bounds the memory


@dataclass(frozen=True)
class SurfaceConfig:
    """Choices of the fit of a neural surface; lengths in metres.

    Attributes:
        iterations: number of steps.
        rays: of a step.
        samples: of a ray.
        before: distance in front of the hull's surface from which a ray is sampled.
        behind: distance behind the hull's surface to which a ray is sampled.
        levels: of the hash grid.
        finest: cells along a side of its finest level.
        log2_entries: of its tables.
        rate: learning rate of Adam at the start.
        eikonal: weight of `(|grad f| - 1)^2`, relative to the colours.
        mask: weight of the cross-entropy of a ray's opacity and its mask.
        residual: weight of the mean distance from the hull.
        hull_cell: of the grid with the hull's distance.
        cell: of the grid from which the surface is extracted.
        seed: of the sampled rays.
    """

    iterations: int = 15_000
    rays: int = 4096
    samples: int = 64
    before: float = 0.01
    behind: float = 0.12
    levels: int = 14
    finest: int = 1024
    log2_entries: int = 19
    rate: float = 5e-3
    eikonal: float = 0.1
    mask: float = 0.1
    residual: float = 0.05
    hull_cell: float = 0.01
    cell: float = 0.003
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("iterations", "rays", "samples", "levels", "finest"):
            require_at_least(f"surface config {name}", getattr(self, name), 1)
        for name in ("behind", "rate", "hull_cell", "cell"):
            require_positive(f"surface config {name}", getattr(self, name))


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A fitted surface with its network and losses.

    Attributes:
        mesh: closed.
        model: on its device.
        losses: of every iteration.
    """

    mesh: TriangleMesh
    model: NeuralSurface
    losses: Float32[np.ndarray, " I"]

    __repr__ = one_line


def fit_surface(
    views: Sequence[PhotoView],
    hull: TriangleMesh,
    config: SurfaceConfig | None = None,
    *,
    device: torch.device | str = "cuda",
    progress: ProgressCallback = ignore_progress,
) -> SurfaceFit:
    """Fit a signed distance, a residual over the hull's, to photographs, and take its surface.

    Args:
        views: of one moment, whose masks agree.
        hull: closed, around the person.
        device: a CUDA device; "cpu" takes hours at the default size.

    Raises:
        InputError: the hull is in no photograph, or the fit lost its surface.
    """
    # Grid of the hull's distance, network, rays and optimiser.
    config = config or SurfaceConfig()
    torch.manual_seed(config.seed)
    generator = torch.Generator().manual_seed(config.seed)
    margin = config.before + 2 * config.hull_cell
    box = Box(hull.vertices.min(axis=0) - margin, hull.vertices.max(axis=0) + margin)
    grid = HashGrid(
        levels=config.levels,
        coarsest=min(16, config.finest),
        finest=config.finest,
        log2_entries=config.log2_entries,
    )
    low, high = (torch.from_numpy(side.astype(np.float32)) for side in (box.low, box.high))
    model = NeuralSurface(hull_grid(hull, box, config.hull_cell), low, high, grid).to(device)
    rays = rays_of(views, hull, device)
    optimizer = torch.optim.Adam(model.parameters(), lr=config.rate, betas=(0.9, 0.99), eps=1e-15)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.iterations, eta_min=0.05 * config.rate)
    losses = np.zeros(config.iterations, np.float32)
    for k in range(config.iterations):
        if k % 50 == 0:
            progress("surface", k / config.iterations)
        # Rays of this step, drawn on the CPU so that the draws do not depend on the device.
        rows = torch.randint(len(rays), (config.rays,), generator=generator).to(device)
        # Gradients are differences over cells that shrink from 2 cm to twice the final cell: coarse shape first.
        share = k / max(config.iterations - 1, 1)
        step = float(np.exp((1 - share) * np.log(0.02) + share * np.log(2 * config.cell)))
        loss = surface_loss(model, rays.select(rows), config, generator, step=step)
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        optimizer.step()
        schedule.step()
        losses[k] = float(loss.detach())
    if not np.isfinite(losses).all():
        raise InputError("neural surface", expected="a loss that stays finite", received="NaN", remedy="lower the rate")
    # Extract the zero level set, and keep the main body.
    mesh, _ = main_body(extract(model, box, config.cell))
    return SurfaceFit(mesh, model, losses)


def surface_loss(
    model: NeuralSurface, rays: Rays, config: SurfaceConfig, generator: torch.Generator, *, step: float
) -> Float[Tensor, ""]:
    """Return the loss of rays: L1 of colours inside the mask, cross-entropy of opacity, eikonal and residual terms."""
    # Stratified samples around the hull's surface, and the weights of the intervals between them.
    count, samples = len(rays), config.samples
    jitter = torch.rand((count, samples + 1), generator=generator).to(rays.enter.device)
    along = (torch.arange(samples + 1, device=jitter.device) + jitter) / (samples + 1)
    # (R, S + 1) samples from `before` in front of the hull to `behind` inside it; (R, S) intervals between them.
    depth = rays.enter[:, None] - config.before + (config.before + config.behind) * along
    points = rays.origin[:, None] + depth[..., None] * rays.direction[:, None]
    distance = model.distance(points.reshape(-1, 3)).reshape(count, samples + 1)
    weights = weights_of(opacities(distance, model.sharpness))
    # Gradients and colours in the middle of the intervals.
    middle = 0.5 * (points[:, :-1] + points[:, 1:]).reshape(-1, 3)
    gradient = model.gradient(middle, step=step)
    normals = torch.nn.functional.normalize(gradient, dim=1)
    directions = rays.direction[:, None].expand(-1, samples, -1).reshape(-1, 3)
    colors = model.look(middle, normals, directions).reshape(count, samples, 3)
    # Volume rendering, then the four terms.
    opacity = weights.sum(dim=1)
    seen = (weights[..., None] * colors).sum(dim=1)
    person = (rays.opacity > 0.99).float()
    # L1 over the pixels that the mask gives wholly to the person, because the background's colour is not modelled.
    color = (person[:, None] * (seen - rays.color).abs()).sum() / (3 * person.sum()).clamp(min=1)
    # The clamp bounds the cross-entropy's slope where a ray is nearly opaque or clear.
    mask = torch.nn.functional.binary_cross_entropy(opacity.clamp(1e-3, 1 - 1e-3), rays.opacity)
    # A signed distance has a gradient of length 1. The residual term keeps f near the hull where photographs do not
    # determine it.
    eikonal = ((gradient.norm(dim=1) - 1) ** 2).mean()
    residual = (distance - model.hull_distance(points.reshape(-1, 3)).reshape(distance.shape)).abs().mean()
    return color + config.mask * mask + config.eikonal * eikonal + config.residual * residual


def hull_grid(hull: TriangleMesh, box: Box, cell: float) -> Float[Tensor, "X Y Z"]:
    """Return the hull's signed distance on a grid over the box, negative inside."""
    # Grid points of the box, evaluated in chunks.
    counts = np.maximum(np.ceil((box.high - box.low) / cell).astype(int) + 1, 2)
    axes = [np.linspace(low, high, count) for low, high, count in zip(box.low, box.high, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    field, found = SignedDistanceField(hull, solid=True), np.empty(len(points), np.float32)
    for first in range(0, len(points), _CHUNK):
        found[first : first + _CHUNK] = field.query(points[first : first + _CHUNK]).distance
    # Back to the grid (X, Y, Z); the mesh grid above ran with z fastest.
    return torch.from_numpy(found.reshape(counts))


@torch.no_grad()
def extract(model: NeuralSurface, box: Box, cell: float) -> TriangleMesh:
    """Extract the closed surface on which the distance is zero.

    Raises:
        InputError: there is none.
    """
    device = model.low.device
    far = 0.05  # metres, to which distances are clamped

    def inside(points: Float32[np.ndarray, "N 3"]) -> Float32[np.ndarray, " N"]:
        found = np.empty(len(points), np.float32)
        for first in range(0, len(points), _CHUNK):
            # The extractor wants positive values inside; far values are clamped, because only the zero crossing
            # matters.
            part = torch.from_numpy(points[first : first + _CHUNK]).to(device)
            found[first : first + _CHUNK] = -model.distance(part).float().cpu().numpy()
        return np.clip(found, -far, far)

    return zero_surface(inside, box, cell=cell)
