"""Scans that are not of one whole person are told: by the checks of the finished template."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest

from pipelines.runs.artefacts import load_params_of_run, load_scan, load_scan_labels
from pipelines.runs.layout import TEMPLATE
from smplxpp.build.completeness import completeness_checks
from smplxpp.clean import sanitize, simplify
from smplxpp.core import LOWER, SKIN, TriangleMesh
from smplxpp.metrics import CompareConfig, directed_distances
from smplxpp.template.template import Template

BODY, REGION, ENDS, SCAN, PATCH, MIRROR = range(6)


@pytest.fixture(scope="module")
def whole(person_run):
    """Template, parameters, scan and labels of a finished build, the scan with a quarter of its faces."""
    scan, _, _ = load_scan(person_run)
    of_vertex = np.zeros(scan.vertex_count, dtype=np.int64)
    of_vertex[scan.faces] = load_scan_labels(person_run, scan.face_count)[:, None]
    coarse = simplify(scan, 20_000)
    labels = of_vertex[coarse.source_vertex][coarse.mesh.faces[:, 0]]
    return Template.load(person_run / TEMPLATE), load_params_of_run(person_run), coarse.mesh, labels


def checked(whole, *, labels: np.ndarray | None = None, kept: np.ndarray | None = None, without: str = "none"):
    """The checks of a finished build with other labels, some of the scan's faces alone, or a part left out."""
    template, params, scan, own_labels = whole
    labels = own_labels if labels is None else labels
    if kept is not None:
        scan, labels = scan.submesh(kept)[0], labels[kept]
    posed = template.mesh.with_vertices(template.pose(params)[0])
    part = np.array(template.part_names)[template.vertex_part[template.faces[:, 0]]]
    posed = posed.submesh(part != without)[0]
    back = directed_distances(scan, posed, samples=5000, config=CompareConfig(visible_only=True))
    return completeness_checks(template, params, scan, labels, back)


def middle_of(scan: TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    return scan.face_centers[:, 0], scan.face_centers[:, 1]


@pytest.mark.long
def test_a_whole_scan_passes(whole):
    checks, numbers = checked(whole)
    assert [c.status for c in checks] == ["pass"] * 6
    assert numbers["body_uncovered"]["all"] < 0.02 and numbers["scan_unexplained"] < 0.02


@pytest.mark.long
def test_a_scan_without_its_head_fails_and_the_head_is_named(whole):
    _, y = middle_of(whole[2])
    checks, _ = checked(whole, kept=y < 1.42)
    assert checks[BODY].status == "warn" and checks[REGION].status == "fail"
    assert checks[REGION].explanation.startswith("head 9")
    assert checks[ENDS].status == "pass" and checks[SCAN].status == "pass"


@pytest.mark.long
def test_the_left_half_alone_fails_and_what_is_lost_is_named(whole):
    x, _ = middle_of(whole[2])
    checks, numbers = checked(whole, kept=x > 0)
    assert [checks[k].status for k in (BODY, REGION, ENDS)] == ["fail"] * 3
    assert "right arm" in checks[REGION].explanation and "left" not in checks[REGION].explanation
    assert numbers["body_uncovered"]["left arm"] < 0.02 < 0.9 < numbers["body_uncovered"]["right arm"]


@pytest.mark.parametrize("radius", [0.0, 0.03, 0.08])
@pytest.mark.long
def test_two_fifths_of_the_faces_gone_fail(whole, radius):
    scan, rng = whole[2], np.random.default_rng(0)
    gone = rng.random(scan.face_count) < (0.0 if radius else 0.4)
    for k in rng.permutation(scan.face_count):
        if gone.mean() >= 0.39:
            break
        gone |= np.linalg.norm(scan.face_centers - scan.face_centers[k], axis=1) < radius
    checks, numbers = checked(whole, kept=~gone)
    assert checks[BODY].status == "fail"
    assert numbers["body_uncovered"]["all"] == pytest.approx(0.33, abs=0.1)


@pytest.mark.long
def test_holes_that_scanners_leave_pass(whole):
    scan = whole[2]
    x, y = middle_of(scan)
    down = scan.face_normals[:, 1] < -0.5
    top = y > scan.vertices[:, 1].max() - 0.02
    armpit = (np.abs(np.abs(x) - 0.16) < 0.03) & (np.abs(y - 1.27) < 0.04)
    checks, _ = checked(whole, kept=~((down & (y < 0.03)) | top | armpit))
    assert [c.status for c in checks] == ["pass"] * 6


@pytest.mark.long
def test_a_skirt_cut_out_fails_and_the_legs_are_named(whole):
    checks, _ = checked(whole, kept=whole[3] != LOWER.id)
    assert checks[BODY].status == "fail" and "leg" in checks[REGION].explanation


@pytest.mark.long
def test_a_skirt_labelled_skin_looks_like_cloth(whole):
    labels = whole[3]
    # A build makes no skirt of such labels.
    checks, numbers = checked(whole, labels=np.where(labels == LOWER.id, SKIN.id, labels), without="lower")
    assert checks[SCAN].status == checks[PATCH].status == "fail"
    assert numbers["skin_patches_cm2"][0] > 1500
    assert "leg" in checks[PATCH].explanation or "torso" in checks[PATCH].explanation


@pytest.mark.long
def test_a_mirrored_scan_fails_where_the_pose_tells_left_from_right(whole):
    template, params, _, _ = whole
    pose = params.body_pose.copy()
    pose[:, 15 * 3 : 15 * 3 + 3] += [0.0, -0.6, 0.8]  # the left shoulder alone
    raised = replace(params, body_pose=pose)
    posed = template.mesh.with_vertices(template.pose(raised)[0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        clean = sanitize(posed.vertices, posed.faces)
    own = template.vertex_labels[clean.source_vertex][clean.mesh.faces[:, 0]]
    mirrored = TriangleMesh(clean.mesh.vertices * [-1, 1, 1], clean.mesh.faces[:, ::-1])
    right, _ = checked((template, raised, clean.mesh, own))
    wrong, _ = checked((template, raised, mirrored, own))
    assert right[MIRROR].value < 0.5 and right[MIRROR].status == "pass"
    assert wrong[MIRROR].value > 2.5 and wrong[MIRROR].status == "fail"
