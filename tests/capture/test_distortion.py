"""Lens distortion and undistortion: against OpenCV, and by invariants where it is not installed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.capture import open_capture, read_cameras
from smplxpp.capture.distortion import Distortion, undistort
from smplxpp.core.errors import InputError
from tests.capture.scene import HEIGHT, LENS, WIDTH, make_scene, overlap
from tests.capture.writers import write_simple

K = np.array([[180.0, 0, 92.5], [0, 184.0, 131.0], [0, 0, 1]])
COEFFICIENTS = [
    (-0.12, 0.03, 0.001, -0.0007, 0.01),
    (-0.3, 0.1, 0.002, 0.001),
    (0.1, -0.02, 0.001, 0.001, 0.01, 0.05, 0.01, 0.001),
]


def smooth_image(channels: int = 3) -> np.ndarray:
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    waves = [127 + 120 * np.sin(x / (5 + c)) * np.cos(y / (7 - c)) for c in range(channels)]
    return np.stack(waves, axis=-1).astype(np.uint8).squeeze()


@pytest.mark.parametrize("coefficients", COEFFICIENTS)
def test_points_bend_as_opencv_bends_them(coefficients):
    cv2 = pytest.importorskip("cv2")
    points = np.random.default_rng(0).normal(size=(100, 2)) * 0.3
    rays = np.c_[points, np.ones(100)]
    expected = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.eye(3), np.array(coefficients))[0][:, 0]
    bent = Distortion.from_opencv(coefficients, subject="").distort(points)
    np.testing.assert_allclose(bent, expected, atol=1e-12)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("coefficients", COEFFICIENTS)
def test_images_are_undistorted_as_opencv_undistorts_them(coefficients, channels):
    cv2 = pytest.importorskip("cv2")
    image = smooth_image(channels)
    ours = undistort(
        image, Distortion.from_opencv(coefficients, subject=""), source_K=K, target_K=K, size=(WIDTH, HEIGHT)
    )
    opencv_K = K.copy()
    opencv_K[:2, 2] -= 0.5
    maps = cv2.initUndistortRectifyMap(opencv_K, np.array(coefficients), None, opencv_K, (WIDTH, HEIGHT), cv2.CV_32FC1)
    # Where the source is left, OpenCV fades to black over a pixel.
    inside = (maps[0] > 1) & (maps[0] < WIDTH - 2) & (maps[1] > 1) & (maps[1] < HEIGHT - 2)
    theirs = cv2.remap(image, *maps, cv2.INTER_LINEAR)
    difference = np.abs(ours.astype(int) - theirs)[inside]
    assert inside.mean() > 0.7 and difference.max() <= 4 and difference.mean() < 0.7


def test_without_distortion_pixels_stay_exactly_where_they_are():
    image = smooth_image()
    none = Distortion((0.0,) * 6, (0.0, 0.0))
    for nearest in (False, True):
        same = undistort(image, none, source_K=K, target_K=K, size=(WIDTH, HEIGHT), nearest=nearest)
        np.testing.assert_array_equal(same, image)


def test_a_bent_ramp_is_straightened():
    """Each pixel of the distorted image holds its undistorted column: the result is the column's number."""
    lens = Distortion.from_opencv(LENS, subject="")
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    distorted = np.stack([(x.ravel() - K[0, 2]) / K[0, 0], (y.ravel() - K[1, 2]) / K[1, 1]], axis=1)
    straight = distorted.copy()
    for _ in range(60):  # fixed point of the inverse
        straight += distorted - lens.distort(straight)
    np.testing.assert_allclose(lens.distort(straight), distorted, atol=1e-9)
    column = (straight[:, 0] * K[0, 0] + K[0, 2]).reshape(HEIGHT, WIDTH)
    image = np.clip(np.round(column), 0, 255).astype(np.uint8)
    result = undistort(image, lens, source_K=K, target_K=K, size=(WIDTH, HEIGHT)).astype(float)
    inner = np.s_[30:-30, 30:-30]
    assert np.abs(result - x)[inner].max() <= 1.0
    assert abs((result - x)[inner].mean()) < 0.05


def test_labels_are_never_mixed():
    labels = (np.indices((HEIGHT, WIDTH)).sum(axis=0) // 9 % 2 * 5).astype(np.uint8)
    lens = Distortion.from_opencv(LENS, subject="")
    result = undistort(labels, lens, source_K=K, target_K=K, size=(WIDTH, HEIGHT), nearest=True)
    assert set(np.unique(result)) == {0, 5}


def test_resizing_and_cropping_a_distorted_capture_keep_the_scene_on_its_masks(tmp_path):
    from smplxpp.raster import rasterize_mesh

    scene = make_scene(lens=LENS)
    capture = open_capture(write_simple(scene, tmp_path / "rig"))
    for seen in (
        capture.resized(0.5),
        capture.resized(1.5),
        capture.cropped({"A": (20, 10, 171, 231)}).resized(0.7),
    ):
        drawn = rasterize_mesh(scene.meshes[0], seen.cameras["A"]).mask
        assert overlap(drawn, seen.mask("A", 0) > 127) > 0.96


def test_coefficients_are_counted():
    assert Distortion.from_opencv([], subject="") is None
    assert Distortion.from_opencv(np.zeros((1, 5)), subject="") is None
    for bad in ([0.1], [0.1] * 3, [0, 0, 0, 0, np.nan], [0.0] * 8 + [0.1] * 4):
        with pytest.raises(InputError, match="camera X: distortion"):
            Distortion.from_opencv(bad, subject="camera X")


def test_label_maps_of_a_distorted_rig_are_refused_by_the_template_builder(tmp_path):
    write_simple(make_scene(lens=LENS), tmp_path / "rig")
    with pytest.raises(InputError, match=r"distortion of .*'A', 'B', 'C'"):
        read_cameras(tmp_path / "rig" / "cameras.json")


def test_the_lens_of_the_reader_is_the_lens_of_the_picture(tmp_path):
    """Without undistortion the same masks would not fit."""
    from smplxpp.raster import rasterize_mesh

    scene = make_scene(lens=LENS)
    capture = open_capture(write_simple(scene, tmp_path / "rig"))
    drawn = rasterize_mesh(scene.meshes[0], capture.cameras["A"]).mask
    assert overlap(drawn, capture.mask("A", 0) > 127) > 0.98
    bare = open_capture(tmp_path / "rig")
    bare = replace(bare, recording=replace(bare.recording, distortions={}))
    assert overlap(drawn, bare.mask("A", 0) > 127) < 0.95
