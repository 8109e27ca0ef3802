"""Landmarks of a bare scan by pictures all around: known spots on a body come back where they are."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.build.scan_keypoints import ScanViews, facing, keypoints_of_scan
from smplxpp.core import InputError, TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_mesh
from smplxpp.detect import DetectedPerson
from tests.conftest import ROOT

NAMES = ("coco_left_shoulder", "coco_right_shoulder", "nose")
VIEWS = ScanViews(count=8, height=240)


class Spots:
    """Finds the reddest, greenest and bluest patch of a picture; `swap` exchanges the first two in some pictures."""

    names, identity = NAMES, "spots"

    def __init__(self, swap: tuple[int, ...] = (), blind: int = 0) -> None:
        self.swap, self.blind, self.count = swap, blind, 0

    def __call__(self, image, box=None):
        self.count += 1
        if self.count <= self.blind:
            return []
        points, confidence = np.zeros((3, 2)), np.zeros(3)
        for k in range(3):
            others = np.delete(image.astype(float), k, axis=2).max(axis=2)
            rows, columns = np.nonzero(image[..., k] > others + 60)
            if len(rows) >= 4:
                points[k], confidence[k] = (columns.mean() + 0.5, rows.mean() + 0.5), 0.9
        if self.count in self.swap:
            points[:2], confidence[:2] = points[1::-1].copy(), confidence[1::-1].copy()
        return [DetectedPerson(points, confidence)] if confidence.any() else []


@pytest.fixture(scope="module")
def painted() -> tuple[TriangleMesh, np.ndarray, np.ndarray]:
    """The body, grey, with a spot in front of each shoulder and on the nose; their centres."""
    body = load_body()
    mesh = body.mesh()
    colors = np.full((mesh.vertex_count, 3), 128, np.uint8)
    height = np.ptp(mesh.vertices[:, 1])
    top = mesh.vertices[:, 1].max()
    centres = []
    for k, at in enumerate(([0.11, top - 0.25 * height], [-0.11, top - 0.25 * height], [0.0, top - 0.08 * height])):
        front = mesh.vertices[:, 2] > 0
        near = front & (np.linalg.norm(mesh.vertices[:, :2] - at, axis=1) < 0.03)
        assert near.sum() > 5
        colors[near] = np.eye(3, dtype=np.uint8)[k] * 220
        centres.append(mesh.vertices[near].mean(axis=0))
    return mesh, colors, np.array(centres)


def turned(points: np.ndarray, degrees: float) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]).T


@pytest.mark.parametrize("degrees", [0.0, 77.0, 180.0])
def test_spots_are_found_where_they_are_however_the_scan_is_turned(painted, degrees):
    mesh, colors, centres = painted
    shown = TriangleMesh(turned(mesh.vertices, degrees) + [3.0, 1.0, -2.0], mesh.faces)
    found = keypoints_of_scan(shown, colors, Spots(), config=VIEWS)
    points = np.stack([found[name][0] for name in NAMES])
    # A pixel is eight millimetres; patches are seen aslant from the sides.
    np.testing.assert_allclose(points, turned(centres, degrees) + [3.0, 1.0, -2.0], atol=0.015)
    assert all(0 < confidence <= 1 for _, confidence in found.values())
    true = turned(np.array([[0.0, 0.0, 1.0]]), degrees)[0]
    assert facing(found) @ true > np.cos(np.radians(5))


def test_pictures_with_sides_exchanged_are_outvoted(painted):
    mesh, colors, centres = painted
    views = ScanViews(count=16, height=240)
    found = keypoints_of_scan(mesh, colors, Spots(swap=(2,)), config=views)
    np.testing.assert_allclose(found[NAMES[0]][0], centres[0], atol=0.02)


def test_progress_is_told(painted):
    mesh, colors, _ = painted
    told = []
    keypoints_of_scan(mesh, colors, Spots(), config=VIEWS, progress=lambda step, share: told.append((step, share)))
    assert told == [("views", k / 8) for k in range(1, 9)]


def test_a_scan_without_anybody_is_refused(painted):
    mesh, colors, _ = painted
    with pytest.raises(InputError, match="one in 0 of 8 pictures"):
        keypoints_of_scan(mesh, None, Spots(), config=VIEWS)
    with pytest.raises(InputError, match="no two pictures agree"):
        keypoints_of_scan(mesh, colors, Spots(), config=ScanViews(count=8, height=240, least_views=8))
    with pytest.raises(InputError, match="count"):
        ScanViews(count=2)


def test_facing_is_not_told_without_sides():
    assert facing({"nose": (np.zeros(3), 1.0), "left_eye": (np.ones(3), 1.0)}) is None
    front = facing({"left_eye": (np.array([0.1, 1.0, 0.0]), 1.0), "right_eye": (np.array([-0.1, 1.1, 0.0]), 1.0)})
    np.testing.assert_allclose(front, [0.0, 0.0, 1.0])


@pytest.mark.parametrize("colored", [True, False])
def test_mediapipe_tells_where_the_fixtures_scan_faces(colored):
    pytest.importorskip("mediapipe", exc_type=ImportError)
    from smplxpp.body import load_params
    from smplxpp.detect import load_detector
    from smplxpp.register import LandmarkModel

    fixture, body = ROOT / "data" / "fixtures" / "person", load_body()
    scan = read_mesh(fixture / "scans" / "scan_000000.ply")
    posed = body.forward(load_params(fixture / "params" / "params.npz", body=body).frame(0))
    detector = load_detector()
    model = LandmarkModel.of(body, detector.names)
    truth = dict(zip(model.names, turned(model.points(posed.vertices[0], posed.joints[0]), 100.0), strict=True))
    mesh = TriangleMesh(turned(scan.mesh.vertices, 100.0), scan.mesh.faces)
    views = ScanViews(count=8, height=480)
    found = keypoints_of_scan(mesh, scan.vertex_colors if colored else None, detector, config=views)
    true = facing({name: (point, 1.0) for name, point in truth.items()})
    assert facing(found) @ true > np.cos(np.radians(20))
    apart = [np.linalg.norm(point - truth[name]) for name, (point, _) in found.items() if name.startswith("coco_")]
    assert len(apart) >= 9 and np.median(apart) < 0.03
