"""Nuisance variables: colours and depths of the Gaussians, and small corrections of the training cameras' poses.

Photographs are handed out with these corrections. Each variable is summed over all views of a pass and takes one
Gauss-Newton step of its own: block coordinate descent.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from avatar.data.views import View
from avatar.gaussians.binding import BoundGaussians
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.photometric import Linearization
from smplxpp.core.rotations import matrix_from_rotvec

Views = Callable[[int], Sequence[View]]
"""Returns the photographs of a frame at full size."""


class AppearanceUpdate:
    """Sums over frames of what moves colours and depths, and their step.

    Colours: `c <- c - sum g / sum m`, g the gradient of a colour and m the weighted mass of its pixels: the
    simultaneous iterative reconstruction of Gilbert (1972). It needs no step size and cannot overshoot, because the
    contributions of all Gaussians to a pixel sum to at most 1.

    Depths: overlapping Gaussians draw the person too thick, the more so the coarser they and the pixels are. A body
    whose feet a skirt hides would sink until the head fits. One shift along the normals for each group corrects that: a
    Gauss-Newton step of one unknown, gradient `sum f n.g` and curvature `sum f n^T M n` with the rigidity f.

    Args:
        groups: of the Gaussians, numbered from 0.
        rigidity: of the Gaussians.
    """

    def __init__(self, groups: Int64[Tensor, " N"], rigidity: Float32[Tensor, " N"]) -> None:
        N, G = len(groups), int(groups.max()) + 1 if len(groups) else 0
        self.groups, self.rigidity = groups, rigidity
        self.gradient, self.mass = torch.zeros(N, 3), torch.zeros(N)
        self.depth_gradient = torch.zeros(G, dtype=torch.float64)
        self.depth_curvature = torch.zeros(G, dtype=torch.float64)

    def add(self, linear: Linearization) -> None:
        """Add the views of a frame to the sums."""
        self.gradient += linear.color_gradient
        self.mass += linear.color_mass
        # Project gradient and curvature of the centres on the normals, and sum over each group.
        normals, rigid = linear.normals, self.rigidity
        gradient = rigid * (normals * linear.mean_gradient).sum(-1)
        curvature = rigid * (normals * (linear.curvature @ normals[..., None])[..., 0]).sum(-1)
        self.depth_gradient.index_add_(0, self.groups, gradient.double())
        self.depth_curvature.index_add_(0, self.groups, curvature.double())

    def sums(self) -> dict[str, np.ndarray]:
        """Return the sums as arrays by name."""
        return {name: getattr(self, name).numpy() for name in _APPEARANCE}

    def add_sums(self, sums: Mapping[str, np.ndarray]) -> None:
        """Add what another update has summed."""
        for name in _APPEARANCE:
            getattr(self, name).add_(torch.from_numpy(sums[name]))

    def stepped(self, gaussians: BoundGaussians, frames: int) -> BoundGaussians:
        """Return the Gaussians after one step of colours and depths; Gaussians that no pixel shows keep their colour.

        Args:
            gaussians: of which the sums were taken.
            frames: number of frames in the sums; it scales the prior of the depths.
        """
        least_mass = 1e-6  # share of the mean mass below which no pixel shows a Gaussian
        depth_sigma, deepest, highest = 0.003, -0.012, 0.002  # metres: prior of a depth and its bounds along the normal
        # Step of the colours: mean residual of each Gaussian's pixels.
        seen = self.mass > least_mass * self.mass.mean()
        step = torch.where(seen[:, None], self.gradient / torch.where(seen, self.mass, 1.0)[:, None], 0.0)
        # Gauss-Newton step of the depths with a Gaussian prior about 0.
        prior = frames / depth_sigma**2
        # The current depth of each group: all its Gaussians have the same, so any of them gives it.
        depth = torch.zeros_like(self.depth_gradient).index_copy_(0, self.groups, gaussians.normal_offset.double())
        depth = depth - (self.depth_gradient + prior * depth) / (self.depth_curvature + prior)
        depth = depth.clamp(deepest, highest)
        return replace(gaussians, dc=(gaussians.dc - step).clamp(0.0, 1.0), normal_offset=depth[self.groups].float())


_APPEARANCE = ("gradient", "mass", "depth_gradient", "depth_curvature")


CameraEquations = tuple[Float64[np.ndarray, " 6"], Float64[np.ndarray, "6 6"]]
"""Gradient and Gauss-Newton matrix of a camera's correction."""


