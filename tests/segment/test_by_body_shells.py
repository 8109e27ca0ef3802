"""Long faces of modelled characters are split, and what runs over into another garment's shell is that garment's."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import BodyModel, load_body
from smplxpp.clean import simplify
from smplxpp.core import LOWER, SHOE, SKIN, UPPER, BodyParams, TriangleMesh, concatenate_meshes
from smplxpp.segment import SegmentedScan, label_by_body
from smplxpp.segment.by_body_shells import garment_shells, of_whole_faces, split_long_faces


def tube(low: float, high: float, *, at: float = 0.0, radius: float = 0.1, rows: int = 2) -> TriangleMesh:
    """A tube of eight sides about the y axis, in `rows` rows of vertices."""
    turn = 2.0 * np.pi * np.arange(8) / 8
    ring = np.stack([at + radius * np.cos(turn), np.zeros(8), radius * np.sin(turn)], axis=1)
    vertices = np.concatenate([ring + [0.0, y, 0.0] for y in np.linspace(low, high, rows)])
    k = np.arange(8)
    faces = []
    for row in range(rows - 1):
        a, b = 8 * row + k, 8 * row + (k + 1) % 8
        faces += [np.stack([a, a + 8, b], axis=1), np.stack([b, a + 8, b + 8], axis=1)]
    return TriangleMesh(vertices, np.concatenate(faces))


def test_long_faces_are_split_into_the_same_surface():
    mesh = concatenate_meshes([tube(0.1, 1.0), tube(0.1, 1.0, at=1.0)])
    colors = np.where(mesh.vertices[:, 1:2] > 0.5, [[200, 0, 0]], [[0, 0, 100]]).astype(np.uint8)
    fine, shades, whole = split_long_faces(mesh, colors)
    sides = np.linalg.norm(fine.triangles - np.roll(fine.triangles, 1, axis=1), axis=2)
    assert sides.max() <= 0.045 and fine.face_areas.sum() == pytest.approx(mesh.face_areas.sum())
    # Parts lie in the face that they are of, and no edge is torn: the borders are those of the tubes.
    np.testing.assert_allclose(fine.face_normals, mesh.face_normals[whole], atol=1e-9)
    np.testing.assert_allclose(np.bincount(whole, fine.face_areas), mesh.face_areas)
    assert np.isin(fine.vertices[np.unique(fine.border_edges), 1], (0.1, 1.0)).all()
    # Colours run evenly along the tubes.
    expected = 200 * (fine.vertices[:, 1] - 0.1) / 0.9
    assert shades.dtype == np.uint8 and np.abs(shades[:, 0] - expected).max() < 4


def test_a_scan_and_what_is_no_person_are_not_split():
    """A coarse scan is one surface, hems of a finer one have some long faces; a floor would be millions of them."""
    one, fine = tube(0.0, 1.0), tube(0.0, 1.0, radius=0.03, rows=60)
    hems = [tube(1.0, 1.1, at=x, radius=0.03) for x in (0.0, 0.2)]
    many = concatenate_meshes([tube(0.0, 1.0), tube(0.0, 1.0, at=1.0)])
    for mesh in (one, concatenate_meshes([fine, fine, *hems]), many.with_vertices(1000.0 * many.vertices)):
        colors = np.zeros((mesh.vertex_count, 3), dtype=np.uint8)
        same, _, whole = split_long_faces(mesh, colors)
        assert same is mesh and np.array_equal(whole, np.arange(mesh.face_count))


def test_a_face_has_the_label_of_most_of_its_parts():
    found = SegmentedScan(np.array([4, 2, 2, 3]), np.array([0.9, 0.2, 0.4, 0.7]), np.ones(4, dtype=bool), 0, 1.0, 1.0)
    whole = of_whole_faces(found, np.array([3.0, 1.0, 1.0, 1.0]), np.array([0, 0, 0, 1]), np.array([True, False]))
    assert whole.face_labels.tolist() == [4, 3] and whole.seen.tolist() == [True, False]
    np.testing.assert_allclose(whole.confidence, [0.9, 0.7])


def test_trousers_of_their_own_shell_do_not_end_in_shoes():
    """Of a character in dark trousers over dark shoes these went up the shins, the jacket down the trousers."""
    trousers, jacket = tube(0.1, 1.0, rows=10), tube(0.8, 1.5, radius=0.2, rows=8)
    shoes = [tube(0.0, 0.15, at=x, radius=0.12, rows=3) for x in (-0.3, 0.3)]
    mesh = concatenate_meshes([trousers, jacket, *shoes])
    counts = [trousers.face_count, jacket.face_count, 2 * shoes[0].face_count]
    own = np.repeat([LOWER.id, UPPER.id, SHOE.id], counts)
    height = mesh.face_centers[:, 1]
    labels = np.where((own == LOWER.id) & (height < 0.3), SHOE.id, own)
    labels = np.where((own == LOWER.id) & (height > 0.8), UPPER.id, labels)
    sure = np.where(labels == own, 0.9, 0.4)
    found, confidence = garment_shells(mesh, labels, sure, height)
    np.testing.assert_array_equal(found, own)
    np.testing.assert_allclose(confidence, 0.9)
    # Trousers that were shoes up to the thighs are trousers.
    most = np.where((own == LOWER.id) & (height < 0.6), SHOE.id, own)
    np.testing.assert_array_equal(garment_shells(mesh, most, sure, height)[0], own)
    # Skin in a shell, such as the hands of a body, stays, and so do all clothes of a figure in one piece.
    bare = np.where(height > 1.4, SKIN.id, labels)
    assert (garment_shells(mesh, bare, sure, height)[0][height > 1.4] == SKIN.id).all()
    one = tube(0.0, 1.6, rows=20)
    dressed = np.select([one.face_centers[:, 1] < 0.1, one.face_centers[:, 1] < 0.9], [SHOE.id, LOWER.id], UPPER.id)
    everything = concatenate_meshes([one, *shoes])
    labels = np.concatenate([dressed, np.full(2 * shoes[0].face_count, SHOE.id)])
    kept = garment_shells(everything, labels, np.ones(len(labels)), everything.face_centers[:, 1])[0]

    assert np.array_equal(kept[: one.face_count] == UPPER.id, dressed == UPPER.id)


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body()


@pytest.mark.long
def test_a_coarse_figure_has_a_label_for_each_of_its_own_faces(body):
    """Most rings about the shins of a character had no centre of a face."""
    params = BodyParams.rest()
    coarse = simplify(body.mesh(body.forward(params).vertices[0]), 1200).mesh
    side = coarse.face_centers[:, 0] > 0
    coarse = concatenate_meshes([coarse.submesh(own)[0] for own in (side, ~side)])
    blue = np.abs(coarse.vertices[:, :1]) < 0.15
    colors = np.where(blue, [[20, 40, 120]], [[220, 180, 150]]).astype(np.uint8)
    assert split_long_faces(coarse, colors)[0].face_count > coarse.face_count
    found = label_by_body(coarse, body, params, colors=colors)
    assert found.face_labels.shape == found.confidence.shape == found.seen.shape == (coarse.face_count,)
    assert found.seen.mean() > 0.5 and 0.0 <= found.confidence.min() <= found.confidence.max() <= 1.0
