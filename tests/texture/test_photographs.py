"""Photographs painted onto a scan: each place from the views that see it, exposures evened."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core.surface_points import draw_on_surface
from smplxpp.raster import outer_visible_faces, rasterize_mesh
from smplxpp.raster.viewpoints import turntable_cameras
from smplxpp.texture.photographs import Photograph, PhotographPainter, finer_than_the_scan

EXPOSURES = np.array([1.0, 1.2, 0.85, 1.1, 0.9, 1.0])


def painted(points: np.ndarray) -> np.ndarray:
    bands = np.sin(90.0 * points[:, 1:2])
    return np.array([120.0, 100.0, 80.0]) + bands * [40, -30, 20]


@pytest.mark.long
def test_places_have_the_colours_of_the_views_that_see_them_at_one_exposure():
    mesh = load_body().mesh()
    cameras = turntable_cameras(mesh.vertices, count=len(EXPOSURES), height=800)
    photographs = []
    for camera, exposure in zip(cameras, EXPOSURES, strict=True):
        maps = rasterize_mesh(mesh, camera)
        points = maps.interpolate(mesh.faces, mesh.vertices)[maps.mask]
        # The background is as bright as nothing on the person: a view that bleeds across a silhouette shows it.
        image = np.full((*maps.mask.shape, 3), 255.0)
        image[maps.mask] = exposure * painted(points)
        photographs.append(Photograph(camera, np.rint(np.clip(image, 0, 255)).astype(np.uint8)))
    grey = np.full(3, 7, np.uint8)
    painter = PhotographPainter(mesh, photographs, lambda face, barycentric: np.tile(grey, (len(face), 1)))
    # Gains undo the exposures up to a common factor.
    ratio = painter.gains * EXPOSURES[:, None]
    assert np.ptp(ratio) / ratio.mean() < 0.02
    face, barycentric = draw_on_surface(mesh, 20_000)
    found = painter(face, barycentric).astype(float)
    points = np.einsum("nk,nkd->nd", barycentric, mesh.triangles[face])
    away = np.abs(found - ratio.mean() * painted(points)).max(axis=1)
    unseen = (found == grey).all(axis=1)
    # What no view sees, such as soles and the mouth, has what was to be there otherwise; little of what is seen has.
    seen_from_outside = outer_visible_faces(mesh)[face]
    assert unseen[~seen_from_outside].mean() > 0.8 and unseen[seen_from_outside].mean() < 0.25
    sure = ~unseen & (found > 20).all(axis=1)
    assert np.percentile(away[sure], 90) < 6 and away[sure].mean() < 4
    # A pixel of 2 mm is finer than the body's edges, one of 2 cm is not.
    assert finer_than_the_scan(mesh, photographs)
    coarse = [
        Photograph(camera.resized(camera.width // 10, 80), photo.color)
        for camera, photo in zip(cameras, photographs, strict=True)
    ]
    assert not finer_than_the_scan(mesh, coarse)
