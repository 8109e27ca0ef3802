import numpy as np
import pytest

from smplxpp.core.camera import Camera
from smplxpp.reconstruct.views import UNSEEN, PhotoView, Silhouette, least_shown, signed_distance, smallest_depths

SIZE = 64


def disc(x, y, radius, *, fine=16):
    """Opacity of a disc, from many samples a pixel."""
    places = (np.arange(SIZE * fine) + 0.5) / fine
    inside = (places[None] - x) ** 2 + (places[:, None] - y) ** 2 < radius**2
    return np.round(255 * inside.reshape(SIZE, fine, SIZE, fine).mean(axis=(1, 3))).astype(np.uint8)


def view(opacity, camera):
    return PhotoView("one", camera, np.zeros((*opacity.shape, 3), np.uint8), opacity)


def test_the_distance_of_an_antialiased_disc_is_right_to_a_fraction_of_a_pixel():
    found = signed_distance(disc(31.3, 33.8, 17.6))
    centers = np.arange(SIZE) + 0.5
    true = 17.6 - np.hypot(centers[None] - 31.3, centers[:, None] - 33.8)
    assert np.abs(found - true).max() < 0.6
    assert np.abs(found - true).mean() < 0.1
    near = np.abs(true) < 0.5  # there it decides on the surface
    assert np.abs(found - true)[near].max() < 0.15


def test_an_edge_between_pixels_lies_where_its_opacity_says():
    opacity = np.zeros((8, 20), np.uint8)
    opacity[:, 10] = 64
    opacity[:, 11:] = 255
    edge = 11 - 64 / 255  # x of the outline
    assert signed_distance(opacity)[4] == pytest.approx(np.arange(20) + 0.5 - edge, abs=1e-4)


def test_depth_is_metres_at_the_points_own_distance_and_nothing_outside_of_the_image():
    camera = Camera(np.array([[100.0, 0, 32], [0, 100, 32], [0, 0, 1]]), np.eye(4), SIZE, SIZE)
    silhouette = Silhouette.of(view(disc(32, 32, 20), camera))
    points = np.array([[0, 0, 2], [0.3, 0, 2], [0.6, 0, 2], [0.9, 0, 2], [0, 0, -1]], np.float32)
    depth = silhouette.depth(points)
    assert depth[0] == pytest.approx(0.39, abs=0.02)  # the disc's middle is half a pixel from a centre
    assert depth[1:3] == pytest.approx([0.1, -0.2], abs=0.01)
    assert (depth[3:] == UNSEEN).all()


def test_a_mask_that_the_image_cuts_says_nothing_beyond_it():
    camera = Camera(np.array([[100.0, 0, 32], [0, 100, 32], [0, 0, 1]]), np.eye(4), SIZE, SIZE)
    opacity = np.zeros((SIZE, SIZE), np.uint8)
    opacity[:, 40:] = 255
    points = np.array([[0.3, 0, 1], [0.4, 0, 1]], np.float32)  # x = 62, 72
    depth = Silhouette.of(view(opacity, camera)).depth(points)
    assert 0 < depth[0] < 1
    assert depth[1] == UNSEEN


def test_what_too_few_views_show_is_outside():
    camera = Camera(np.array([[100.0, 0, 32], [0, 100, 32], [0, 0, 1]]), np.eye(4), SIZE, SIZE)
    one = Silhouette.of(view(disc(32, 32, 20), camera))
    point = np.array([[0, 0, 2.0]], np.float32)
    assert smallest_depths([one], point)[0, 0] == -UNSEEN
    assert smallest_depths([one, one], point)[0, 0] > 0
    assert least_shown(4) == 2 and least_shown(40) == 10


def test_the_smallest_depths_come_in_order():
    cameras = [Camera(np.array([[100.0, 0, 32], [0, 100, 32], [0, 0, 1]]), np.eye(4), SIZE, SIZE) for _ in range(3)]
    views = [Silhouette.of(view(disc(32, 32, r), c)) for r, c in zip((20, 10, 15), cameras, strict=True)]
    found = smallest_depths(views, np.array([[0, 0, 2.0]], np.float32), count=3)[0]
    assert found == pytest.approx([0.19, 0.29, 0.39], abs=0.02)
