"""Every reader on a known scene written in its set's exact layout: cameras, images, masks, parameters, meshes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.capture import FORMATS, detect_format, open_capture
from smplxpp.capture.distortion import Distortion
from smplxpp.raster import rasterize_mesh
from tests.capture.scene import SKIN, make_scene, overlap
from tests.capture.writers import WRITERS

# COLMAP's and NeuS2's folders hold no body parameters; NeuS2's and 4D-Dress's number their frames in their own way.
WITHOUT_PARAMS = {"neus2", "instant-ngp", "colmap-text", "colmap-binary", "rig"}
FIRST_FRAME = {"4ddress": 11}
CAMERA_NAMES = {"thuman4": ("cam00", "cam01", "cam02"), "neus2": ("image_c_000", "image_c_001", "image_c_002")}


@pytest.fixture(params=WRITERS)
def written(request, tmp_path):
    """(name, scene, capture)."""
    name = request.param
    _, write, lens = WRITERS[name]
    scene = make_scene(
        lens=lens, square_pixels=name == "colmap-binary", names=CAMERA_NAMES.get(name, ("Cam1", "Cam2", "Cam3"))
    )
    root = write(scene, tmp_path / "set")
    return name, scene, open_capture(root)


def test_the_format_is_told_by_the_files(written):
    name, _, capture = written
    assert capture.format == WRITERS[name][0] == detect_format(capture.root)
    assert open_capture(capture.root, format=capture.format).format == capture.format


def test_every_format_has_a_writer():
    assert {entry[0] for entry in WRITERS.values()} == set(FORMATS)


def test_cameras_are_recovered(written):
    name, scene, capture = written
    # EasyMocap's writer prints six digits.
    tolerance = 2e-5 if name == "easymocap" else 1e-9
    assert list(capture.cameras) == list(scene.cameras)
    for true, read in zip(scene.cameras.values(), capture.cameras.values(), strict=True):
        assert (read.width, read.height) == (true.width, true.height)
        np.testing.assert_allclose(read.cam_from_world, true.cam_from_world, atol=tolerance)
        np.testing.assert_allclose(read.K, true.K, rtol=tolerance, atol=tolerance)
    expected = None if scene.lens is None else Distortion.from_opencv(scene.lens, subject="")
    assert all(capture.recording.distortions.get(camera) == expected for camera in capture.cameras)


def test_the_scene_projects_onto_the_masks(written):
    """And with the wrong convention it does not: camera-to-world for world-to-camera, OpenGL's axes, PyTorch3D's."""
    name, scene, capture = written
    flips = [np.diag([1.0, -1, -1, 1]), np.diag([-1.0, -1, 1, 1])]
    for frame in scene.meshes if name != "instant-ngp" else [0]:
        for camera in capture.cameras.values():
            mask = capture.mask(camera.name, frame + FIRST_FRAME.get(name, 0)) > 127
            drawn = rasterize_mesh(scene.meshes[frame], camera).mask
            assert overlap(drawn, mask) > 0.98
            wrong = [np.linalg.inv(camera.cam_from_world), *(flip @ camera.cam_from_world for flip in flips)]
            for pose in wrong:
                other = rasterize_mesh(scene.meshes[frame], replace(camera, cam_from_world=pose)).mask
                assert overlap(other, mask) < 0.5


def test_the_body_posed_with_the_parameters_fills_the_masks(written):
    name, scene, capture = written
    frame = 1 + FIRST_FRAME.get(name, 0)
    if name in WITHOUT_PARAMS:
        assert capture.params(frame) is None
        return
    body = load_body()
    params = capture.params(frame)
    vertices = body.forward(params).vertices[0]
    np.testing.assert_allclose(vertices, scene.meshes[1].vertices, atol=2e-6)
    camera = next(iter(capture.cameras.values()))
    drawn = rasterize_mesh(body.mesh(vertices), camera).mask
    assert overlap(drawn, capture.mask(camera.name, frame) > 127) > 0.98


def test_the_person_is_composited_on_any_colour(written):
    name, _, capture = written
    camera, frame = next(iter(capture.cameras)), FIRST_FRAME.get(name, 0)
    for capture_ in (capture, capture.resized(0.5)):
        mask = capture_.mask(camera, frame)
        out = capture_.composited(camera, frame, (0.0, 1.0, 0.0))
        np.testing.assert_allclose(np.median(out[mask == 255], axis=0) * 255, SKIN, atol=10)
        assert np.abs(out[mask == 0] - [0, 1, 0]).max() < 0.05


def test_true_meshes_are_given_where_the_set_has_them(written):
    name, scene, capture = written
    if name == "4ddress":
        np.testing.assert_allclose(capture.truth_mesh(12).vertices, scene.meshes[1].vertices, atol=1e-6)
    else:
        assert capture.truth_mesh(0) is None


def test_both_calibrations_of_the_ground_truth_capture_cast_the_same_rays(captures):
    """Read as our layout (cameras.json) and as ActorsHQ (calibration.csv): corners and middle of every image."""
    ours, theirs = (open_capture(captures / "woman_casual", format=name) for name in ("simple", "actorshq"))
    assert ours.frames == theirs.frames and list(ours.cameras) == list(theirs.cameras)
    for a, b in zip(ours.cameras.values(), theirs.cameras.values(), strict=True):
        pixels = np.array([[x * a.width, y * a.height, 1.0] for x in (0, 0.5, 1) for y in (0, 0.5, 1)]).T
        rays = []
        for camera in (a, b):
            directions = camera.cam_from_world[:3, :3].T @ np.linalg.solve(camera.K, pixels)
            rays.append(
                np.vstack([directions / np.linalg.norm(directions, axis=0), camera.position[:, None].repeat(9, 1)])
            )
        np.testing.assert_allclose(*rays, atol=1e-6)
