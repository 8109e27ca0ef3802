"""A capture's photographs with one part repainted: other patterns on cloth that moves as it did.

The true surface says which pixels are the part's and which points of the cloth they show; the pattern is evaluated
there and lit by one lamp. The fit's Gaussians on the part get the same paint, as a fit to the repainted
photographs would give them.
"""

from __future__ import annotations

from dataclasses import replace

import igl
import numpy as np
import torch
from jaxtyping import Bool, Float

from avatar.data.sequence import AvatarSequence
from avatar.data.views import View
from avatar.gaussians.binding import BoundGaussians, world_from_local
from pipelines.synth.skirt_patterns import PATTERNS, around_and_along
from smplxpp.capture import Capture
from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster.zbuffer import rasterize_mesh
from smplxpp.template.template import Template

LAMP = np.array([0.35, 0.75, 0.56]) / np.linalg.norm([0.35, 0.75, 0.56])
AMBIENT = 0.6
NEAR = 5e-3
"""Metres from the template's part within which vertices of the true surface are the part's."""


class RepaintedSequence(AvatarSequence):
    """A capture with a part repainted.

    Args:
        capture: with true surfaces whose vertices are the same points in all frames. template: of the person.
        posed: the template's vertices in the `frame` that it was built from, metres.
        part: of the template. pattern: among the synthetic skirt's.
    """

    def __init__(
        self, capture: Capture, template: Template, *, posed: np.ndarray, frame: int, part: str, pattern: str
    ) -> None:
        super().__init__(capture, template)
        truth = capture.truth_mesh(frame)
        assert truth is not None  # the benchmark measures against it, and has looked
        own = np.unique(template.faces[template.part_faces(part)])
        self._posed, self._part, self._pattern = posed, part, PATTERNS[pattern]
        self._centre = posed[own].mean(axis=0)
        faces = template.part_faces(part)
        to_part, to_others = (
            igl.point_mesh_squared_distance(truth.vertices, posed, template.faces[of])[0] for of in (faces, ~faces)
        )
        of_part = (to_part < NEAR**2) & (to_part <= to_others)
        self._faces: Bool[np.ndarray, " F"] = of_part[truth.faces].all(axis=1)
        self._reference = truth.vertices
        self._painted: dict[tuple[str, int], View] = {}

    def gaussians(self, bound: BoundGaussians) -> BoundGaussians:
        """Return Gaussians of the fit in the new paint."""
        template = self.rig.template
        mesh = TriangleMesh(self._posed, template.faces)
        world = world_from_local(bound, torch.tensor(self._posed, dtype=torch.float32), self.rig.faces)
        faces = bound.face_index.numpy()
        rows = template.part_faces(self._part)[faces]
        colors = self._colors(world.means.double().numpy()[rows], mesh.face_normals[faces[rows]])
        dc, sh = bound.dc.clone(), bound.sh.clone()
        dc[rows], sh[rows] = torch.tensor(colors / 255.0, dtype=dc.dtype), 0.0
        return replace(bound, dc=dc, sh=sh)

    def view(self, camera: str, frame: int) -> View:
        """Return a training view, repainted, cut to the silhouette."""
        if (camera, frame) not in self._painted:
            self._painted[camera, frame] = self.repainted(super().view(camera, frame), frame)
        return self._painted[camera, frame]

    def whole_view(self, camera: str, frame: int) -> View:
        """Return all pixels of a view, repainted."""
        return self.repainted(super().whole_view(camera, frame), frame)

    def repainted(self, view: View, frame: int) -> View:
        """Return a view in the new paint."""
        truth = self.capture.truth_mesh(frame)
        assert truth is not None
        maps = rasterize_mesh(truth, view.camera)
        shown = maps.mask & self._faces[np.maximum(maps.face_id, 0)]
        points = maps.interpolate(truth.faces, self._reference)[shown]
        normals = truth.face_normals[maps.face_id[shown]]
        away = truth.vertices[truth.faces[maps.face_id[shown], 0]] - view.camera.position
        normals = np.where((normals * away).sum(axis=1, keepdims=True) > 0.0, -normals, normals)
        foreground = view.foreground.clone()
        opaque = view.opacity().numpy()[shown][:, None]
        foreground[torch.tensor(shown)] = torch.tensor((self._colors(points, normals) * opaque).astype(np.uint8))
        return replace(view, foreground=foreground)

    def _colors(self, points: Float[np.ndarray, "N 3"], normals: Float[np.ndarray, "N 3"]) -> np.ndarray:
        """(N, 3) lit colours of points of the reference frame."""
        shade = AMBIENT + (1.0 - AMBIENT) * np.maximum(normals @ LAMP, 0.0)
        return self._pattern(around_and_along(points - self._centre)) * shade[:, None]
