"""Reconstruct a person who turns before one camera: silhouettes and photographs carried to one pose by skinning.

Every frame has a pose of its own. A point of the space around the body in the reference pose is carried to frame t by
the skinning weights of the body near it (`carried`; after Alldieck et al. 2018, "Video Based Reconstruction of 3D
People Models", who carry the rays of silhouettes instead). There the photograph of frame t says whether the point lies
inside its silhouette, and what colour it has. Hull and colours are those of `reconstruct`, with all views looking at
points that are carried.

Eight silhouettes leave wedges of air between them. The surface is therefore bounded by the distance of clothes from the
body, measured where they are seen from the side (`clothing_limits`).

Poses are wrong by some degrees, and each wrong one cuts into the surface. So a share of the frames may reject a point,
and the surface is smoothed. It is not swept along its normals to where photographs agree: at poses that are off by
millimetres, in views 15 degrees apart, stripes agree with their neighbours, and plain cloth with anything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float64

from smplxpp.core import InputError, ProgressCallback, TriangleMesh, ignore_progress, spread
from smplxpp.raster import rasterize_mesh
from smplxpp.reconstruct.carried import REACH_M, CarriedPyramids, PosedPerson, clothing_limits
from smplxpp.reconstruct.hull import Field, main_body, zero_surface
from smplxpp.reconstruct.reconstruct import ReconstructConfig, Reconstruction, cell_size, refined
from smplxpp.reconstruct.sweep import mean_of_neighbours, taubin
from smplxpp.reconstruct.views import INSIDE, LEAST_VIEWS, UNSEEN, Box, PhotoView, Silhouette, least_shown, mask_fault

# Share of the frames that may reject a point of the surface, and of the first hull, which a wrong frame must not spoil.
# It trades thin limbs, which wrong poses cut off, against fat ones.
_DISSENT, _FIRST_DISSENT = 0.03, 0.15
_SMOOTHING = 10  # Taubin steps, against the edges that few silhouettes leave
# Standard deviation of a Gaussian over the field, against the teeth and sheets that it has where neighbouring points
# follow different limbs, as between thighs. It trades them against thin wrists and fingers; chosen on benchmark
# `turntable` and a real man's thighs.
_FIELD_SMOOTHING_M = 0.005
# Frames of whose mask the surface covers less than of the median frame's, by this share, were posed wrongly.
_LESS_COVERED = 0.06
_COARSE_M = 0.012  # cells of the first hull
_COARSEST_M = 0.08  # cells with which a hull is begun: the box around spread arms is mostly air
_MOST_FRAMES = 60  # more, evenly spread, add minutes and no side


def reconstruct_turntable(
    views: Sequence[PhotoView],
    person: PosedPerson,
    config: ReconstructConfig | None = None,
    *,
    progress: ProgressCallback = ignore_progress,
) -> Reconstruction:
    """Reconstruct a person who turns before one camera, carved in the reference pose of the body.

    Args:
        views: a photograph and a mask a frame, through the camera that stands still.
        person: the body in these frames.
        config: `cell`, and `dissent` in frames, in addition to 3 % of them; there is no sweep.
        progress: called with the running step and its share done.

    Raises:
        InputError: fewer than four masks that may show a person, or a body that lies in no silhouette.

    Example:
        >>> found = reconstruct_turntable([PhotoView("0", camera, image, mask), ...], person)  # doctest: +SKIP
    """
    config = replace(config or ReconstructConfig(), refine=False)
    progress("masks", 0.0)
    views, person, faults = _usable(views, person)
    notes = [f"mask of {name} left out: {why}" for name, why in faults.items()]
    box = Box(person.vertices.min(axis=0) - REACH_M, person.vertices.max(axis=0) + REACH_M)
    progress("hull", 0.0)
    # A coarse hull shows which frames do not fit; the fine one is made of the others.
    first = max(1, round(_FIRST_DISSENT * len(views)))
    shares = coverage(_hull(views, person, box, cell=_COARSE_M, dissent=first)[0], views, person)
    kept = np.flatnonzero(shares[:, 0] >= np.median(shares[:, 0]) - _LESS_COVERED)
    for row in np.setdiff1d(np.arange(len(views)), kept):
        faults[views[row].name] = f"the surface of the others covers {100 * shares[row, 0]:.0f} % of its mask"
        notes.append(f"frame {views[row].name} left out: {faults[views[row].name]}, probably a wrong pose")
    views, person = [views[row] for row in kept], person.select(kept.tolist())
    pixel = _pixel(views, person)
    cell = cell_size(pixel, config)
    hull, inside = _hull(views, person, box, cell=cell, dissent=config.dissent + int(_DISSENT * len(views)))
    hull, more = main_body(hull)
    notes += more
    hull = taubin(hull, mean_of_neighbours(hull), steps=_SMOOTHING)
    numbers: dict[str, Any] = {
        "views": [view.name for view in views],
        "left_out": faults,
        "explained": {},
        "pixel_mm": 1e3 * pixel,
        "cell_mm": 1e3 * cell,
    }
    pyramids = CarriedPyramids.of_turn(views, person.carrier())
    found = refined(hull, pyramids, inside, config, (notes, numbers), progress=progress)
    agreement = coverage(found.mesh, views, person)[:, 1]
    numbers["silhouettes"] = {view.name: float(share) for view, share in zip(views, agreement, strict=True)}
    return replace(found, mesh=person.finished(found.mesh), hull=person.finished(found.hull))


def _usable(views: Sequence[PhotoView], person: PosedPerson) -> tuple[list[PhotoView], PosedPerson, dict[str, str]]:
    """Return evenly spread frames whose masks may show a person, and the faults of the other masks by name.

    Raises:
        InputError: fewer than four of them.
    """
    faults = {view.name: fault for view in views if (fault := mask_fault(view))}
    rows = spread([k for k, view in enumerate(views) if view.name not in faults], _MOST_FRAMES)
    if len(rows) < LEAST_VIEWS:
        raise InputError(
            "frames to reconstruct from",
            expected=f"at least {LEAST_VIEWS} with a photograph, a mask of the person and a pose",
            received=f"{len(rows)} of {len(views)}",
            remedy="look at the masks (`smplxpp capture check`)",
        )
    return [views[row] for row in rows], person.select(rows), faults


def _hull(
    views: Sequence[PhotoView], person: PosedPerson, box: Box, *, cell: float, dissent: int
) -> tuple[TriangleMesh, Field]:
    """Return the surface of the points that enough frames accept, and the field that it is the zero set of."""
    silhouettes, carrier = [Silhouette.of(view) for view in views], person.carrier()
    least, limits = least_shown(len(views)), clothing_limits(silhouettes, person)

    def inside(points: np.ndarray) -> np.ndarray:
        chunk = 1 << 16  # points at once, which bounds the memory
        out = np.empty(len(points), np.float32)
        for first in range(0, len(points), chunk):
            part = points[first : first + chunk]
            # Clothes bound the person's surface also where the silhouettes do not.
            distance, index = carrier.neighbours(part, reach=REACH_M)
            out[first : first + chunk] = person.room(part, distance, index, limits)
            rows = np.flatnonzero(distance[:, 0] < REACH_M)
            features = carrier.features(part[rows], carrier.weights_of(distance[rows], index[rows]))
            depths = np.empty((len(silhouettes), len(rows)), np.float32)
            for frame, silhouette in enumerate(silhouettes):
                depths[frame] = silhouette.depth(carrier.carried(features, frame).astype(np.float32))
            depth = np.partition(depths, dissent, axis=0)[dissent]
            depth[(depths < UNSEEN).sum(axis=0) < least] = -UNSEEN
            out[first + rows] = np.minimum(out[first + rows], depth)
        return out

    return zero_surface(inside, box, cell=cell, coarsest=_COARSEST_M, smoothing=_FIELD_SMOOTHING_M), inside


def coverage(surface: TriangleMesh, views: Sequence[PhotoView], person: PosedPerson) -> Float64[np.ndarray, "T 2"]:
    """Return the share of each frame's mask that the posed surface covers, and their intersection over union.

    Frames are compared at some 320 rows.
    """
    carrier = person.carrier()
    features = carrier.features(surface.vertices, carrier.weights_at(surface.vertices))
    shares = np.zeros((len(views), 2))
    for frame, view in enumerate(views):
        step = max(1, view.camera.height // 320)
        small = view.camera.resized(view.camera.width // step, view.camera.height // step)
        posed = surface.with_vertices(carrier.carried(features, frame))
        drawn = rasterize_mesh(posed, small, threads=1).mask
        mask = view.opacity[step // 2 :: step, step // 2 :: step][: small.height, : small.width] > INSIDE
        both = float((drawn & mask).sum())
        shares[frame] = both / max(mask.sum(), 1), both / max((drawn | mask).sum(), 1)
    return shares


def _pixel(views: Sequence[PhotoView], person: PosedPerson) -> float:
    """Return the size of a pixel at the body, metres, as the median over the frames."""
    middle = np.append(person.vertices.mean(axis=0), 1.0)
    places = person.transforms[:, 0] @ middle
    depths = [float((view.camera.cam_from_world @ place)[2]) for view, place in zip(views, places, strict=True)]
    return float(
        np.median([2.0 * z / (v.camera.K[0, 0] + v.camera.K[1, 1]) for v, z in zip(views, depths, strict=True)])
    )
