"""Corrections by hand: their file, the faces that they mean, and labels with them applied."""

from __future__ import annotations

import json

import numpy as np
import pytest
import trimesh

from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.labels import HAIR, LOWER, SHOE, SKIN, UPPER
from smplxpp.core.mesh import TriangleMesh, concatenate_meshes
from smplxpp.core.rotations import matrix_from_rotvec
from smplxpp.segment import BoxCorrection, Corrections, FaceCorrection, StrokeCorrection, segment_scan
from smplxpp.segment.corrected_faces import ScanSurface
from smplxpp.segment.corrections import faces_of, scan_digest


def tube(x: float, *, rings: int = 120, sides: int = 48) -> TriangleMesh:
    """A leg: 6 cm in radius, a metre high, at x, open at both ends."""
    angle, height = np.linspace(0, 2 * np.pi, sides, endpoint=False), np.linspace(0, 1, rings + 1)
    points = np.stack(np.broadcast_arrays(0.06 * np.sin(angle), height[:, None], 0.06 * np.cos(angle)), axis=-1)
    k, ring = np.arange(sides), sides * np.arange(rings)[:, None]
    a, b = ring + k, ring + (k + 1) % sides
    c, d = a + sides, b + sides
    faces = np.concatenate([np.stack([a, b, d], -1).reshape(-1, 3), np.stack([a, d, c], -1).reshape(-1, 3)])
    return TriangleMesh(points.reshape(-1, 3) + [x, 0, 0], faces)


@pytest.fixture(scope="module")
def legs() -> TriangleMesh:
    """Two of them, 1 cm apart."""
    return concatenate_meshes([tube(-0.065), tube(0.065)])


@pytest.fixture(scope="module")
def surface(legs):
    return ScanSurface(legs)


def front_stroke(radius=0.03, label=UPPER.id, x=-0.065) -> StrokeCorrection:
    """Down the front of the leg at x."""
    height = np.linspace(0.3, 0.7, 40)
    points = np.stack([np.full(40, x), height, np.full(40, 0.06)], axis=1)
    return StrokeCorrection(label, points, radius, np.tile([0.0, 0.0, 1.0], (40, 1)))


def area_of(mesh, faces):
    return mesh.face_areas[faces].sum()


def test_a_stroke_takes_the_surface_within_its_radius(legs, surface):
    faces = faces_of(front_stroke(), surface)
    centers = legs.face_centers[faces]
    assert len(np.unique(faces)) == len(faces)
    line = np.array([-0.065, 0.0, 0.06])
    away = np.linalg.norm((centers - line) * [1, 0, 1], axis=1)
    assert away.max() < 0.031 and 0.27 < centers[:, 1].min() < 0.31 and 0.69 < centers[:, 1].max() < 0.73
    # A band of 2 x 30 mm along the arc, 400 mm long, and two half discs.
    assert area_of(legs, faces) == pytest.approx(0.4 * 0.0606 + np.pi * 0.03**2, rel=0.08)


def test_a_wide_stroke_leaves_the_back_and_the_other_leg(legs, surface):
    inner = StrokeCorrection(
        UPPER.id, np.array([[-0.005, 0.5, 0.0]]), 0.05, np.array([[1.0, 0.0, 0.0]])
    )  # between the legs
    centers = legs.face_centers[faces_of(inner, surface)]
    assert (centers[:, 0] < -0.004).all() and len(centers) > 50
    through = front_stroke(radius=0.14)  # reaches through to the back and over to the other leg
    faces = faces_of(through, surface)
    centers = legs.face_centers[faces]
    assert (centers[:, 0] < 0).all() and (legs.face_normals[faces, 2] > 0).all()


def test_a_stroke_stays_on_the_side_that_it_was_drawn_on():
    """Two sheets 2 mm apart, front and back of a cloth: its normal says which."""
    cloth = trimesh.creation.box(extents=(0.4, 0.4, 0.002))
    for _ in range(5):
        cloth = cloth.subdivide()
    cloth = TriangleMesh(cloth.vertices, cloth.faces)
    line = np.array([[-0.1, 0.0, 0.001], [0.1, 0.0, 0.001]])
    for side in (1.0, -1.0):
        stroke = StrokeCorrection(UPPER.id, line * [1, 1, side], 0.04, np.tile([0.0, 0.0, side], (2, 1)))
        normals = cloth.face_normals[faces_of(stroke, ScanSurface(cloth))]
        assert len(normals) > 100 and (normals[:, 2] * side > 0.9).all()


