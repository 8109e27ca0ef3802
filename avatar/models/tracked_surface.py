"""Tracked surfaces: control points that interpolate displacements to a template, their values, normals of clothes."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import igl
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from avatar.data.byte_cache import ByteCache
from avatar.data.sequence import AvatarSequence
from avatar.data.views import View
from avatar.gaussians import BoundGaussians, triangle_frames, view_colors, world_from_frames
from avatar.models.learned_gaussians import LearnedGaussians
from avatar.models.networks.control_points import template_control_points
from avatar.models.networks.sparse_lookups import SparseRows
from avatar.rig.rig import Pose, PosedAvatar, Rig
from smplxpp.core import TriangleMesh
from smplxpp.core.errors import one_line
from smplxpp.raster import rasterize_mesh
from smplxpp.template.template import Template


class ControlCage(nn.Module):
    """Interpolates displacements of K control points of a template to its vertices, part by part.

    Args:
        rig: of the template.
        count: K, at most.

    Attributes:
        vertices: (K,) vertices of the template that are the control points.
        off_clothes: (K,) whether a control point lies on body, hair or shoes.
        from_body: (K,) distance of control points from the naked body in the T-pose, metres.
        edges: (E, 2) pairs of neighbouring control points.
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
        # Interpolation as a sparse matrix (V, K).
        weights = torch.tensor(control.weights, dtype=torch.float32, device=rig.device)
        self.rows = SparseRows(neighbours, weights, self.count)
        self.register_buffer("vertices", torch.tensor(control.vertices, device=rig.device))
        self.register_buffer("off_clothes", ~rig.cloth_mask[torch.as_tensor(control.vertices, device=rig.device)])
        self.register_buffer("from_body", torch.tensor(_from_body(rig.template, control.vertices), device=rig.device))
        # Edges join two control points that are the two nearest of some vertex.
        pairs = neighbours[:, :2].sort(dim=1).values
        self.register_buffer("edges", torch.unique(pairs[pairs[:, 0] != pairs[:, 1]], dim=0))

    def forward(self, controls: Float[Tensor, "K C"]) -> Float[Tensor, "V C"]:
        """Interpolate displacements, metres, or other values, from control points to vertices."""
        return self.rows(controls)

    def roughness(self, controls: Float[Tensor, "K 3"]) -> Float[Tensor, ""]:
        """Return the mean squared difference of neighbouring control points, m^2: a membrane energy."""
        return (controls[self.edges[:, 0]] - controls[self.edges[:, 1]]).square().sum(-1).mean()

    def looseness(self, reach: float) -> Float[Tensor, " K"]:
        """Return how free of the skin control points are: their distance from the naked body over `reach`, at most 1.

        Args:
            reach: metres; 0: all are free.
        """
        return (self.from_body / reach).clamp(max=1.0) if reach > 0.0 else torch.ones_like(self.from_body)

    def motion_off_clothes(self, controls: Float[Tensor, "K 3"], *, reach: float = 0.0) -> Float[Tensor, ""]:
        """Return the mean displacement from skinning of control points off the clothes, metres; 0 without any.

        Body, hair and shoes have the pseudo-Huber penalty `m = sqrt(|d|^2 + e^2) - e`, linear above e = 1 mm. Clothes
        within `reach` of the skin add the saturating penalty `S m / (S + m)`, S = 5 mm, weighted by `1 - distance /
        reach`. It holds a shirt on the skin, and costs a skirt that lies on the thighs in the T-pose little more than
        S when it swings.

        Args:
            controls: displacements d, metres.
            reach: distance from the naked body within which clothes count, metres; 0: none does.
        """
        rounding, saturation = 1e-3, 5e-3  # metres: e and S
        count = max(int(self.off_clothes.sum()), 1)
        # Pseudo-Huber of the length: quadratic below e, so that its gradient at 0 exists, linear above.
        moved = (controls.square().sum(-1) + rounding**2).sqrt() - rounding
        total = moved[self.off_clothes].sum() / count
        if reach > 0.0:
            # Weight of each control point: 1 on clothes at the skin, 0 from `reach` on, and 0 off the clothes.
            tight = (~self.off_clothes).float() * (1.0 - self.looseness(reach))
            total = total + (tight * saturation * moved / (saturation + moved)).sum() / count
        return total


def _from_body(template: Template, vertices: np.ndarray) -> np.ndarray:
    """Return the distance (K,) of vertices from the naked body in the T-pose, metres, float32."""
    body = template.part_mesh("body")
    points = template.vertices[vertices]
    return np.sqrt(igl.point_mesh_squared_distance(points, body.vertices, body.faces)[0]).astype(np.float32)


