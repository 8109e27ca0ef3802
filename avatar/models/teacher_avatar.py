"""The teacher at work: position maps of a pose in, Gaussians with residuals out."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from avatar.gaussians import BoundGaussians, triangle_frames, view_colors, world_from_frames
from avatar.gaussians.binding import on_triangles
from avatar.models.learned_gaussians import LearnedGaussians
from avatar.models.networks.sparse_lookups import MapSampler
from avatar.models.networks.teacher import Residuals, Teacher, TeacherConfig, local_offsets
from avatar.models.tracked_surface import Track
from avatar.rendering.mesh_maps import MapFrame, front_back_maps, vertex_normals
from avatar.rig.rig import Pose, PosedAvatar, Rig

TRACK_ERRORS = ("sigma", "drift")
"""Optional attributes of a `Track` that are stored with a teacher."""
HALF_EXTENT = 1.0
"""Least distance from the centre of the canonical maps to their border, metres: holds most bodies in the T-pose."""


@dataclass(frozen=True, eq=False)
class TeacherMaps:
    """Inputs of the networks in a pose.

    Attributes:
        positions: posed coordinates relative to the root, metres; with `centred`, deviations from their mean in units
            of the standard deviation.
        cosines: between posed normals and the directions to C cameras; None: colours do not depend on the view.
    """

    positions: Float[Tensor, "1 2 S S 3"]
    cosines: Float[Tensor, "C 2 S S"] | None


class TeacherAvatar(nn.Module):
    """Template, Gaussians and teacher as one avatar (an `AvatarModel`).

    The mesh follows its joints alone; `du = R^T dU` and the other residuals are added to the Gaussians' local
    attributes, R the rotation of the triangle in the T-pose.

    Args:
        config: of the networks.
        rig: of the template.
        gaussians: bound to the template; their quaternions are normalised.
    """

    canonical_from_local: Tensor
    semantics: Tensor
    mean_positions: Tensor
    deviation: Tensor

    def __init__(self, config: TeacherConfig, rig: Rig, gaussians: BoundGaussians) -> None:
        super().__init__()
        gaussians.check_topology(rig.faces, "template of the teacher")
        self.config, self.rig = config, rig
        self.networks = Teacher(config)
        self.gaussians = LearnedGaussians(gaussians)
        self.gaussians.normalise_quats()

        self.frame = map_frame(rig)
        # Frames in the T-pose: their rotations turn residuals dU of the maps, in canonical axes, to the triangles'
        # axes.
        canonical = triangle_frames(rig.vertices, rig.faces)
        # Look the maps up at the Gaussians' places on their triangles. Offsets, which are learned, are left out, so
        # that one lookup serves the whole training.
        face = gaussians.face_index.to(rig.device)
        points = on_triangles(canonical.corners[face], gaussians.barycentric.to(rig.device))
        sides = assign_front_back(rig, self.frame, config.out_size, points, canonical.rotations[face, :, 0])
        self.sampler = MapSampler(self.frame, config.out_size, points, sides.front)
        # Maps of the inputs have their own size; semantic colours are an input that is the same in every pose.
        self.maps = front_back_maps(rig.vertices, rig.faces, self.frame, size=config.in_size)
        self.register_buffer("canonical_from_local", canonical.rotations[face], persistent=False)
        self.register_buffer("semantics", self.maps.interpolate(rig.semantic_colors)[None], persistent=False)
        if config.centred:
            self.register_buffer("mean_positions", torch.zeros(2, config.in_size, config.in_size, 3))
            self.register_buffer("deviation", torch.ones(()))
        self.track: Track | None = None
        self.to(rig.device)

    def remember(self, track: Track) -> None:
        """Keep the tracked surface of the training frames; it is saved with the teacher."""
        device = self.rig.device
        errors = {name: value.to(device) for name in TRACK_ERRORS if (value := getattr(track, name)) is not None}
        self.track = track = replace(track, controls=track.controls.to(device), **errors)
        frames = sorted(track.row, key=lambda frame: track.row[frame])
        self.register_buffer("track_frames", torch.tensor(frames, device=self.rig.device))
        self.register_buffer("track_controls", track.controls)
        for name in TRACK_ERRORS:
            self.register_buffer(f"track_{name}", errors.get(name))

    def centre(self, poses: Iterable[Pose]) -> None:
        """Set mean and standard deviation of the position maps over poses, if the configuration is `centred`."""
        least_deviation = 1e-3  # metres; it bounds the amplification of small differences between poses
        if not self.config.centred:
            return
        count = 0
        total = torch.zeros_like(self.mean_positions, dtype=torch.float64)
        squares = torch.zeros_like(total)
        # Variance as E[x^2] - E[x]^2 in float64, averaged over the pixels of the body and over x, y, z: one scale for
        # all,
        # so that directions are not distorted. The clamp removes negative rounding errors.
        for pose in poses:
            _, positions = self._root_positions(pose)
            count, total, squares = count + 1, total + positions.double(), squares + positions.double().square()
        mean = total / count
        variance = (squares / count - mean.square()).clamp(min=0.0)[self.maps.mask].mean()
        self.mean_positions.copy_(mean)
        self.deviation.copy_(variance.sqrt().clamp(min=least_deviation))

    @contextmanager
    def _exact(self) -> Iterator[None]:
        """Disable gradients and autocast: half precision would round positions in the world to millimetres."""
        with torch.no_grad(), torch.autocast(self.rig.device.type, enabled=False):
            yield

    def _root_positions(self, pose: Pose) -> tuple[Tensor, Tensor]:
        """Return the skinned vertices relative to the root, and their maps (2, S, S, 3), metres."""
        with self._exact():
            to_root = pose.root_from_world
            vertices = self.rig.skin(pose) @ to_root[:3, :3].T + to_root[:3, 3]
            return vertices, self.maps.interpolate(vertices)

    def position_input(self, pose: Pose) -> Float[Tensor, "1 2 S S 3"]:
        """Return the position maps of a pose as the networks' input, without gradients."""
        return self._standardised(self._root_positions(pose)[1])

    def _standardised(self, positions: Tensor) -> Tensor:
        return ((positions - self.mean_positions) / self.deviation if self.config.centred else positions)[None]

    def inputs(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> TeacherMaps:
        """Return all inputs of the networks for a pose and camera centres, metres, without gradients."""
        with self._exact():
            # Everything is relative to the root, so that the inputs do not depend on where the person stands or
            # faces.
            to_root = pose.root_from_world
            vertices, positions = self._root_positions(pose)
            if not self.config.sees_view:
                return TeacherMaps(self._standardised(positions), None)
            normals = self.maps.interpolate(vertex_normals(vertices, self.rig.faces))
            from_root = camera_centers @ to_root[:3, :3].T + to_root[:3, 3]
            # (C, 2, S, S): cosine of the angle between the posed normal and the direction to each camera, 0 off the
            # body.
            directions = F.normalize(from_root[:, None, None, None] - positions, dim=-1)
            cosines = (F.normalize(normals, dim=-1) * directions).sum(-1)
            return TeacherMaps(self._standardised(positions), cosines * self.maps.mask)

    def residual_maps(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> Residuals:
        """Return the maps of all residuals in a pose: (1, 2, R, R, ...), colour (C, 2, R, R, 3)."""
        maps = self.inputs(pose, camera_centers)
        return self.networks(maps.positions, self.semantics, maps.cosines)

    def displacement_maps(self, poses: Sequence[Pose]) -> Float[Tensor, "B 2 R R 3"]:
        """Return dU in B poses, metres; separate networks of other residuals do not run."""
        inputs = torch.cat([self.position_input(pose) for pose in poses])
        return self.config.position_scale * self.networks.positions(inputs, self.semantics)

    def forward(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> PosedAvatar:
        """Pose the teacher for cameras with these centres, metres."""
        return self.posed(pose, camera_centers, self.residual_maps(pose, camera_centers))

    def posed(self, pose: Pose, camera_centers: Float[Tensor, "C 3"], maps: Residuals) -> PosedAvatar:
        """Pose the teacher with given residual maps, as `forward` does with its own."""
        # Add the residuals at the Gaussians to their local attributes.
        residuals = maps.sampled(self.sampler)
        bound = self.gaussians()
        bound = replace(
            bound,
            offset=bound.offset + local_offsets(residuals.position[0], self.canonical_from_local),
            opacity_logits=bound.opacity_logits + residuals.opacity_logit[0],
            log_scales=bound.log_scales + residuals.log_scales[0],
            quats=bound.quats + residuals.quats[0],
        )
        # Skin the mesh without displacements, and carry the Gaussians on its triangles.
        vertices = self.rig.skin(pose)
        frames = triangle_frames(vertices, self.rig.faces)
        world = world_from_frames(bound, frames)
        # Viewing directions are constants: a colour's gradient must not move its Gaussian.
        means = world.means.detach()
        color = residuals.colour.expand(len(camera_centers), -1, -1)
        # Colours of each camera; its residual is added to dc before the clamp.
        colors = [
            view_colors(replace(bound, dc=bound.dc + color[c]), frames, means, camera_centers[c : c + 1])
            for c in range(len(camera_centers))
        ]
        return PosedAvatar(vertices, world, torch.cat(colors), bound)


def map_frame(rig: Rig) -> MapFrame:
    """Return the square of the canonical maps: 1 m to each side of the T-pose's centre, more for a larger body."""
    margin = 0.05  # metres; Gaussians may stand a little off the surface
    vertices = rig.template.vertices
    reach = float((vertices.max(axis=0) - vertices.min(axis=0))[:2].max() / 2.0)
    return MapFrame.of(vertices, half_extent=max(HALF_EXTENT, reach + margin))


@dataclass(frozen=True, eq=False)
class FrontBackAssignment:
    """Sides of P points on the canonical maps.

    Attributes:
        front: whether the front map's surface is the nearer one along z.
        behind: depth of the point below the surface on its side's map, metres; 0 where the map shows none.
    """

    front: Bool[Tensor, " P"]
    behind: Float[Tensor, " P"]


def assign_front_back(
    rig: Rig, frame: MapFrame, size: int, points: Float[Tensor, "P 3"], normals: Float[Tensor, "P 3"]
) -> FrontBackAssignment:
    """Choose the side of every point by its depth, not by its normal.

    The far side of a fold in front of a skirt faces backwards, but the back map at its place shows the back of the
    skirt, ten centimetres away, which moves differently. Where the maps show nothing, the normal decides.

    Args:
        rig: of the template.
        frame: of the maps.
        size: side of the maps, pixels.
        points: canonical, metres.
        normals: of the points.
    """
    maps = front_back_maps(rig.vertices, rig.faces, frame, size=size)
    shown = maps.mask.to(points.dtype)
    # Heights weighted by the mask, so that bilinear samples at its border can be divided by the mask's weight.
    table = torch.stack([maps.interpolate(rig.vertices)[..., 2] * shown, shown], dim=-1)[None]
    # Distance along z from every point to the surface on each map.
    distances, belows = [], []
    for is_front in (True, False):
        side = torch.full((len(points),), is_front, device=points.device)
        height, weight = MapSampler(frame, size, points, side)(table)[0].unbind(-1)
        # Height of the surface above the point: along +z on the front map, along -z on the back map.
        below = (height / weight.clamp(min=1e-6) - points[:, 2]) * (1.0 if is_front else -1.0)
        seen = weight > 1e-3
        # A map without a surface at the point is infinitely far, so that the other one wins.
        distances.append(below.abs().masked_fill(~seen, torch.inf))
        belows.append(below.masked_fill(~seen, 0.0))
    nothing = torch.isinf(distances[0]) & torch.isinf(distances[1])
    front = torch.where(nothing, normals[:, 2] >= 0, distances[0] <= distances[1])
    return FrontBackAssignment(front, torch.where(front, belows[0], belows[1]))
