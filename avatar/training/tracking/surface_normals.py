"""Normals of clothes that were followed, for the normal term of the loss where a capture has no normal maps."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from avatar.data.byte_cache import ByteCache
from avatar.data.sequence import AvatarSequence
from avatar.data.views import View
from avatar.models.tracked_surface import Track
from avatar.training.engine.photometric_task import TaskContext
from smplxpp.core.labels import CLOTH_LABELS
from smplxpp.core.mesh import TriangleMesh
from smplxpp.raster import rasterize_mesh

KEPT_BYTES = 1 << 28
"""Bound of the maps that are kept; one of 250 x 100 pixels takes 150 kB."""
INSIDE = 128
"""Opacity, of 255, from which a pixel is the person's."""


class SurfaceNormals:
    """Draws followed clothes into training views: `(view, frame) -> view` with their normals.

    Hair and skin have none: what was followed is smoother than hair, and heads draw better without. Normals are
    estimated: nothing but photographs, masks and parameters has part in them.

    Args:
        sequence: whose template was followed. track: what was found.
        parts: of the template that are shown; None: clothes.
    """

    def __init__(self, sequence: AvatarSequence, track: Track, parts: Collection[str] | None = None) -> None:
        self.sequence, self.track = sequence, track
        template = sequence.rig.template
        parts = {label.name for label in CLOTH_LABELS} if parts is None else parts
        shown = [template.part_faces(name) for name in template.part_names if name in parts]
        self._faces = np.any([np.zeros(len(template.faces), dtype=bool), *shown], axis=0)
        self._meshes: dict[int, TriangleMesh] = {}
        self._maps = ByteCache(KEPT_BYTES)

    def __call__(self, view: View, frame: int) -> View:
        """Return the view with normals where clothes are and the mask says person; it as it is in other frames."""
        if frame not in self.track.row:
            return view
        key = (frame, view.name, view.camera.width, view.camera.height)
        (normals,) = self._maps.get(key, lambda: (self._draw(view, frame),))
        return replace(view, normals=normals.to(view.alpha.device))

    def _draw(self, view: View, frame: int) -> Tensor:
        mesh = self._mesh(frame)
        seen = rasterize_mesh(mesh, view.camera)
        normals = seen.interpolate(mesh.faces, mesh.vertex_normals)
        normals[~(seen.mask & self._faces[seen.face_id])] = 0.0
        length = np.linalg.norm(normals, axis=-1, keepdims=True)
        unit = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
        unit[view.alpha.cpu().numpy() < INSIDE] = 0.0
        return torch.tensor(unit, dtype=torch.float16)

    def _mesh(self, frame: int) -> TriangleMesh:
        """The surface of a frame; that of the last frame alone is kept, as a frame's views come together."""
        if frame not in self._meshes:
            rig = self.sequence.rig
            with torch.no_grad():
                vertices = rig.skin(self.sequence.pose(frame), self.track.displacements(frame))
            self._meshes = {frame: TriangleMesh(vertices.double().cpu().numpy(), rig.template.faces)}
        return self._meshes[frame]


def with_surface_normals(context: TaskContext, sequence: AvatarSequence, track: Track | None) -> TaskContext:
    """Return the context with normals of followed clothes, if a surface was followed and the capture has no maps."""
    if track is None or sequence.normal_maps:
        return context
    return replace(context, surface=SurfaceNormals(sequence, track))