class TrackedAvatar(nn.Module):
    """Gaussians on a mesh that control points displace, one frame at a time (an `AvatarModel`).

    Args:
        rig: of the template.
        gaussians: on the template; they stay fixed.
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
        """Displacements (K, 3), metres, in the frame that is being tracked."""
        moves = ~rig.body_mask if still_body and not rig.body_mask.all() else torch.ones_like(rig.body_mask)
        self.register_buffer("moves", moves[self.cage.vertices, None].float(), persistent=False)
        self.to(rig.device)

    def forward(self, pose: Pose, camera_centers: Float[Tensor, "C 3"]) -> PosedAvatar:
        """Pose the avatar with the current displacements of its control points."""
        # Zero the still control points before interpolation; a skinned mesh then carries the Gaussians.
        return self.displaced(pose, camera_centers, self.moves * self.controls)

    def displaced(
        self, pose: Pose, camera_centers: Float[Tensor, "C 3"], controls: Float[Tensor, "K 3"]
    ) -> PosedAvatar:
        """Pose the avatar with given displacements of its control points, metres."""
        displacements = self.cage(controls)
        vertices = self.rig.skin(pose, displacements)
        frames = triangle_frames(vertices, self.rig.faces)
        bound = self.gaussians()
        world = world_from_frames(bound, frames)
        # Viewing directions are constants: a colour's gradient must not move its Gaussian.
        colors = view_colors(bound, frames, world.means.detach(), camera_centers)
        return PosedAvatar(vertices, world, colors, bound, displacements)


@dataclass(frozen=True, eq=False)
class Track:
    """A surface tracked through T frames.

    Attributes:
        row: row of the controls, by frame.
        controls: displacements of control points, metres; 0 in the reference frame.
        cage: interpolates control points to vertices.
        sigma: expected error of the control points, metres; None: unknown.
        drift: round-trip error of the control points, metres; None: not measured.
    """

    row: dict[int, int]
    controls: Float[Tensor, "T K 3"]
    cage: ControlCage
    sigma: Float[Tensor, "T K"] | None = None
    drift: Float[Tensor, " K"] | None = None

    __repr__ = one_line

    def on(self, cage: ControlCage) -> Track:
        """Return the surface with the control points of another cage, which take over what is at their vertices."""
        at = cage.vertices
        controls = torch.stack([self.cage(own)[at] for own in self.controls])
        sigma = None if self.sigma is None else torch.stack([self.cage(own[:, None])[at, 0] for own in self.sigma])
        drift = None if self.drift is None else self.cage(self.drift[:, None])[at, 0]
        return Track(self.row, controls, cage, sigma, drift)

    def displacements(self, frame: int) -> Float[Tensor, "V 3"]:
        """Return the displacements of all vertices in a frame, metres along the axes of the T-pose."""
        return self.cage(self.controls[self.row[frame]])

    def expected_error(self, frame: int) -> Float[Tensor, " V"]:
        """Return the expected error of the vertices in a frame, metres; 0 if it is unknown."""
        # One column (K, 1), interpolated to the vertices like a displacement.
        sigma = (
            torch.zeros_like(self.controls[0, :, :1]) if self.sigma is None else self.sigma[self.row[frame], :, None]
        )
        return self.cage(sigma)[:, 0]

    def confidence(self, frame: int) -> Float[Tensor, " V"]:
        """Return the weight of a frame's vertices as training data, in (0, 1]: `1 / (1 + (e / 1 cm)^2)`."""
        half_error = 1e-2  # metres of expected error at which a vertex has half the weight
        return 1.0 / (1.0 + (self.expected_error(frame) / half_error).square())

    def errors_of_clothes(self) -> dict[str, float]:
        """Return mean `expected_error` and `drift`, metres, of control points on clothes, or of all without clothes."""
        clothes = ~self.cage.off_clothes
        clothes = clothes if bool(clothes.any()) else ~clothes
        values = {"expected_error": self.sigma, "drift": self.drift}
        return {name: float(value[..., clothes].mean()) for name, value in values.items() if value is not None}


class SurfaceNormals:
    """Draws normals of tracked clothes into training views: `(view, frame) -> view` with a normal map.

    Hair and skin have no normals here, because the tracked surface is smoother than hair, and heads are drawn better
    without. The normals are estimates from photographs, masks and parameters alone.

    Args:
        sequence: the training sequence of the tracked template.
        track: the tracked surface.
        parts: names of the parts that get normals; None: all clothes.
    """

    def __init__(self, sequence: AvatarSequence, track: Track, parts: Collection[str] | None = None) -> None:
        self.sequence, self.track = sequence, track
        # Faces of the chosen parts; the first array makes the union defined without any part.
        template = sequence.rig.template
        parts = template.cloth_parts if parts is None else parts
        shown = [template.part_faces(name) for name in template.part_names if name in parts]
        self._faces = np.any([np.zeros(len(template.faces), dtype=bool), *shown], axis=0)
        self._meshes: dict[int, TriangleMesh] = {}
        self._maps = ByteCache(1 << 28)  # bytes, 256 MiB; a map of 250 x 100 pixels has 150 kB

    def __call__(self, view: View, frame: int) -> View:
        """Return the view with normals on clothes inside the mask; unchanged in frames that were not tracked."""
        if frame not in self.track.row:
            return view
        key = (frame, view.name, view.camera.width, view.camera.height)
        (normals,) = self._maps.get(key, lambda: (self._draw(view, frame),))
        return replace(view, normals=normals.to(view.alpha.device))

    def _draw(self, view: View, frame: int) -> Tensor:
        """Return the normal map of a view, unit vectors in the world or 0, float16."""
        # Interpolate vertex normals over the visible faces of the chosen parts.
        mesh = self._mesh(frame)
        seen = rasterize_mesh(mesh, view.camera)
        normals = seen.interpolate(mesh.faces, mesh.vertex_normals)
        normals[~(seen.mask & self._faces[seen.face_id])] = 0.0
        # Normalise, and drop pixels that the mask gives to the background.
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        unit = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
        unit[view.alpha.cpu().numpy() < 128] = 0.0  # opacity below a half, of 255
        return torch.tensor(unit, dtype=torch.float16)

    def _mesh(self, frame: int) -> TriangleMesh:
        """Return the tracked surface of a frame; only the last is cached, because a frame's views are consecutive."""
        if frame not in self._meshes:
            rig = self.sequence.rig
            with torch.no_grad():
                vertices = rig.skin(self.sequence.pose(frame), self.track.displacements(frame))
            self._meshes = {frame: TriangleMesh(vertices.double().cpu().numpy(), rig.template.faces)}
        return self._meshes[frame]
