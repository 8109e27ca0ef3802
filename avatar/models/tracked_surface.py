"""Surfaces followed through a sequence: displacements of control points, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.gaussians.binding import BoundGaussians, world_from_frames
from avatar.gaussians.frames import triangle_frames
from avatar.gaussians.spherical_harmonics import view_colors
from avatar.models.learned_gaussians import LearnedGaussians
from avatar.models.networks.control_points import template_control_points
from avatar.models.networks.sparse_rows import SparseRows
from avatar.rig.posed import PosedAvatar
from avatar.rig.rig import Pose, Rig
from smplxpp.template.template import Template

HALF = 1e-2
"""Metres of expected error at which a vertex counts half."""
STILL = 1e-3
"""Metres: motion off the clothes much below this costs nearly nothing."""
SWINGS = 5e-3
"""Metres of motion at which clothes near the skin are half believed to hang there no longer: more costs little more."""


class ControlCage(nn.Module):
    """Interpolates displacements of K control points of a template to its vertices, part by part.

    Args:
        rig: that of the template. count: K.

    Attributes:
        vertices: (K,) of the template, those that the control points are.
    """

    vertices: Tensor
    off_clothes: Tensor
    from_body: Tensor
    edges: Tensor

    def __init__(self, rig: Rig, count: int) -> None:
        super().__init__()
        control = template_control_points(rig.template, count)
        neighbours = torch.tensor(control.neighbours, device=rig.device)
        self.count = len(control.vertices)
        weights = torch.tensor(control.weights, dtype=torch.float32, device=rig.device)
        self.rows = SparseRows(neighbours, weights, self.count)
        self.register_buffer("vertices", torch.tensor(control.vertices, device=rig.device))
        self.register_buffer("off_clothes", ~rig.cloth_mask[torch.as_tensor(control.vertices, device=rig.device)])
        self.register_buffer("from_body", torch.tensor(_from_body(rig.template, control.vertices), device=rig.device))
        # Two control points are neighbours if some vertex has them as its two nearest.
        pairs = neighbours[:, :2].sort(dim=1).values
        self.register_buffer("edges", torch.unique(pairs[pairs[:, 0] != pairs[:, 1]], dim=0))

    def forward(self, controls: Float[Tensor, "K C"]) -> Float[Tensor, "V C"]:
        """Return the displacements of the vertices, metres, or other values, from those of the control points."""
        return self.rows(controls)

    def roughness(self, controls: Float[Tensor, "K 3"]) -> Float[Tensor, ""]:
        """Return the mean squared difference of neighbours, square metres."""
        return (controls[self.edges[:, 0]] - controls[self.edges[:, 1]]).square().sum(-1).mean()

    def motion_off_clothes(self, controls: Float[Tensor, "K 3"], *, reach: float = 0.0) -> Float[Tensor, ""]:
        """Return by how many metres, on average, points of body, hair and shoes leave skinning; 0 without any.

        Args:
            reach: metres. Points of the clothes count too, on the skin as much as the body's, less with the distance
                from it and not at all beyond; 0: none does. Their d counts as `d S / (S + d)`, `S = SWINGS`: a shirt is
                held, and a skirt that lies on the thighs in the T-pose is let go as soon as it swings.
        """
        count = max(int(self.off_clothes.sum()), 1)
        moved = (controls.square().sum(-1) + STILL**2).sqrt() - STILL
        total = moved[self.off_clothes].sum() / count
        if reach > 0.0:
            tight = (~self.off_clothes).float() * (1.0 - self.from_body / reach).clamp(min=0.0)
            total = total + (tight * SWINGS * moved / (SWINGS + moved)).sum() / count
        return total


def _from_body(template: Template, vertices: np.ndarray) -> np.ndarray:
    """(K,) float32 distance of vertices from the naked body in the T-pose, metres."""
    body = template.part_mesh("body")
    points = template.vertices[vertices]
    return np.sqrt(igl.point_mesh_squared_distance(points, body.vertices, body.faces)[0]).astype(np.float32)


class TrackedAvatar(nn.Module):
    """Gaussians on a mesh that control points move in one frame at a time (an `AvatarModel`).

    Args:
        rig: that of the template. gaussians: those on it; they stay as they are.
        count: number of control points.
        still_body: control points on the body do not move. Not applied to a template that is a body alone.
    """

    moves: Tensor

    def __init__(self, rig: Rig, gaussians: BoundGaussians, count: int, *, still_body: bool = False) -> None:
        super().__init__()
        self.rig = rig
        self.gaussians = LearnedGaussians(gaussians)
        self.cage = ControlCage(rig, count)
        self.controls = nn.Parameter(torch.zeros(self.cage.count, 3))
        """Displacements (K, 3), metres, in the frame that is being followed."""
        moves = ~rig.body_mask if still_body and not rig.body_mask.all() else torch.ones_like(rig.body_mask)
        self.register_buffer("moves", moves[self.cage.vertices, None].float(), persistent=False)
        self.to(rig.device)

    def forward(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> PosedAvatar:
        """Pose the avatar, displaced by the control points as they stand."""
        displacements = self.cage(self.moves * self.controls)
        vertices = self.rig.skin(pose, displacements)
        frames = triangle_frames(vertices, self.rig.faces)
        bound = self.gaussians()
        world = world_from_frames(bound, frames)
        colors = view_colors(bound, frames, world.means.detach(), camera_centers)
        return PosedAvatar(vertices, world, colors, bound, displacements)


@dataclass(frozen=True, eq=False)
class Track:
    """A surface followed through frames.

    Attributes:
        row: each frame's row of the controls. cage: interpolates them.
        controls: metres, 0 in a frame whose surface the template is.
        sigma: distance of the control points from the truth that is to be expected, metres; None: nobody knows.
        drift: of the control points: how far from its start a way back ended, metres; None: nobody went back.
    """

    row: dict[int, int]
    controls: Float[Tensor, "T K 3"]
    cage: ControlCage
    sigma: Float[Tensor, "T K"] | None = None
    drift: Float[Tensor, " K"] | None = None

    def displacements(self, frame: int) -> Float[Tensor, "V 3"]:
        """Return the displacements of a frame, metres along the axes of the T-pose."""
        return self.cage(self.controls[self.row[frame]])

    def expected_error(self, frame: int) -> Float[Tensor, " V"]:
        """Return how far from the truth the vertices of a frame are to be expected, metres; 0 where nobody knows."""
        sigma = (
            torch.zeros_like(self.controls[0, :, :1]) if self.sigma is None else self.sigma[self.row[frame], :, None]
        )
        return self.cage(sigma)[:, 0]

    def confidence(self, frame: int) -> Float[Tensor, " V"]:
        """Return in (0, 1] how much a frame's vertices count in what learns from them: `1 / (1 + (e / HALF)^2)`."""
        return 1.0 / (1.0 + (self.expected_error(frame) / HALF).square())

    def errors_of_clothes(self) -> dict[str, float]:
        """Return the mean `expected_error` and `drift`, metres, of control points on clothes, of all where none are."""
        clothes = ~self.cage.off_clothes
        clothes = clothes if bool(clothes.any()) else ~clothes
        told = {"expected_error": self.sigma, "drift": self.drift}
        return {name: float(value[..., clothes].mean()) for name, value in told.items() if value is not None}
