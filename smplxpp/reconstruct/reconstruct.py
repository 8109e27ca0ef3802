"""The surface of a person from photographs, cameras and masks of one moment, and where it is sure of it."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from smplxpp.core.errors import GeometryWarning, InputError, ProgressCallback, ignore_progress
from smplxpp.core.mesh import TriangleMesh
from smplxpp.reconstruct.colors import blend_colors
from smplxpp.reconstruct.config import ReconstructConfig
from smplxpp.reconstruct.hull import main_body, pixel_footprint, soft_hull, solid_status
from smplxpp.reconstruct.photographs import Pyramids, sight
from smplxpp.reconstruct.silhouettes import Silhouette, smallest_depths
from smplxpp.reconstruct.sweep import (
    PatchConfig,
    mean_of_neighbours,
    refine_surface,
    smooth_normals,
    sweep_scores,
    taubin,
)
from smplxpp.reconstruct.trust import Consensus, find_consensus
from smplxpp.reconstruct.views import PhotoView, check_spread, usable_views

_CELLS = (3e-3, 6e-3)
_CELL_PIXELS = 2.0
_LEAST_SEEN = 2
# Agreement of the photographs: none, and what is as sure as it gets.
_NO_AGREEMENT, _FULL_AGREEMENT = 0.1, 0.7


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A person's closed surface.

    Attributes:
        mesh: metres, +Y up; closed and manifold, checked with manifold3d.
        colors: sRGB a vertex.
        seen: cameras that see a vertex, none of them at a grazing angle.
        confidence: a vertex, from 0 (no photograph tells: seen by fewer than two cameras, or they show different
            things there, as over the air between the legs) to 1 (they show the same).
        hull: the silhouettes' surface before the photographs were compared.
        numbers: for reports: cell, footprint, views by name and why others were left out, genus, moved.
        problems: what was wrong with the inputs, or where the result is to be doubted, in words.
    """

    mesh: TriangleMesh
    colors: UInt8[np.ndarray, "N 3"]
    seen: Int64[np.ndarray, " N"]
    confidence: Float32[np.ndarray, " N"]
    hull: TriangleMesh
    numbers: dict[str, Any]
    problems: tuple[str, ...]

    @property
    def unseen(self) -> float:
        """Share of the surface that fewer than two cameras see."""
        return _share_of_area(self.mesh, self.seen < _LEAST_SEEN)


def reconstruct(
    views: Sequence[PhotoView],
    config: ReconstructConfig | None = None,
    *,
    progress: ProgressCallback = ignore_progress,
) -> Reconstruction:
    """Reconstruct one moment: consensus of the masks, soft visual hull, gated sweep along the normals, colours.

    Masks that the others contradict are left out and named, in `problems` and as a `GeometryWarning`.

    Args:
        views: of one moment, at least four, from all around; photographs with the person's opacity.

    Raises:
        InputError: too few views, all from one side, masks of nothing or of the background, masks that contradict each
            other.

    Example:
        >>> found = reconstruct([PhotoView("front", camera, image, mask), ...])
        >>> found.mesh, found.seen < 2  # the surface, and where it is a guess
    """
    config = config or ReconstructConfig()
    progress("masks", 0.0)
    usable, faults = usable_views(views)
    silhouettes = [Silhouette.of(view) for view in usable]
    consensus = find_consensus(silhouettes)
    kept = np.flatnonzero(consensus.trusted)
    trusted, silhouettes = [usable[k] for k in kept], [silhouettes[k] for k in kept]
    center = 0.5 * (consensus.box.low + consensus.box.high)
    problems = [f"mask of {name} left out: {why}" for name, why in (*faults.items(), *consensus.reasons.items())]
    for words in problems:
        warnings.warn(words, GeometryWarning, stacklevel=2)
    one_sided = check_spread(center, [view.camera for view in trusted])
    problems += [one_sided] if one_sided else []
    pixel = pixel_footprint(silhouettes, center)
    cell = config.cell or float(np.clip(_CELL_PIXELS * pixel, *_CELLS))
    progress("hull", 0.0)
    hull, more = main_body(soft_hull(silhouettes, consensus.box, cell=cell, dissent=config.dissent))
    problems += more
    hull = taubin(hull, mean_of_neighbours(hull), steps=3)
    pyramids = Pyramids.of(trusted)
    levels = config.levels if config.refine else ()

    def inside(points: np.ndarray) -> np.ndarray:
        return smallest_depths(silhouettes, points, count=config.dissent + 1)[:, config.dissent]

    mesh = hull
    for k, level in enumerate(levels):
        progress("photographs", k / len(levels))
        swept = refine_surface(
            mesh, pyramids, level, inside, most_views=config.most_views, smoothness=config.smoothness
        )
        mesh = taubin(mesh.with_vertices(swept.vertices), mean_of_neighbours(mesh), steps=1)
    status, _ = solid_status(mesh)
    if status != "NoError":
        raise InputError("reconstructed surface", expected="a closed manifold", received=f"manifold3d: {status}")
    progress("colours", 0.0)
    return _finished(mesh, hull, pyramids, config, problems, _numbers(usable, faults, consensus, pixel, cell))


