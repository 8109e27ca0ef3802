"""Labels of a clothed scan from geometry, colours and the fitted body."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from smplxpp.body import BodyModel, load_body, load_params
from smplxpp.clean import simplify
from smplxpp.core.errors import InputError
from smplxpp.core.labels import LABELS, LOWER, UPPER
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.mesh_files.mesh_io import read_mesh
from smplxpp.core.params import BodyParams
from smplxpp.core.rotations import matrix_from_rotvec, rotvec_from_matrix
from smplxpp.segment import SegmentedScan, label_by_body, read_labels, segment_scan
from smplxpp.synth.tracker import tracker_noise

PERSON = Path(__file__).resolve().parents[2] / "data/fixtures/person"


@pytest.fixture(scope="module")
def body() -> BodyModel:
    return load_body()


@pytest.fixture(scope="module")
def scanned(body) -> tuple[TriangleMesh, np.ndarray, np.ndarray, BodyParams]:
    """The fixture's scan with a seventh of its faces, its colours, true labels of faces, and its body's parameters."""
    file = read_mesh(PERSON / "scans/scan_000000.ply")
    labels = read_labels(
        PERSON / "scans/scan_000000_labels.npz",
        vertex_count=file.mesh.vertex_count,
        face_count=file.mesh.face_count,
        label_set="capture",
    )
    coarse = simplify(file.mesh, 12_000)
    corner = labels[coarse.source_vertex][coarse.mesh.faces]
    truth = np.where(corner[:, 1] == corner[:, 2], corner[:, 1], corner[:, 0])
    params = load_params(PERSON / "params/params.npz", body=body).frame(0)
    return coarse.mesh, file.vertex_colors[coarse.source_vertex], truth, params


@pytest.fixture(scope="module")
def labelled(body, scanned) -> SegmentedScan:
    """That scan's labels."""
    mesh, colors, _, params = scanned
    return label_by_body(mesh, body, params, colors=colors)


def accuracy(mesh: TriangleMesh, labels: np.ndarray, truth: np.ndarray) -> float:
    return float(mesh.face_areas @ (labels == truth) / mesh.face_areas.sum())


@pytest.mark.long
def test_a_clothed_scan_is_labelled_though_the_body_is_a_little_wrong(body, scanned):
    mesh, colors, truth, params = scanned
    wrong = tracker_noise(params, seed=3, degrees=2.5, transl=0.01, betas=0.4)
    result = label_by_body(mesh, body, wrong, colors=colors)
    assert accuracy(mesh, result.face_labels, truth) > 0.95
    right = result.face_labels == truth
    sure = result.confidence > np.median(result.confidence)
    assert right[sure].mean() > right[~sure].mean()
    assert result.seen.mean() > 0.9
    again = label_by_body(mesh, body, wrong, colors=colors)
    assert np.array_equal(again.face_labels, result.face_labels)


@pytest.mark.long
def test_the_direction_she_faces_does_not_matter(body, scanned, labelled):
    mesh, colors, _, params = scanned
    angle = np.radians(110.0)
    turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
    root = body.forward(params).joints[0, 0]
    vertices = (mesh.vertices - root) @ turn.T + root
    turned = replace(params, global_orient=rotvec_from_matrix(turn @ matrix_from_rotvec(params.global_orient)))
    after = label_by_body(mesh.with_vertices(vertices), body, turned, colors=colors)
    assert accuracy(mesh, after.face_labels, labelled.face_labels) > 0.999


@pytest.mark.long
def test_without_colours_it_says_so(body, scanned):
    mesh, colors, _, params = scanned
    for given in (None, np.full_like(colors, 128)):
        result = label_by_body(mesh, body, params, colors=given)
        assert any("no colours" in note for note in result.notes)


@pytest.mark.long
def test_nothing_tells_a_closed_jacket_from_a_shirt(body, scanned):
    whole = read_mesh(PERSON / "scans/scan_000000.ply")  # with all of its faces, on which confidences lean
    result = label_by_body(whole.mesh, body, scanned[3], colors=whole.vertex_colors)
    assert result.confidence[result.face_labels == UPPER.id].max() < 0.95
    assert np.median(result.confidence[result.face_labels == LOWER.id]) > 0.95


@pytest.mark.long
def test_legs_alone_wear_a_lower_garment(body, scanned):
    mesh, colors, truth, params = scanned
    kept = mesh.face_centers[:, 1] < mesh.vertices[:, 1].min() + 0.5 * np.ptp(mesh.vertices[:, 1])
    part, index = mesh.submesh(kept)
    found = label_by_body(part, body, params, colors=colors[index]).face_labels
    assert accuracy(part, found, truth[kept]) > 0.95 and not (found == UPPER.id).any()


def test_wrong_input_is_refused(body, scanned):
    mesh, colors, _, params = scanned
    with pytest.raises(InputError, match="one frame"):
        label_by_body(mesh, body, BodyParams.concatenate([params, params]), colors=colors)
    with pytest.raises(InputError, match="vertex colours"):
        label_by_body(mesh, body, params, colors=colors[:-1])
    with pytest.raises(InputError, match="out of range"):
        label_by_body(mesh, body, params, colors=colors.astype(np.float64))


@pytest.mark.long
def test_a_body_that_is_not_in_the_scan_leaves_nothing_sure(body, scanned):
    mesh, colors, _, params = scanned
    elsewhere = replace(params, transl=params.transl + 0.5)
    result = label_by_body(mesh, body, elsewhere, colors=colors)
    assert result.confidence.max() < 0.5
    assert any("no label can be trusted" in note for note in result.notes)


def test_a_head_alone_is_labelled_and_nothing_at_all_is_refused(body, scanned):
    mesh, colors, truth, params = scanned
    kept = mesh.face_centers[:, 1] > 1.42
    part, index = mesh.submesh(kept)
    found = label_by_body(part, body, params, colors=colors[index]).face_labels
    assert accuracy(part, found, truth[kept]) > 0.9
    empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))
    with pytest.raises(InputError, match="faces"):
        label_by_body(empty, body, params)


def test_votes_of_few_views_are_completed_by_the_body(scanned, labelled):
    mesh, colors, truth, _ = scanned
    votes = np.zeros((mesh.face_count, len(LABELS)))
    front = mesh.face_normals[:, 2] > 0.3
    votes[np.flatnonzero(front), truth[front]] = 3.0
    prior = labelled
    alone = segment_scan(mesh, votes=votes)
    both = segment_scan(mesh, votes=votes, colors=colors, prior=prior)
    assert accuracy(mesh, both.face_labels, truth) > max(accuracy(mesh, alone.face_labels, truth), 0.98)
    assert (both.face_labels == truth)[front].mean() > 0.995
    with pytest.raises(InputError, match="prior"):
        segment_scan(mesh.submesh(np.arange(1000))[0], votes=votes[:1000], prior=prior)
