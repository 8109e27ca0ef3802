"""What the photographs of a frame say of its pose: loss, gradient and curvature, through the rasteriser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float32
from torch import Tensor

from avatar.data.views import View
from avatar.gaussians.binding import BoundGaussians, WorldGaussians, world_from_frames
from avatar.gaussians.frames import triangle_frames
from avatar.rendering.api import rasterize
from avatar.training.refinement.config import RefineConfig

EPS2D = 0.1
"""Pixels squared that the rasteriser blurs by, as in the trainings."""
_XX, _XY, _YY, _MASS = 3, 4, 5, 6


@dataclass(frozen=True, eq=False)
class Evidence:
    """Sums over the views of a frame, in units of the trusted error of a pixel.

    Attributes:
        loss: robust.
        vertices: gradient of the posed vertices.
        curvature: of the centres of the Gaussians, symmetric, at least 0.
        means, normals: centres of the Gaussians and their normals, world, metres. pull: gradient of the centres.
        color_gradient, color_mass: what moves colours, see `AppearanceSums`.
        cameras: gradient and curvature of each view's Gaussians alone, by camera; empty if not asked for.
    """

    loss: float
    vertices: Float32[Tensor, "V 3"]
    curvature: Float32[Tensor, "N 3 3"]
    means: Float32[Tensor, "N 3"]
    normals: Float32[Tensor, "N 3"]
    pull: Float32[Tensor, "N 3"]
    color_gradient: Float32[Tensor, "N 3"]
    color_mass: Float32[Tensor, " N"]
    cameras: dict[str, tuple[Tensor, Tensor]]


class Photometer:
    """Compares Gaussians on a posed mesh with photographs.

    `L = k / 2 sum_p q_p s^2 / (q_p + s^2)` with `q_p` the squared difference of colour, and of opacity times `alpha`,
    at a pixel and s = `robust` (Geman and McClure 1987). k makes one full-size pixel count `1 / pixels_per_error` of an
    observation with the standard deviation `pixel_sigma`.

    Gradients are those of the rasteriser. The curvature is Gauss and Newton's for a picture that moves with its
    surface: the structure tensor of the rendering, which the rasteriser's own backward pass shares out to the Gaussians
    by what they contribute to each pixel.

    Args:
        faces: of the template. background: sRGB.
    """

    def __init__(self, faces: Tensor, background: Float[Tensor, " 3"], config: RefineConfig) -> None:
        self.faces, self.background, self.config = faces, background, config

    def evidence(
        self,
        gaussians: BoundGaussians,
        vertices: Float32[Tensor, "V 3"],
        views: Sequence[View],
        *,
        halvings: int,
        each_camera: bool = False,
    ) -> Evidence:
        """Return what views at `halvings` say of Gaussians on a mesh."""
        leaf = vertices.detach().requires_grad_(True)
        world = world_from_frames(gaussians, triangle_frames(leaf, self.faces))
        held = [t.detach().requires_grad_(True) for t in (world.means, world.quats, world.scales)]
        N = len(held[0])
        curvature, loss = held[0].new_zeros(N, 3, 3), 0.0
        colors, mass = held[0].new_zeros(N, 3), held[0].new_zeros(N)
        own: dict[str, tuple[Tensor, Tensor]] = {}
        for view in views:
            features = torch.cat([gaussians.dc, gaussians.dc.new_zeros(N, 4)], dim=1).requires_grad_(True)
            before = held[0].grad.clone() if each_camera and held[0].grad is not None else torch.zeros_like(held[0])
            loss += self._view(replace(world, means=held[0], quats=held[1], scales=held[2]), features, view, halvings)
            assert features.grad is not None and held[0].grad is not None
            into = torch.zeros_like(curvature) if each_camera else curvature
            _add_in_world(into, features.grad[:, _XX:_MASS], held[0].detach(), view)
            colors += features.grad[:, :3]
            mass += features.grad[:, _MASS]
            if each_camera:
                own[view.name] = (held[0].grad - before, into)
                curvature += into
        torch.autograd.backward((world.means, world.quats, world.scales), [t.grad for t in held])
        assert leaf.grad is not None
        pull = held[0].grad
        assert pull is not None
        means, normals = held[0].detach(), world.normals.detach()
        return Evidence(loss, leaf.grad, curvature, means, normals, pull, colors, mass, own)

    def firm_loss(
        self,
        gaussians: BoundGaussians,
        vertices: Float32[Tensor, "V 3"],
        firmness: Float32[Tensor, " N"],
        views: Sequence[View],
    ) -> float:
        """Return the mean of `q / (q + s^2)` over the pixels that show firm Gaussians, weighted by how firm they are.

        0 is a perfect picture, 1 a wrong one; what hangs loosely is not looked at.
        """
        total = weight = 0.0
        with torch.no_grad():
            world = world_from_frames(gaussians, triangle_frames(vertices, self.faces))
            features = torch.cat([gaussians.dc, firmness[:, None]], dim=1)
            for view in views:
                image, alpha = self._draw(world, features, view)
                q, _, _ = self._difference(image, alpha, view)
                share = image[..., 3]
                total += float((share * q / (q + self.config.robust**2)).sum())
                weight += float(share.sum())
        return total / max(weight, 1e-9)

    def _view(self, world: WorldGaussians, features: Tensor, view: View, halvings: int) -> float:
        """Add the gradients of one view; the loss."""
        robust = self.config.robust**2
        # A pixel of a halved photograph is four of the full-size one.
        scale = 4.0**halvings / (self.config.pixel_sigma**2 * self.config.pixels_per_error)
        image, alpha = self._draw(world, features, view)
        with torch.no_grad():
            q, color, opacity = self._difference(image, alpha, view)
            weight = scale * (robust / (q + robust)) ** 2
            flow = torch.cat([image[..., :3], self.config.alpha**0.5 * alpha[..., None]], dim=-1)
            dx, dy = _slopes(flow)
            tensor = [(dx * dx).sum(-1) * weight, (dx * dy).sum(-1) * weight, (dy * dy).sum(-1) * weight, weight]
            to_image = torch.cat([weight[..., None] * color, torch.stack(tensor, dim=-1)], dim=-1)
            to_alpha = weight * self.config.alpha * opacity
        torch.autograd.backward((image, alpha), (to_image, to_alpha))
        return float((0.5 * scale * robust * q / (q + robust)).sum())

    def _draw(self, world: WorldGaussians, features: Tensor, view: View) -> tuple[Tensor, Tensor]:
        image, alpha, _ = rasterize(
            world.means,
            world.quats,
            world.scales,
            world.opacities,
            features,
            view.viewmat[None],
            view.K[None],
            view.camera.width,
            view.camera.height,
            background=torch.nn.functional.pad(self.background, (0, features.shape[1] - 3)),
            eps2d=EPS2D,
            check=False,
        )
        return image[0], alpha[0, ..., 0]

    def _difference(self, image: Tensor, alpha: Tensor, view: View) -> tuple[Tensor, Tensor, Tensor]:
        """Squared difference of all channels, difference of colours, difference of opacities."""
        color = image[..., :3] - view.composited(self.background)
        opacity = alpha - view.opacity()
        return color.square().sum(-1) + self.config.alpha * opacity.square(), color, opacity


def _slopes(image: Float[Tensor, "H W C"]) -> tuple[Tensor, Tensor]:
    """Central differences along x and y; 0 at the border."""
    dx, dy = torch.zeros_like(image), torch.zeros_like(image)
    dx[:, 1:-1] = 0.5 * (image[:, 2:] - image[:, :-2])
    dy[1:-1] = 0.5 * (image[2:] - image[:-2])
    return dx, dy


def _add_in_world(
    curvature: Float[Tensor, "N 3 3"], tensor: Float[Tensor, "N 3"], means: Float[Tensor, "N 3"], view: View
) -> None:
    """Add `D^T T D` of structure tensors (xx, xy, yy) in pixels, D the derivative of the projection at the centres."""
    rows = torch.nonzero((tensor[:, 0] > 0) | (tensor[:, 2] > 0)).flatten()  # half of the person is turned away
    xx, xy, yy = (column[:, None] for column in tensor[rows].unbind(-1))
    right, down, ahead = view.viewmat[:3, :3]
    x, y, z = (means[rows] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]).split(1, dim=-1)
    dx = view.K[0, 0] / z * (right - x / z * ahead)
    dy = view.K[1, 1] / z * (down - y / z * ahead)
    left = torch.stack([xx * dx + xy * dy, xy * dx + yy * dy], dim=-1)
    curvature.index_add_(0, rows, left @ torch.stack([dx, dy], dim=1))
