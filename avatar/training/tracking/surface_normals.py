"""Normal maps of tracked clothes, for the normal term of the loss where a capture has no normal maps."""

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
from smplxpp.core import TriangleMesh
from smplxpp.raster import rasterize_mesh


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


def with_surface_normals(context: TaskContext, sequence: AvatarSequence, track: Track | None) -> TaskContext:
    """Return the context with normals of tracked clothes, if there is a track and the capture has no normal maps."""
    if track is None or sequence.normal_maps:
        return context
    return replace(context, surface=SurfaceNormals(sequence, track))
