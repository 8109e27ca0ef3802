"""Textured mesh: the template with a learned texture and a learned deformation; no Gaussian leaves the surface.

The kind of MeshAvatar (Chen et al. 2024): an animatable mesh with a texture that photographs teach. Theirs extracts
the mesh from a signed distance field, has physical materials, and is drawn by nvdiffrast; here the mesh is the
template, the texture is plain colour, and a texel is one flat opaque splat fixed to its triangle, so that all rows
share one rasteriser. Splats overlap their neighbours by a little more than half: the surface is closed, its silhouette
smooth, and gradients reach the mesh through silhouettes too, which a z-buffer's (`avatar.rendering.mesh_maps`) do not.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from avatar.baselines.avatar_base import Baseline
from avatar.gaussians.binding import BoundGaussians, corner_weights
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.learned_gaussians import LearnedGaussians
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Pose, PosedAvatar, Rig
from avatar.training.engine.adam import LearningRates, ParameterGroup

OPACITY = 0.99


@dataclass(frozen=True)
class TexturedMeshConfig:
    """Choices of a textured mesh: its displacement field and its texels.

    Attributes:
        field: displacement field of the mesh.
        sampling: of the texels; its opacity and view dependence are ignored.
    """

    field: FieldConfig = dataclasses.field(default_factory=FieldConfig)
    sampling: SamplingConfig = dataclasses.field(default_factory=SamplingConfig)


class TexturedMeshAvatar(Baseline):
    """A student without blend shapes whose Gaussians are texels: only their colours learn.

    Args:
        config: sizes.
        rig: of the template.
        gaussians: each texel starts with the colour of the nearest one.
        frames: frames with a code.
    """

    def __init__(self, config: TexturedMeshConfig, rig: Rig, gaussians: BoundGaussians, frames: Sequence[int]) -> None:
        super().__init__()
        self.config, self.rig = config, rig
        # Texels are opaque and have one colour (degree 0); each starts with the colour of the nearest fitted Gaussian.
        texels = sample_on_mesh(rig.template, replace(config.sampling, opacity=OPACITY, sh_degree=0))
        texels = replace(texels.to(device=rig.device), dc=_nearest_colors(rig, texels, gaussians))
        self.student = Student(StudentConfig(field=config.field), rig, texels, tuple(frames))

    @property
    def gaussians(self) -> LearnedGaussians:  # type: ignore[override]  # a part of the student here
        """Return the texels of the texture, as Gaussians."""
        return self.student.gaussians

    def forward(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> PosedAvatar:
        """Pose the mesh as cameras with these centres, metres, see it."""
        return self.student(pose, camera_centers)

    def groups(self, lr: float, lr_final_factor: float) -> list[ParameterGroup]:
        """Return field, codes and texture as a group each."""
        field, codes = self.student.field, self.student.codes
        assert field is not None and codes is not None  # the configuration has a field
        return [
            ParameterGroup("field", dict(field.named_parameters()), lr, lr_final_factor),
            ParameterGroup("codes", {"codes": codes.codes}, lr, lr_final_factor),
            ParameterGroup("texture", {"dc": self.gaussians.dc}, LearningRates().dc, lr_final_factor),
        ]


def _nearest_colors(rig: Rig, texels: BoundGaussians, gaussians: BoundGaussians) -> Tensor:
    """Return the (N, 3) colours of the nearest Gaussians in the T-pose."""
    # Both sets of Gaussians are compared by their points on the same template in the T-pose, metres.
    triangles = rig.template.mesh.triangles

    def places(bound: BoundGaussians) -> np.ndarray:
        weights = corner_weights(bound.barycentric).double().cpu().numpy()
        return (weights[..., None] * triangles[bound.face_index.cpu().numpy()]).sum(axis=1)

    nearest = cKDTree(places(gaussians)).query(places(texels))[1]
    return gaussians.dc[torch.tensor(nearest, device=gaussians.dc.device)].to(rig.device)
