"""Reconstruct the surface of a person from photographs, cameras and masks of one moment, with its confidence.

1. Masks that contradict the others are dropped (`mask_consensus`).
2. The soft visual hull is extracted by marching cubes (`hull`).
3. A plane sweep along the normals moves the hull to where photographs agree, from coarse to fine levels (`sweep`).
4. Colours are blended from the photographs; visibility and agreement give the confidence (`colors`).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from smplxpp.core import TriangleMesh, require_at_least, require_positive
from smplxpp.core.errors import GeometryWarning, InputError, ProgressCallback, ignore_progress, one_line
from smplxpp.reconstruct.colors import blend_colors
from smplxpp.reconstruct.hull import Field, main_body, pixel_footprint, soft_hull, solid_status
from smplxpp.reconstruct.mask_consensus import Consensus, find_consensus
from smplxpp.reconstruct.photographs import Pyramids
from smplxpp.reconstruct.sweep import (
    PatchConfig,
    SweepLevel,
    mean_of_neighbours,
    refine_surface,
    smooth_normals,
    sweep_scores,
    taubin,
)
from smplxpp.reconstruct.views import PhotoView, Silhouette, check_spread, smallest_depths, usable_views

# Cameras that must see a vertex for photographs to determine it.
_LEAST_SEEN = 2
# Sweeps from 5 cm and 2 mm steps, for arms pressed to the body, to 4 mm and 0.5 mm steps.
LEVELS = (
    SweepLevel(0.05, 0.004, 0.002, 0.06, (1.0, 2.0)),
    SweepLevel(0.02, 0.006, 0.001, 0.04),
    SweepLevel(0.004, 0.004, 0.0005, 0.03),
)


@dataclass(frozen=True)
class ReconstructConfig:
    """Options of a reconstruction from photographs and masks.

    Attributes:
        cell: size of the grid's cells, metres; None for two pixels, within 3 to 6 mm.
        dissent: number of views that may reject a point; the hull grows with it.
        refine: whether to sweep along the normals; else the result is the hull.
        levels: of the sweep, from coarse to fine.
        smoothness: weight of the displacements' Laplacian relative to the agreement of the views.
        most_views: number of views that are compared at a point.
    """

    cell: float | None = None
    dissent: int = 0
    refine: bool = True
    levels: tuple[SweepLevel, ...] = LEVELS
    smoothness: float = 0.3
    most_views: int = 6

    def __post_init__(self) -> None:
        if self.cell is not None:
            require_positive("reconstruction config cell", self.cell)
        require_at_least("reconstruction config dissent", self.dissent, 0)
        require_at_least("reconstruction config most_views", self.most_views, 2)
        require_positive("reconstruction config smoothness", self.smoothness)


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The closed surface of a person.

    Attributes:
        mesh: metres, +Y up; closed and manifold, checked with manifold3d.
        colors: sRGB of each vertex.
        seen: number of cameras that see each vertex, without grazing views.
        confidence: of each vertex, from 0 (fewer than two cameras see it, or they show different things, as over the
            air between the legs) to 1 (they show the same).
        hull: the visual hull before the sweep.
        numbers: for reports: cell size, pixel size, used and dropped views, genus, mean displacement.
        notes: sentences about faults of the inputs and uncertain regions of the result.
    """

    mesh: TriangleMesh
    colors: UInt8[np.ndarray, "N 3"]
    seen: Int64[np.ndarray, " N"]
    confidence: Float32[np.ndarray, " N"]
    hull: TriangleMesh
    numbers: dict[str, Any]
    notes: tuple[str, ...]

    __repr__ = one_line

    @property
    def unseen(self) -> float:
        """The share of the surface's area that fewer than two cameras see."""
        return _share_of_area(self.mesh, self.seen < _LEAST_SEEN)


def reconstruct(
    views: Sequence[PhotoView],
    config: ReconstructConfig | None = None,
    *,
    progress: ProgressCallback = ignore_progress,
) -> Reconstruction:
    """Reconstruct one moment: consensus of the masks, soft visual hull, plane sweep along the normals, colours.

    Masks that contradict the others are dropped and named, in `notes` and as a `GeometryWarning`.

    Args:
        views: at least four of one moment, from all around.
        config: options.
        progress: called with the running step and its share done.

    Raises:
        InputError: too few views, views from one side only, masks of nothing or of the background, or masks that
            contradict each other.

    Example:
        >>> found = reconstruct([PhotoView("front", camera, image, mask), ...])
        >>> found.mesh, found.seen < 2  # the surface, and the vertices that photographs do not determine
    """
    config = config or ReconstructConfig()
    progress("masks", 0.0)
    # Views with plausible masks, and of these the ones whose silhouettes agree.
    # Masks are judged one by one; contradictions between them do not matter for a surface that is given.
    usable, faults = usable_views(views)
    silhouettes = [Silhouette.of(view) for view in usable]
    consensus = find_consensus(silhouettes)
    kept = np.flatnonzero(consensus.trusted)
    trusted, silhouettes = [usable[k] for k in kept], [silhouettes[k] for k in kept]
    center = 0.5 * (consensus.box.low + consensus.box.high)
    notes = [f"mask of {name} left out: {why}" for name, why in (*faults.items(), *consensus.reasons.items())]
    for note in notes:
        warnings.warn(note, GeometryWarning, stacklevel=2)
    one_sided = check_spread(center, [view.camera for view in trusted])
    notes += [one_sided] if one_sided else []
    # The hull of the component of largest volume, with cells of two pixels between 3 and 6 mm.
    pixel = pixel_footprint(silhouettes, center)
    cell = cell_size(pixel, config)
    progress("hull", 0.0)
    hull, more = main_body(soft_hull(silhouettes, consensus.box, cell=cell, dissent=config.dissent))
    notes += more

    def inside(points: np.ndarray) -> np.ndarray:
        return smallest_depths(silhouettes, points, count=config.dissent + 1)[:, config.dissent]

    numbers = _numbers(usable, faults, consensus, pixel, cell)
    return refined(hull, Pyramids.of(trusted), inside, config, (notes, numbers), progress=progress)


