"""The photometric loss of a frame with its gradient and Gauss-Newton curvature, through the rasteriser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Float32
from torch import Tensor

from avatar.data.views import View
from avatar.gaussians import BoundGaussians, WorldGaussians, triangle_frames, world_from_frames
from avatar.rendering.api import rasterize
from avatar.training.refinement.config import RefineConfig

# Channels of the features that are rasterised beside the three colours: their gradients carry the entries of the
# structure tensor and the mass of each Gaussian.
_XX, _MASS = 3, 6


@dataclass(frozen=True, eq=False)
class Linearization:
    """Loss, gradients and Gauss-Newton curvature of a frame, summed over its views; units of the observation error.

    Attributes:
        loss: the robust loss.
        vertex_gradient: of the posed vertices, 1/m.
        curvature: M, Gauss-Newton matrices of the centres of the Gaussians, positive semi-definite, 1/m^2.
        means: centres of the Gaussians, world, metres.
        normals: of the Gaussians, unit, world.
        mean_gradient: of the centres, 1/m.
        color_gradient: of the colours.
        color_mass: of the colours, the summed weights of pixels; see `AppearanceUpdate`.
        cameras: by camera, `mean_gradient` and `curvature` of its view alone; empty unless requested.
    """

    loss: float
    vertex_gradient: Float32[Tensor, "V 3"]
    curvature: Float32[Tensor, "N 3 3"]
    means: Float32[Tensor, "N 3"]
    normals: Float32[Tensor, "N 3"]
    mean_gradient: Float32[Tensor, "N 3"]
    color_gradient: Float32[Tensor, "N 3"]
    color_mass: Float32[Tensor, " N"]
    cameras: dict[str, tuple[Tensor, Tensor]]


class PhotometricLoss:
    """Compares Gaussians on a posed mesh with photographs.

    `L = k / 2 sum_p q_p s^2 / (q_p + s^2)`, the kernel of Geman and McClure (1987), with `q_p` the squared difference
    of colour plus `alpha` times that of opacity at a pixel, and s = `robust`. k makes one full-size pixel count as
    `1 / pixels_per_error` of an observation with the standard deviation `pixel_sigma`.

    Gradients come from the rasteriser's backward pass. The curvature is the Gauss-Newton approximation for a picture
    that moves with its surface: the structure tensor of the rendering, reweighted by the kernel's `w_p = k (s^2 / (q_p
    + s^2))^2` (iteratively reweighted least squares). The same backward pass distributes the tensor to the Gaussians by
    their contribution to each pixel.

    Args:
        faces: of the template.
        background: sRGB; where it lies pictures are drawn and compared. All else comes and goes where vertices lie.
        config: robust scale, weight of the opacity, and noise of a pixel.
    """

    def __init__(self, faces: Tensor, background: Float[Tensor, " 3"], config: RefineConfig) -> None:
        self.faces, self.background, self.config = faces.to(background.device), background, config

    def linearize(
        self,
        gaussians: BoundGaussians,
        vertices: Float32[Tensor, "V 3"],
        views: Sequence[View],
        *,
        halvings: int,
        each_camera: bool = False,
    ) -> Linearization:
        """Return loss, gradients and curvature of Gaussians on a mesh, summed over views.

        Args:
            gaussians: bound to the mesh.
            vertices: of the posed mesh, world, metres.
            views: photographs at `halvings` of their full size.
            halvings: of the photographs.
            each_camera: keep the sums of each view apart too.
        """
        # Cut the graph at the Gaussians, so that their gradients can be read before they pass on to the vertices.
        gaussians, leaf = self._here(gaussians, vertices)
        leaf.requires_grad_(True)
        world = world_from_frames(gaussians, triangle_frames(leaf, self.faces))
        cut = [t.detach().requires_grad_(True) for t in (world.means, world.quats, world.scales)]
        N = len(cut[0])
        curvature, loss = cut[0].new_zeros(N, 3, 3), 0.0
        colors, mass = cut[0].new_zeros(N, 3), cut[0].new_zeros(N)
        own: dict[str, tuple[Tensor, Tensor]] = {}
        for view in map(self._placed, views):
            # Render and backpropagate one view: gradients of centres, colours, structure tensors and masses.
            features = torch.cat([gaussians.dc, gaussians.dc.new_zeros(N, 4)], dim=1).requires_grad_(True)
            before = cut[0].grad.clone() if each_camera and cut[0].grad is not None else torch.zeros_like(cut[0])
            loss += self._view(replace(world, means=cut[0], quats=cut[1], scales=cut[2]), features, view, halvings)
            assert features.grad is not None and cut[0].grad is not None
            # Turn the structure tensors from pixels into the world and sum them.
            into = torch.zeros_like(curvature) if each_camera else curvature
            _add_in_world(into, features.grad[:, _XX:_MASS], cut[0].detach(), view)
            colors += features.grad[:, :3]
            mass += features.grad[:, _MASS]
            if each_camera:
                own[view.name] = (cut[0].grad - before, into)
                curvature += into
        # From the Gaussians to the vertices that carry them.
        torch.autograd.backward((world.means, world.quats, world.scales), [t.grad for t in cut])
        assert leaf.grad is not None
        mean_gradient = cut[0].grad
        assert mean_gradient is not None
        means, normals = cut[0].detach(), world.normals.detach()
        there = vertices.device
        return Linearization(
            loss,
            leaf.grad.to(there),
            curvature.to(there),
            means.to(there),
            normals.to(there),
            mean_gradient.to(there),
            colors.to(there),
            mass.to(there),
            {name: (gradient.to(there), matrices.to(there)) for name, (gradient, matrices) in own.items()},
        )

    def rigid_loss(
        self,
        gaussians: BoundGaussians,
        vertices: Float32[Tensor, "V 3"],
        rigidity: Float32[Tensor, " N"],
        views: Sequence[View],
    ) -> float:
        """Return the mean of `q / (q + s^2)` over pixels, weighted by the rendered rigidity: 0 perfect, 1 wrong.

        Pixels of loose cloth have weight 0.

        Args:
            gaussians: bound to the mesh.
            vertices: of the posed mesh, world, metres.
            rigidity: of the Gaussians, in [0, 1].
            views: photographs.
        """
        total = weight = 0.0
        gaussians, vertices = self._here(gaussians, vertices)
        rigidity = rigidity.to(vertices.device)
        with torch.no_grad():
            world = world_from_frames(gaussians, triangle_frames(vertices, self.faces))
            features = torch.cat([gaussians.dc, rigidity[:, None]], dim=1)
            for view in map(self._placed, views):
                image, alpha = self._draw(world, features, view)
                q, _, _ = self._difference(image, alpha, view)
                # The fourth channel is the rigidity, blended like a colour: how much of the pixel shows rigid
                # surface.
                share = image[..., 3]
                total += float((share * q / (q + self.config.robust**2)).sum())
                weight += float(share.sum())
        return total / max(weight, 1e-9)

    def _here(self, gaussians: BoundGaussians, vertices: Tensor) -> tuple[BoundGaussians, Tensor]:
        """Return Gaussians and vertices, these without gradients, where pictures are drawn."""
        device = self.background.device
        return gaussians if device.type == "cpu" else gaussians.to(device=device), vertices.detach().to(device)

    def _placed(self, view: View) -> View:
        """Return a photograph where pictures are drawn; one at a time, since a frame's can be gigabytes."""
        return view if self.background.device.type == "cpu" else view.to(self.background.device)

    def _view(self, world: WorldGaussians, features: Tensor, view: View, halvings: int) -> float:
        """Backpropagate one view into `world` and `features`, and return its loss."""
        robust = self.config.robust**2
        # A pixel of a halved photograph is four of the full-size one.
        scale = 4.0**halvings / (self.config.pixel_sigma**2 * self.config.pixels_per_error)
        image, alpha = self._draw(world, features, view)
        with torch.no_grad():
            # Weight of each pixel: derivative of the robust kernel.
            q, color, opacity = self._difference(image, alpha, view)
            weight = scale * (robust / (q + robust)) ** 2
            # Structure tensor of the rendering at each pixel, times the weight, and the weight itself as the mass.
            flow = torch.cat([image[..., :3], self.config.alpha**0.5 * alpha[..., None]], dim=-1)
            dx, dy = _slopes(flow)
            tensor = [(dx * dx).sum(-1) * weight, (dx * dy).sum(-1) * weight, (dy * dy).sum(-1) * weight, weight]
            # The gradient of the loss by the colours, and the tensor in the place of the other channels' gradient: the
            # backward pass of the blending sums both over the pixels of a Gaussian.
            to_image = torch.cat([weight[..., None] * color, torch.stack(tensor, dim=-1)], dim=-1)
            to_alpha = weight * self.config.alpha * opacity
        torch.autograd.backward((image, alpha), (to_image, to_alpha))
        return float((0.5 * scale * robust * q / (q + robust)).sum())

    def _draw(self, world: WorldGaussians, features: Tensor, view: View) -> tuple[Tensor, Tensor]:
        eps2d = 0.1  # pixels squared of blur, as in the trainings
        # Colours have the background behind them; all other channels are 0 there.
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
            eps2d=eps2d,
            check=False,
        )
        return image[0], alpha[0, ..., 0]

    def _difference(self, image: Tensor, alpha: Tensor, view: View) -> tuple[Tensor, Tensor, Tensor]:
        """Return the squared difference q of a pixel, and the differences of colours and of opacities."""
        # Residuals of sRGB on the same background, and of opacity against the mask.
        color = image[..., :3] - view.composited(self.background)
        opacity = alpha - view.opacity()
        return color.square().sum(-1) + self.config.alpha * opacity.square(), color, opacity


def _slopes(image: Float[Tensor, "H W C"]) -> tuple[Tensor, Tensor]:
    """Return central differences of an image along x and y, 0 at the border."""
    dx, dy = torch.zeros_like(image), torch.zeros_like(image)
    dx[:, 1:-1] = 0.5 * (image[:, 2:] - image[:, :-2])
    dy[1:-1] = 0.5 * (image[2:] - image[:-2])
    return dx, dy


def _add_in_world(
    curvature: Float[Tensor, "N 3 3"], tensor: Float[Tensor, "N 3"], means: Float[Tensor, "N 3"], view: View
) -> None:
    """Add `D^T T D` of structure tensors T (xx, xy, yy), 1/pixel^2, D the Jacobian of the projection at the centres."""
    # Project the centres, and take the Jacobian of the perspective projection: dx, dy by world coordinates.
    rows = torch.nonzero((tensor[:, 0] > 0) | (tensor[:, 2] > 0)).flatten()  # Gaussians on the far side have no pixels
    xx, xy, yy = (column[:, None] for column in tensor[rows].unbind(-1))
    right, down, ahead = view.viewmat[:3, :3]
    x, y, z = (means[rows] @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]).split(1, dim=-1)
    dx = view.K[0, 0] / z * (right - x / z * ahead)
    dy = view.K[1, 1] / z * (down - y / z * ahead)
    # D^T T D of a symmetric 2 x 2 tensor T.
    left = torch.stack([xx * dx + xy * dy, xy * dx + yy * dy], dim=-1)
    curvature.index_add_(0, rows, left @ torch.stack([dx, dy], dim=1))