class CameraCorrections:
    """A rigid transform of the world for each camera, `cam_from_world <- cam_from_world X_c`; intrinsics stay.

    The gauge is fixed by a zero mean of the corrections: otherwise person and cameras could drift together. Rotations
    are about `center`, so that the translation of a correction is the shift of the person.

    Args:
        names: of the cameras.
        center: of the person, metres.
        config: standard deviations of rotation and translation.

    Attributes:
        motions: (C, 6) rotation vectors, radians, and translations, metres.
    """

    def __init__(self, names: Sequence[str], center: Float64[np.ndarray, " 3"], config: RefineConfig) -> None:
        self.names, self.center, self.config = tuple(names), center, config
        self.motions: Float64[np.ndarray, "C 6"] = np.zeros((len(self.names), 6))
        self.clear()

    def matrix(self, name: str) -> Float64[np.ndarray, "4 4"]:
        """Return X of a camera as a matrix."""
        motion = self.motions[self.names.index(name)]
        # x -> R (x - c) + c + t: the rotation leaves the centre in place.
        out = np.eye(4)
        out[:3, :3] = matrix_from_rotvec(motion[:3])
        out[:3, 3] = self.center - out[:3, :3] @ self.center + motion[3:]
        return out

    def corrected(self, view: View) -> View:
        """Return the view with the corrected pose of its camera."""
        camera = view.camera
        return replace(view, camera=replace(camera, cam_from_world=camera.cam_from_world @ self.matrix(view.name)))

    def normal_equations(self, linear: Linearization, rigidity: Float32[Tensor, " N"]) -> dict[str, CameraEquations]:
        """Return the normal equations of the cameras from the views of a frame, `J = [-[x - center]_x, I]`.

        The bits of their products depend on the number of threads, so that each frame's thread computes its own.
        """
        # Jacobian of a point by a rigid motion about the centre: rotation -[x - c]_x, translation I.
        arm = linear.means - torch.tensor(self.center, dtype=torch.float32)
        zero = torch.zeros_like(arm[:, 0])
        x, y, z = arm.unbind(-1)
        turned = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], dim=-1).view(-1, 3, 3)
        J = torch.cat([turned, torch.eye(3).expand(len(arm), 3, 3)], dim=-1)
        out = {}
        for name, (mean_gradient, own) in linear.cameras.items():
            # J^T g and J^T M J, summed over the Gaussians with their rigidity.
            gradient = torch.einsum("nij,ni,n->j", J, mean_gradient, rigidity).double().numpy()
            moved = (own * rigidity[:, None, None]) @ J
            out[name] = gradient, (J.reshape(-1, 6).T @ moved.reshape(-1, 6)).double().numpy()
        return out

    def add(self, equations: Mapping[str, CameraEquations]) -> None:
        """Add the normal equations of a frame."""
        for name, (gradient, curvature) in equations.items():
            row = self.names.index(name)
            self._sums[0][row] += gradient
            self._sums[1][row] += curvature

    def sums(self) -> dict[str, np.ndarray]:
        """Return the normal equations that were summed, as arrays by name."""
        gradient, curvature = self._sums
        return {"camera_gradient": gradient.copy(), "camera_curvature": curvature.copy()}

    def add_sums(self, sums: Mapping[str, np.ndarray]) -> None:
        """Add normal equations of other frames."""
        gradient, curvature = self._sums
        gradient += sums["camera_gradient"]
        curvature += sums["camera_curvature"]

    def clear(self) -> None:
        """Begin the sums of a pass."""
        self._sums = np.zeros((len(self.names), 6)), np.zeros((len(self.names), 6, 6))

    def step(self) -> None:
        """Take one Gauss-Newton step of all cameras, with a Gaussian prior about no correction."""
        gradient, curvature = self._sums
        # Prior: Gaussian about no correction.
        sigma = np.repeat([np.radians(self.config.camera_rotation_sigma), self.config.camera_translation_sigma], [3, 3])
        prior = np.diag(1.0 / sigma**2)
        for row in range(len(self.names)):
            # Damped by the prior alone: (J^T M J + 1 / sigma^2) step = -(J^T g + motion / sigma^2).
            right = gradient[row] + self.motions[row] / sigma**2
            self.motions[row] -= np.linalg.solve(curvature[row] + prior, right)
        self.motions -= self.motions.mean(axis=0)  # the gauge

    def poses(self, cam_from_world: Mapping[str, Float64[np.ndarray, "4 4"]]) -> dict[str, Float64[np.ndarray, "4 4"]]:
        """Return the corrected `cam_from_world` of all cameras by name."""
        return {name: cam_from_world[name] @ self.matrix(name) for name in self.names}


class Photographs:
    """Photographs of frames at the sizes of the levels, with the current corrections of the cameras.

    Args:
        views: returns those of a frame at full size.
        corrections: of the cameras; None: they are taken as exact.
        most: bytes of photographs that are kept.
    """

    def __init__(self, views: Views, corrections: CameraCorrections | None, *, most: int = 1 << 30) -> None:
        self._views, self._corrections, self._most = views, corrections, most
        self._kept, self._bytes = dict[tuple[int, int], list[View]](), 0
        self._reading = threading.Lock()

    def of(self, frame: int, halvings: int) -> list[View]:
        """Return the views of a frame, halved so often."""
        key = frame, halvings
        with self._reading:
            views = self._kept.get(key, [])
            if key not in self._kept:
                views = list(self._views(frame))
                for _ in range(halvings):
                    views = [view.halved() for view in views]
                # Kept until the bound, then all are dropped: passes read the frames in one order, so that dropping
                # the oldest alone would save nothing.
                self._bytes += sum(view.foreground.numel() + view.alpha.numel() for view in views)
                if self._bytes > self._most:
                    self._kept, self._bytes = {}, 0
                self._kept[key] = views
        # Corrections change after each pass, so that what is kept has none.
        return views if self._corrections is None else [self._corrections.corrected(view) for view in views]
