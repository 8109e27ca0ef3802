"""Sessions: brushes, patches, boxes, landmarks, undo, and what is written; where labels are doubtful."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.viewer.session import LabelledScan, LabelSession, uncertain_regions
from smplxpp.core import HAIR, LOWER, SHOE, SKIN, UPPER, InputError, concatenate_meshes
from smplxpp.register import read_landmarks
from smplxpp.segment import Corrections
from smplxpp.segment.corrected_faces import ScanSurface
from tests.segment.test_corrections import tube


@pytest.fixture(scope="module")
def scan() -> LabelledScan:
    """Two legs: trousers above, shoes below."""
    mesh = concatenate_meshes([tube(-0.2), tube(0.2)])
    labels = np.where(mesh.face_centers[:, 1] > 0.2, LOWER.id, SHOE.id)
    colors = np.full((mesh.vertex_count, 3), 90, dtype=np.uint8)
    return LabelledScan(mesh, colors, labels, np.full(mesh.face_count, 0.8))


@pytest.fixture
def session(scan) -> LabelSession:
    return LabelSession(scan)


def front(y: float, x: float = 0.2) -> tuple[np.ndarray, np.ndarray]:
    """A line of 10 cm up the front of a leg."""
    points = np.stack([np.full(6, x), y + np.linspace(0, 0.1, 6), np.full(6, 0.06)], axis=1)
    return points, np.tile([0.0, 0.0, 1.0], (6, 1))


def test_a_brush_paints_and_undo_takes_it_back(session, scan):
    count = session.brush(UPPER.id, [front(0.5), front(0.5, x=-0.2)], 0.02)
    labels = session.labels()
    assert count == (labels == UPPER.id).sum() == session.corrected().sum() > 50
    assert (session.confidence()[session.corrected()] == 1).all() and len(session.corrections) == 2
    assert session.changed
    assert session.undo() == "upper painted" and len(session.corrections) == 0
    np.testing.assert_array_equal(session.labels(), scan.labels)
    assert not session.corrected().any() and session.undo() == ""


def test_a_patch_is_relabelled_as_far_as_it_reaches(session, scan):
    shoe = int(np.flatnonzero((scan.labels == SHOE.id) & (scan.mesh.face_centers[:, 0] > 0))[0])
    count = session.patch(SKIN.id, shoe)
    own = (scan.labels == SHOE.id) & (scan.mesh.face_centers[:, 0] > 0)
    np.testing.assert_array_equal(session.labels() == SKIN.id, own)
    assert count == own.sum()
    session.brush(UPPER.id, [front(0.5)], 0.02)
    painted = int(np.flatnonzero(session.labels() == UPPER.id)[0])
    session.patch(LOWER.id, painted)  # what is painted is a patch too
    assert not (session.labels() == UPPER.id).any()


def test_a_box_takes_what_is_in_it(session, scan):
    assert session.box(HAIR.id, np.array([0.2, 1.0, 0.0]), np.full(3, 0.2), np.eye(3)) > 0
    assert session.box(HAIR.id, np.array([0.0, 5.0, 0.0]), np.full(3, 0.2), np.eye(3)) == 0
    assert len(session.corrections) == 1 and (scan.mesh.face_centers[session.corrected(), 1] >= 0.9).all()


def test_one_correction_of_several_is_removed(session):
    for label, y in ((UPPER.id, 0.3), (HAIR.id, 0.5), (SKIN.id, 0.7)):
        session.brush(label, [front(y)], 0.02)
    session.remove(1)
    assert set(np.unique(session.labels())) == {SKIN.id, SHOE.id, UPPER.id, LOWER.id}
    assert "correction 2 (hair)" in session.undo() and (session.labels() == HAIR.id).any()


def test_landmarks_are_placed_moved_and_removed(session):
    session.place("nose", np.array([0.0, 1.0, 0.1]))
    session.place("nose", np.array([0.0, 1.1, 0.1]))
    session.place("left_knee", np.array([0.2, 0.5, 0.0]))
    session.remove_landmark("left_knee")
    assert list(session.landmarks) == ["nose"] and session.landmarks["nose"][1] == 1.1
    assert session.undo() == "left_knee removed" and set(session.landmarks) == {"nose", "left_knee"}
    session.undo()
    session.undo()
    assert session.landmarks["nose"][1] == 1.0


def test_saved_and_opened_again_it_is_the_same(session, scan, tmp_path):
    assert session.save(tmp_path) == [] and not list(tmp_path.iterdir())
    session.brush(UPPER.id, [front(0.5)], 0.02)
    session.patch(SKIN.id, 0)
    session.place("nose", np.array([0.0, 1.0, 0.1]))
    assert session.save(tmp_path) == ["labels_corrections.json", "landmarks.json"] and not session.changed
    corrections, landmarks = (
        Corrections.load(tmp_path / "labels_corrections.json"),
        read_landmarks(tmp_path / "landmarks.json"),
    )
    again = LabelSession(scan, corrections, landmarks)
    assert (again.labels() == session.labels()).mean() > 0.999
    assert again.landmarks["nose"].tolist() == [0.0, 1.0, 0.1]
    # What is taken back is taken back in the files too.
    again.remove(1)
    again.remove(0)
    again.remove_landmark("nose")
    assert again.changed and len(again.save(tmp_path)) == 2
    assert len(Corrections.load(tmp_path / "labels_corrections.json")) == 0
    assert read_landmarks(tmp_path / "landmarks.json") == {}


def test_a_scan_without_labels_takes_landmarks_alone(scan):
    session = LabelSession(LabelledScan(scan.mesh, scan.colors, None, None))
    session.place("nose", np.zeros(3))
    assert not session.has_labels and session.changed
    for correct in (
        lambda: session.brush(UPPER.id, [front(0.5)], 0.02),
        lambda: session.patch(UPPER.id, 0),
        lambda: session.labels(),
    ):
        with pytest.raises(InputError, match="labels"):
            correct()


def test_doubtful_regions_are_patches_by_doubt(scan):
    mesh, middle, surface = scan.mesh, scan.mesh.face_centers, ScanSurface(scan.mesh)
    confidence = np.ones(mesh.face_count)
    high, low = (middle[:, 1] > 0.8) & (middle[:, 0] > 0), (middle[:, 1] < 0.1) & (middle[:, 0] < 0)
    confidence[high], confidence[low] = 0.5, 0.2
    lone = int(np.flatnonzero((middle[:, 1] > 0.4) & (middle[:, 1] < 0.6))[0])
    confidence[lone] = 0.0
    none = np.zeros(mesh.face_count, dtype=bool)
    first, second = uncertain_regions(surface, scan.labels, confidence, none)  # one face is too little
    assert first.label == LOWER.id and second.label == SHOE.id
    assert first.area == pytest.approx(mesh.face_areas[high].sum()) and first.confidence == pytest.approx(0.5)
    np.testing.assert_allclose(second.center, [-0.2, 0.05, 0.0], atol=0.01)
    (left,) = uncertain_regions(surface, scan.labels, confidence, high)
    assert left.label == SHOE.id
    assert uncertain_regions(surface, scan.labels, np.ones(mesh.face_count), none) == []
