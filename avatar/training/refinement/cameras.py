"""Small errors of the training cameras' poses, corrected together with the poses of the person."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float32, Float64
from torch import Tensor

from avatar.data.views import View
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.evidence import Evidence
from smplxpp.core.rotations import matrix_from_rotvec


class CameraCorrections:
    """A rigid motion of the world for each camera, `cam_from_world <- cam_from_world X_c`, intrinsics kept.

    The gauge is fixed: the mean of the motions is zero, or person and cameras could wander off together. Motions turn
    about `center`, so that their shift is that of the person.

    Args:
        names: of the cameras. center: of the person, metres.
    """

    def __init__(self, names: Sequence[str], center: Float64[np.ndarray, " 3"], config: RefineConfig) -> None:
        self.names, self.center, self.config = tuple(names), center, config
        self.motions: Float64[np.ndarray, "C 6"] = np.zeros((len(self.names), 6))
        self._sums = np.zeros((len(self.names), 6)), np.zeros((len(self.names), 6, 6))

    def matrix(self, name: str) -> Float64[np.ndarray, "4 4"]:
        """X of a camera."""
        motion = self.motions[self.names.index(name)]
        out = np.eye(4)
        out[:3, :3] = matrix_from_rotvec(motion[:3])
        out[:3, 3] = self.center - out[:3, :3] @ self.center + motion[3:]
        return out

    def corrected(self, view: View) -> View:
        """The view through its corrected camera."""
        camera = view.camera
        return replace(view, camera=replace(camera, cam_from_world=camera.cam_from_world @ self.matrix(view.name)))

    def add(self, evidence: Evidence, firmness: Float32[Tensor, " N"]) -> None:
        """Take the views of a frame in."""
        gradient, curvature = self._sums
        arm = evidence.means - torch.tensor(self.center, dtype=torch.float32)
        zero = torch.zeros_like(arm[:, 0])
        x, y, z = arm.unbind(-1)
        turned = torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], dim=-1).view(-1, 3, 3)
        J = torch.cat([turned, torch.eye(3).expand(len(arm), 3, 3)], dim=-1)
        for name, (pull, own) in evidence.cameras.items():
            row = self.names.index(name)
            gradient[row] += torch.einsum("nij,ni,n->j", J, pull, firmness).double().numpy()
            moved = (own * firmness[:, None, None]) @ J
            curvature[row] += (J.reshape(-1, 6).T @ moved.reshape(-1, 6)).double().numpy()

    def step(self) -> None:
        """Move all cameras by what was taken in since the last step."""
        gradient, curvature = self._sums
        self._sums = np.zeros_like(gradient), np.zeros_like(curvature)
        sigma = np.repeat([np.radians(self.config.camera_rotation_sigma), self.config.camera_translation_sigma], [3, 3])
        trust = np.diag(1.0 / sigma**2)
        for row in range(len(self.names)):
            right = gradient[row] + self.motions[row] / sigma**2
            self.motions[row] -= np.linalg.solve(curvature[row] + trust, right)
        self.motions -= self.motions.mean(axis=0)

    def poses(self, cam_from_world: Mapping[str, Float64[np.ndarray, "4 4"]]) -> dict[str, Float64[np.ndarray, "4 4"]]:
        """The corrected poses of cameras by name."""
        return {name: cam_from_world[name] @ self.matrix(name) for name in self.names}