def test_strokes_turn_with_the_scan(legs):
    turn, move = matrix_from_rotvec(np.array([0.3, 1.0, -0.4])), np.array([1.0, 2.0, -0.5])
    moved = TriangleMesh(legs.vertices @ turn.T + move, legs.faces)
    stroke = front_stroke(x=-0.0632)  # along no edges
    there = StrokeCorrection(stroke.label, stroke.points @ turn.T + move, stroke.radius, stroke.normals @ turn.T)
    a, b = (set(faces_of(s, ScanSurface(m)).tolist()) for s, m in ((stroke, legs), (there, moved)))
    assert len(a ^ b) < 0.01 * len(a | b)  # centres on the rim


def test_a_box_takes_both_sides(legs, surface):
    low, high = np.array([-0.2, 0.9, -0.2]), np.array([0.0, 1.1, 0.2])
    straight = BoxCorrection(HAIR.id, 0.5 * (low + high), high - low, np.eye(3))
    faces = faces_of(straight, surface)
    centers = legs.face_centers
    np.testing.assert_array_equal(faces, np.flatnonzero(((centers > low) & (centers < high)).all(axis=1)))
    turned = BoxCorrection(
        HAIR.id,
        np.array([-0.065, 0.5, 0.0]),
        np.array([0.01, 2.0, 1.0]),
        matrix_from_rotvec(np.array([0, np.pi / 4, 0])),
    )
    found = legs.face_centers[faces_of(turned, surface)]
    axis = turned.rotation[:, 0]
    assert len(found) and np.abs((found - turned.center) @ axis).max() <= 0.005


def test_later_corrections_cover_earlier_ones(legs):
    labels = np.where(np.arange(legs.face_count) % 2, LOWER.id, SKIN.id)
    segmented = segment_scan(legs, face_labels=labels)
    wide, narrow = front_stroke(0.04, UPPER.id), front_stroke(0.01, SHOE.id)
    result = Corrections((wide, narrow)).apply(legs, segmented)
    faces = [faces_of(s, ScanSurface(legs)) for s in (wide, narrow)]
    assert (result.face_labels[faces[1]] == SHOE.id).all()
    assert (result.face_labels[np.setdiff1d(*faces)] == UPPER.id).all()
    assert (result.confidence[result.corrected] == 1).all() and result.seen[result.corrected].all()
    rest = ~result.corrected
    np.testing.assert_array_equal(np.flatnonzero(~rest), np.union1d(*faces))
    np.testing.assert_array_equal(result.face_labels[rest], segmented.face_labels[rest])
    np.testing.assert_array_equal(result.confidence[rest], segmented.confidence[rest])
    turned = Corrections((narrow, wide)).apply(legs, segmented)
    assert (turned.face_labels[np.union1d(*faces)] == UPPER.id).all()


def test_faces_of_the_same_scan_are_taken_by_number(legs, surface):
    chosen = FaceCorrection.of(legs, UPPER.id, np.array([3, 5, 800]))
    assert faces_of(chosen, surface).tolist() == [3, 5, 800]
    with pytest.raises(InputError, match="faces 0 to"):
        faces_of(FaceCorrection(UPPER.id, np.array([legs.face_count])), surface)


@pytest.mark.parametrize("seed", [0, 1])
def test_faces_are_found_again_in_another_triangulation(legs, surface, seed):
    """A finer one, with noise and numbered otherwise: by their places, with the area that they had."""
    stroked = faces_of(front_stroke(), surface)
    item = FaceCorrection.of(legs, UPPER.id, stroked)
    rng = np.random.default_rng(seed)
    other = concatenate_meshes([tube(-0.065, rings=200, sides=60), tube(0.065, rings=200, sides=60)])
    order = rng.permutation(other.face_count)
    other = TriangleMesh(other.vertices + rng.normal(0, 3e-4, other.vertices.shape), other.faces[order])
    with pytest.warns(GeometryWarning, match="the scan has changed since"):
        found = faces_of(item, ScanSurface(other))
    assert area_of(other, found) == pytest.approx(area_of(legs, stroked), rel=0.05)
    expected = faces_of(front_stroke(), ScanSurface(other))
    agree = area_of(other, np.intersect1d(found, expected)) / area_of(other, np.union1d(found, expected))
    assert agree > 0.9


def test_a_few_small_faces_are_found_on_a_coarse_scan(legs):
    item = FaceCorrection.of(legs, UPPER.id, faces_of(front_stroke(0.004), ScanSurface(legs))[:3])
    coarse = concatenate_meshes([tube(x, rings=20, sides=12) for x in (-0.065, 0.065)])
    with pytest.warns(GeometryWarning, match="found again"):
        found = faces_of(item, ScanSurface(coarse))
    assert 1 <= len(found) <= 3 and (coarse.face_normals[found, 2] > 0.8).all()


def test_faces_of_another_scan_without_places_are_refused(legs, surface):
    item = FaceCorrection(UPPER.id, np.array([1]), None, "0" * 64)
    with pytest.raises(InputError, match=r"correction 2 \(upper\).*another scan"):
        Corrections((front_stroke(), item)).face_labels(legs, np.zeros(legs.face_count, dtype=np.int64))