def cell_size(pixel: float, config: ReconstructConfig) -> float:
    """Return the size of the grid's cells, metres: as configured, or two pixels within 3 to 6 mm."""
    return config.cell or float(np.clip(2.0 * pixel, 3e-3, 6e-3))


def refined(
    hull: TriangleMesh,
    pyramids: Pyramids,
    inside: Field,
    config: ReconstructConfig,
    results: tuple[list[str], dict[str, Any]],
    *,
    progress: ProgressCallback = ignore_progress,
) -> Reconstruction:
    """Sweep a hull along its normals, level by level, and give it colours and a confidence.

    Args:
        hull: closed surface.
        pyramids: of the photographs.
        inside: depth of points inside the silhouettes, metres.
        config: options.
        results: notes and numbers so far.
        progress: called with the running step and its share done.

    Raises:
        InputError: the result is no closed manifold.
    """
    notes, numbers = results
    hull = taubin(hull, mean_of_neighbours(hull), steps=3)
    levels = config.levels if config.refine else ()
    # The sweep, level by level, each followed by one Taubin step against the noise of the displacements.
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
    return _finished(mesh, hull, pyramids, config, notes, numbers)


def adopt_surface(
    mesh: TriangleMesh, views: Sequence[PhotoView], config: ReconstructConfig | None = None
) -> Reconstruction:
    """Adopt a surface of another program, in world coordinates, and compute its visibility, confidence and colours.

    The surface is not changed; if it is no closed manifold, `notes` says so.

    Raises:
        InputError: as `reconstruct`, except that masks may contradict each other.
    """
    config = config or ReconstructConfig()
    usable, faults = usable_views(views)
    silhouettes = [Silhouette.of(view) for view in usable]
    notes = [f"mask of {name} left out: {why}" for name, why in faults.items()]
    status, _ = solid_status(mesh)
    if status != "NoError":
        notes.append(f"the mesh is no closed manifold (manifold3d: {status}); `smplxpp build` repairs what it needs")
    numbers = {
        "views": [view.name for view in usable],
        "left_out": faults,
        "explained": {},
        "pixel_mm": 1e3 * pixel_footprint(silhouettes, mesh.vertices.mean(axis=0)),
        "cell_mm": 0.0,
    }
    return _finished(mesh, mesh, Pyramids.of(usable), config, notes, numbers)


def _finished(
    mesh: TriangleMesh,
    hull: TriangleMesh,
    pyramids: Pyramids,
    config: ReconstructConfig,
    notes: list[str],
    numbers: dict[str, Any],
) -> Reconstruction:
    """Compute colours and confidence of a surface, and the numbers of the report."""
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
    return Reconstruction(mesh, colors, seen, confidence, hull, numbers, tuple(notes))


def look_at(
    mesh: TriangleMesh, pyramids: Pyramids, *, most_views: int
) -> tuple[Int64[np.ndarray, " N"], Float32[np.ndarray, " N"], UInt8[np.ndarray, "N 3"], np.ndarray]:
    """Return the number of cameras that see each vertex, its confidence and colour, and the views' gains.

    The confidence rises linearly from 0 at an agreement of 0.1 to 1 at 0.7, which is as high as real photographs agree.
    """
    none, full = 0.1, 0.7
    mean = mean_of_neighbours(mesh)
    normals = smooth_normals(mesh, mean)
    # Depth tests from every camera; then the photometric agreement of patches at the surface itself (offset 0).
    sights = pyramids.sight(mesh, normals)
    seen = sights.seen()
    scores = sweep_scores(mesh.vertices, normals, sights, pyramids, np.zeros(1), PatchConfig(most_views=most_views))[
        :, 0
    ]
    # Two rounds of averaging with neighbours, since the score of a single patch is noisy.
    for _ in range(2):
        scores = 0.5 * scores + 0.5 * (mean @ scores)
    confidence = np.clip((scores - none) / (full - none), 0.0, 1.0)
    confidence = np.where(seen >= _LEAST_SEEN, confidence, 0.0).astype(np.float32)
    colors, gains = blend_colors(mesh, sights, pyramids)
    return seen, confidence, colors, gains


def _numbers(
    usable: Sequence[PhotoView], faults: dict[str, str], consensus: Consensus, pixel: float, cell: float
) -> dict[str, Any]:
    """Return the numbers of a report that are known before the surface is."""
    return {
        "views": [view.name for view, good in zip(usable, consensus.trusted, strict=True) if good],
        "left_out": {**faults, **consensus.reasons},
        "explained": {view.name: float(share) for view, share in zip(usable, consensus.explained, strict=True)},
        "pixel_mm": 1e3 * pixel,
        "cell_mm": 1e3 * cell,
    }


def _share_of_area(mesh: TriangleMesh, vertices: np.ndarray) -> float:
    """Return the share of the area whose faces have all their corners chosen."""
    chosen = vertices[mesh.faces].all(axis=1)
    return float(mesh.face_areas[chosen].sum() / mesh.face_areas.sum())
