"""Lens distortion and undistortion: against OpenCV, and by invariants where it is not installed."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from smplxpp.capture import open_capture, read_cameras
from smplxpp.capture.distortion import FISHEYE, FOV, Distortion, RationalDistortion, undistort
from smplxpp.capture.problems import lens_problems, lost_share
from smplxpp.core import Camera
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
    none = RationalDistortion((0.0,) * 6, (0.0, 0.0))
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


FISHEYES = [(0.0, 0.0, 0.0, 0.0), (0.03, 0.005, -0.002, 0.0003), (-0.05, 0.01, -0.004, 0.0006)]


def test_beyond_the_fold_of_a_polynomial_nothing_is_shown_twice(tmp_path):
    """Lenses of a real rig, calibrated with a board in the middle, showed curtains a second time, mirrored."""
    lens = Distortion.from_opencv((0.0, -1.6, 0.0, 0.0, 0.0), subject="lens")
    # d/dr (r - 1.6 r^5) = 0 at r^4 = 1 / 8.
    assert lens.fold == pytest.approx(8**-0.25)
    assert Distortion.from_opencv((0.3, 0.1, 0.0, 0.0, 0.0), subject="lens").fold == np.inf
    assert RationalDistortion((np.inf, 0.0, 0.0, 1e300, 1e300, 0.0), (0.0, 0.0)).fold == np.inf
    # A pole of the rational model is a fold, too: 1 - 2 r^2 = 0 below.
    assert Distortion.from_opencv((0, 0, 0, 0, 0, -2.0, 0, 0), subject="lens").fold <= 2**-0.5
    K = np.array([[100.0, 0, 100], [0, 100, 10], [0, 0, 1]])
    ramp = np.broadcast_to(np.arange(1, 201, dtype=np.uint8), (20, 200))
    row = undistort(ramp, lens, source_K=K, target_K=K, size=(200, 20))[10].astype(int)
    seen = np.flatnonzero(row)
    assert (np.diff(row[seen]) >= 0).all() and (np.diff(seen) == 1).all()
    assert abs(seen[-1] + 0.5 - (100 + 100 * lens.fold)) <= 1
    camera = Camera(K, np.eye(4), 200, 20, name="A")
    (problem,) = lens_problems({"A": camera}, {"A": lens})
    assert "turns back" in problem.message and f"{(row == 0).mean():.0%}" in problem.message


@pytest.mark.parametrize("k", FISHEYES)
def test_a_fisheye_bends_angles(k):
    """The closed form: what lies theta from the axis is drawn at theta (1 + k1 theta^2 + ...), in any direction."""
    lens = Distortion.from_opencv(k, subject="", model=FISHEYE)
    theta, turn = np.radians([5.0, 40.0, 70.0, 88.0]), np.radians([0.0, 77.0, 200.0, -30.0])
    direction = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    drawn = theta + sum(c * theta ** (2 * n + 3) for n, c in enumerate(k))
    plane = direction * np.tan(theta)[:, None]
    np.testing.assert_allclose(lens.distort(plane), direction * drawn[:, None], atol=1e-12)
    np.testing.assert_allclose(lens.undistort(direction * drawn[:, None]), plane, rtol=1e-11)
    assert not lens.distort(np.zeros((1, 2))).any() and not lens.undistort(np.zeros((1, 2))).any()


def test_what_no_pinhole_sees_has_no_place():
    """Beyond 89 degrees, and beyond the angle where the polynomial turns back: drawn twice, it would be wrong once."""
    whole = Distortion.from_opencv([0, 0, 0, 0], subject="", model=FISHEYE)
    assert np.isnan(whole.undistort(np.array([[np.pi / 2, 0.0]]))).all()
    folding = Distortion.from_opencv([-0.3, 0, 0, 0], subject="", model=FISHEYE)
    turn = np.sqrt(1 / 0.9)  # 1 - 0.9 theta^2 = 0
    assert folding.max_angle == pytest.approx(turn)
    seen = folding.distort(np.tan([[turn - 0.01, 0.0], [turn + 0.01, 0.0]]))
    assert np.isfinite(seen[0]).all() and np.isnan(seen[1, 0])
    picture = undistort(
        np.full((64, 64), 200, np.uint8),
        folding,
        source_K=(K64 := np.array([[9.0, 0, 32], [0, 9, 32], [0, 0, 1]])),
        target_K=K64,
        size=(64, 64),
    )
    r = np.linalg.norm((np.indices((64, 64)) + 0.5 - 32) / 9, axis=0)
    np.testing.assert_array_equal(picture, np.where(r > np.tan(turn), 0, 200))


@pytest.mark.parametrize("omega", [1e-3, 0.9, 2.5])
def test_the_field_of_view_model_and_its_inverse(omega):
    lens = Distortion.from_opencv([omega], subject="", model=FOV)
    plane = np.random.default_rng(1).normal(size=(200, 2))
    r = np.linalg.norm(plane, axis=1, keepdims=True)
    bent = lens.distort(plane)
    np.testing.assert_allclose(bent, plane / r * np.arctan(2 * r * np.tan(omega / 2)) / omega, atol=1e-12)
    np.testing.assert_allclose(lens.undistort(bent), plane, atol=1e-9)
    assert np.isnan(lens.undistort(np.array([[1.6 / omega, 0.0]]))).all()
    assert Distortion.from_opencv([0.0], subject="", model=FOV) is None


@pytest.mark.parametrize(("model", "coefficients"), [(FISHEYE, FISHEYES[1]), (FISHEYE, FISHEYES[2]), (FOV, (1.1,))])
def test_a_ramp_bent_by_a_wide_lens_is_straightened(model, coefficients):
    """The native look-up uses the lens that the points use."""
    lens = Distortion.from_opencv(coefficients, subject="", model=model)
    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    pixels = np.stack([(x.ravel() - K[0, 2]) / K[0, 0], (y.ravel() - K[1, 2]) / K[1, 1]], axis=1)
    column = (lens.undistort(pixels)[:, 0] * K[0, 0] + K[0, 2]).reshape(HEIGHT, WIDTH)
    image = np.clip(np.round(column), 0, 255).astype(np.uint8)
    result = undistort(image, lens, source_K=K, target_K=K, size=(WIDTH, HEIGHT)).astype(float)
    inner = np.s_[30:-30, 30:-30]
    assert np.abs(result - x)[inner].max() <= 1.0
    assert abs((result - x)[inner].mean()) < 0.05


@pytest.mark.parametrize("k", FISHEYES)
def test_fisheye_images_are_undistorted_as_opencv_undistorts_them(k):
    cv2 = pytest.importorskip("cv2")
    image, opencv_K = smooth_image(), K.copy()
    opencv_K[:2, 2] -= 0.5
    ours = undistort(
        image,
        Distortion.from_opencv(k, subject="", model=FISHEYE),
        source_K=K,
        target_K=K,
        size=(WIDTH, HEIGHT),
    )
    maps = cv2.fisheye.initUndistortRectifyMap(
        opencv_K, np.array(k), np.eye(3), opencv_K, (WIDTH, HEIGHT), cv2.CV_32FC1
    )
    inside = (maps[0] > 1) & (maps[0] < WIDTH - 2) & (maps[1] > 1) & (maps[1] < HEIGHT - 2)
    difference = np.abs(ours.astype(int) - cv2.remap(image, *maps, cv2.INTER_LINEAR))[inside]
    assert inside.mean() > 0.7 and difference.max() <= 4 and difference.mean() < 0.7


def test_our_cameras_say_their_lens_and_what_it_costs(tmp_path):
    """A fisheye of 180 degrees across: the pinhole of the same focal length and size shows a third of its picture."""
    entry = {"name": "A", "w": 200, "h": 200, "R": np.eye(3).tolist(), "T": [0, 0, 0]}
    f = 100 / (np.pi / 2)
    entry |= {"K": [[f, 0, 100], [0, f, 100], [0, 0, 1]], "dist_model": "fisheye"}
    (tmp_path / "rgbs").mkdir()
    (tmp_path / "cameras.json").write_text(json.dumps([entry, entry | {"name": "B", "dist": [0.01, 0, 0, 0]}]))
    capture = open_capture(tmp_path)
    lenses = capture.recording.distortions
    assert lenses["A"] == Distortion.from_opencv([0] * 4, subject="", model=FISHEYE) and lenses["B"].k[0] == 0.01
    # The edge of the square that the pinhole shows lies between atan(100 / f) from the axis and, in corners, more.
    turn = np.linspace(0, 2 * np.pi, 10_000)
    edge = np.arctan(100 / f / np.maximum(np.abs(np.cos(turn)), np.abs(np.sin(turn))))
    expected = 1 - np.pi * f**2 * np.mean(edge**2) / 200**2
    lost = [problem.message for problem in capture.problems if "outside of the undistorted one" in problem.message]
    assert len(lost) == 2 and all(problem.camera is None for problem in capture.problems)
    assert lost_share(capture.cameras["A"], lenses["A"]) == pytest.approx(expected, abs=0.02)
    assert "camera A: 65% of the picture" in lost[0]


def test_a_lens_that_loses_its_margins_alone_is_not_mentioned(tmp_path):
    entry = {"name": "A", "w": 200, "h": 200, "R": np.eye(3).tolist(), "T": [0, 0, 0], "dist_model": "fisheye"}
    (tmp_path / "rgbs").mkdir()
    (tmp_path / "cameras.json").write_text(json.dumps([entry | {"K": [[900, 0, 100], [0, 900, 100], [0, 0, 1]]}]))
    assert not open_capture(tmp_path).problems


def test_other_models_and_other_values_are_refused():
    with pytest.raises(InputError, match="'fisheye'"):
        Distortion.from_opencv([0.1] * 4, subject="camera X", model="mei")
    for model, bad in ((FISHEYE, [0.1] * 5), (FOV, [4.0]), (FOV, [-0.1]), (FOV, []), (FOV, [0.1, 0.1])):
        with pytest.raises(InputError, match="camera X: distortion"):
            Distortion.from_opencv(bad, subject="camera X", model=model)
    for bad in ("0.1", ["0", "0", "0", "0"], {"k1": 0}, None, [True] * 4, [[0, 1], [0]], [10**5000, 0, 0, 0]):
        with pytest.raises(InputError, match="camera X: distortion"):
            Distortion.from_opencv(bad, subject="camera X")


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