def test_what_lies_beside_the_scan_changes_nothing_and_is_said(legs, surface):
    far = BoxCorrection(UPPER.id, np.array([5.0, 0, 0]), np.ones(3), np.eye(3))
    away = StrokeCorrection(UPPER.id, np.array([[5.0, 0.0, 0.0]]), 0.02)
    for item in (far, away):
        with pytest.warns(GeometryWarning, match=r"correction 1 \(upper\).*changes nothing"):
            labels, by = Corrections((item,)).face_labels(legs, np.zeros(legs.face_count, dtype=np.int64))
        assert not labels.any() and (by == -1).all()


# --- the file -------------------------------------------------------------------------------------------------------


def test_a_file_is_read_as_it_was_written(legs, surface, tmp_path):
    turned = BoxCorrection(
        SHOE.id, np.array([0.0, 0.5, 0.0]), np.ones(3), matrix_from_rotvec(np.array([0.1, 0.5, 0.0]))
    )
    straight = BoxCorrection(HAIR.id, np.array([0.0, 1.0, 0.0]), np.full(3, 0.1), np.eye(3))
    strokes = (front_stroke(), StrokeCorrection(LOWER.id, front_stroke().points, 0.01))
    faces = FaceCorrection.of(legs, LOWER.id, np.arange(40))
    written = Corrections((*strokes, straight, turned, faces))
    path = tmp_path / "labels_corrections.json"
    written.save(path)
    read = Corrections.load(path)
    none = np.full(legs.face_count, SKIN.id)
    for a, b in zip(written.face_labels(legs, none), read.face_labels(legs, none), strict=True):
        assert (a == b).mean() > 0.999
    assert read.items[-1].scan == scan_digest(legs)
    assert len(path.read_text().splitlines()) == 5 + 5  # a line a correction
    Corrections().save(path)
    assert len(Corrections.load(path)) == 0


def test_a_file_written_by_hand(legs, tmp_path):
    path = tmp_path / "c.json"
    rows = [
        {"label": "hair", "box": {"min": [-1, 0.9, -1], "max": [1, 2, 1]}},
        {"label": "shoe", "box": {"center": [0, 0, 0], "size": [1, 0.2, 1], "rotvec": [0, 0.5, 0]}},
        {"label": "skin", "stroke": [[0.065, 0.5, 0.06]], "radius": 0.02},
        {"label": "upper", "faces": [0, 1, 2]},
    ]
    path.write_text(json.dumps({"corrections": rows}))
    labels, by = Corrections.load(path).face_labels(legs, np.full(legs.face_count, LOWER.id))
    assert set(np.unique(by)) == {-1, 0, 1, 2, 3}
    assert {int(labels[by == k][0]) for k in range(4)} == {HAIR.id, SHOE.id, SKIN.id, UPPER.id}


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ({"faces": [0]}, "correction 1: label"),
        ({"label": "coat", "faces": [0]}, "'skin' or 'hair'"),
        ({"label": "upper"}, "one of box, faces, stroke"),
        ({"label": "upper", "faces": [0], "box": {}}, "one of box, faces, stroke"),
        ({"label": "upper", "faces": []}, "1 to"),
        ({"label": "upper", "faces": [-1]}, "whole numbers from 0"),
        ({"label": "upper", "faces": [0.5]}, "whole numbers from 0"),
        ({"label": "upper", "faces": [1, 2], "triangles": [[[0, 0, 0]] * 3]}, r"shape \(2, 3, 3\)"),
        ({"label": "upper", "stroke": [[0, 0, 0]]}, "radius"),
        ({"label": "upper", "stroke": [[0, 0, 0]], "radius": 0}, "radius"),
        ({"label": "upper", "stroke": [[0, 0, 0], [0, 1, 0]], "radius": 0.1}, "at most 0.25 m apart"),
        ({"label": "upper", "stroke": [[0, 0, 1e6]], "radius": 0.1}, "metres"),
        ({"label": "upper", "stroke": [], "radius": 0.1}, "1 to 10000 points"),
        ({"label": "upper", "box": {"min": [0, 0, 0], "max": [1, 0, 1]}}, "longer than 0"),
        ({"label": "upper", "box": {"center": [0, 0, 0]}}, "size"),
    ],
)
def test_other_files_are_refused_by_entry(tmp_path, row, words):
    path = tmp_path / "c.json"
    path.write_text(json.dumps({"version": 1, "corrections": [row]}))
    with pytest.raises(InputError, match=words):
        Corrections.load(path)


@pytest.mark.parametrize(
    ("content", "words"), [([], "an object"), ({}, "a list"), ({"version": 2, "corrections": []}, "version")]
)
def test_other_layouts_are_refused(tmp_path, content, words):
    path = tmp_path / "c.json"
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=words):
        Corrections.load(path)