def adopt_surface(
    mesh: TriangleMesh, views: Sequence[PhotoView], config: ReconstructConfig | None = None
) -> Reconstruction:
    """Take another program's surface in the cameras' world as the reconstruction: seen, confidence and colours.

    It stays as it is; where manifold3d does not call it a closed manifold, `problems` says so.

    Raises:
        InputError: as `reconstruct`, but masks that disagree with each other are not asked about.
    """
    config = config or ReconstructConfig()
    usable, faults = usable_views(views)
    silhouettes = [Silhouette.of(view) for view in usable]
    problems = [f"mask of {name} left out: {why}" for name, why in faults.items()]
    status, _ = solid_status(mesh)
    if status != "NoError":
        problems.append(f"the mesh is no closed manifold (manifold3d: {status}); `smplxpp build` repairs what it needs")
    numbers = {
        "views": [view.name for view in usable],
        "left_out": faults,
        "explained": {},
        "pixel_mm": 1e3 * pixel_footprint(silhouettes, mesh.vertices.mean(axis=0)),
        "cell_mm": 0.0,
    }
    return _finished(mesh, mesh, Pyramids.of(usable), config, problems, numbers)


def _finished(
    mesh: TriangleMesh,
    hull: TriangleMesh,
    pyramids: Pyramids,
    config: ReconstructConfig,
    problems: list[str],
    numbers: dict[str, Any],
) -> Reconstruction:
    """The surface with its colours and what is known of it."""
    status, genus = solid_status(mesh)
    seen, confidence, colors, gains = look_at(mesh, pyramids, most_views=config.most_views)
    moved = np.linalg.norm(mesh.vertices - hull.vertices, axis=1)
    numbers |= {
        "status": status,
        "genus": genus,
        "vertices": mesh.vertex_count,
        "faces": mesh.face_count,
        "moved_mm": 1e3 * float(moved.mean()),
        "unseen": _share_of_area(mesh, seen < _LEAST_SEEN),
        "unsure": _share_of_area(mesh, confidence == 0),
        "gains": gains.round(4).tolist(),
    }
    return Reconstruction(mesh, colors, seen, confidence, hull, numbers, tuple(problems))


def look_at(
    mesh: TriangleMesh, pyramids: Pyramids, *, most_views: int
) -> tuple[Int64[np.ndarray, " N"], Float32[np.ndarray, " N"], UInt8[np.ndarray, "N 3"], np.ndarray]:
    """How many cameras see each vertex, how sure the photographs are of it, its colour, and the views' gains."""
    mean = mean_of_neighbours(mesh)
    normals = smooth_normals(mesh, mean)
    sights = sight(mesh, normals, pyramids.cameras)
    seen = sights.seen()
    scores = sweep_scores(mesh.vertices, normals, sights, pyramids, np.zeros(1), PatchConfig(most_views=most_views))[
        :, 0
    ]
    for _ in range(2):
        scores = 0.5 * scores + 0.5 * (mean @ scores)
    confidence = np.clip((scores - _NO_AGREEMENT) / (_FULL_AGREEMENT - _NO_AGREEMENT), 0.0, 1.0)
    confidence = np.where(seen >= _LEAST_SEEN, confidence, 0.0).astype(np.float32)
    colors, gains = blend_colors(mesh, sights, pyramids)
    return seen, confidence, colors, gains


def _numbers(
    usable: Sequence[PhotoView], faults: dict[str, str], consensus: Consensus, pixel: float, cell: float
) -> dict[str, Any]:
    return {
        "views": [view.name for view, good in zip(usable, consensus.trusted, strict=True) if good],
        "left_out": {**faults, **consensus.reasons},
        "explained": {view.name: float(share) for view, share in zip(usable, consensus.explained, strict=True)},
        "pixel_mm": 1e3 * pixel,
        "cell_mm": 1e3 * cell,
    }


def _share_of_area(mesh: TriangleMesh, vertices: np.ndarray) -> float:
    """Share of the area of the faces all of whose corners are chosen."""
    chosen = vertices[mesh.faces].all(axis=1)
    return float(mesh.face_areas[chosen].sum() / mesh.face_areas.sum())
