"""A scan with nothing beside it, in other units and on its side, becomes a labelled body; a hand may help it."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from PIL import Image

from pipelines.commands.build import Build
from pipelines.report.sections.register import locate_section
from pipelines.runs.artefacts import load_located
from pipelines.runs.layout import LANDMARKS_FILE, LOCATE_STAGE, NOT_FOUND_PICTURE, SEGMENT_STAGE, TEMPLATE
from pipelines.runs.stage import require_stage
from smplxpp.body import load_body, load_params
from smplxpp.build import BuildConfig, locate
from smplxpp.build.data import PreparedScan
from smplxpp.build.parts import clean_scan
from smplxpp.clean import Simplified, simplify
from smplxpp.core import BACKGROUND, SKIN, BodyParams, GeometryWarning, InputError, TriangleMesh
from smplxpp.core.mesh_files.mesh_io import RawMesh, read_mesh, read_raw_mesh, write_ply
from smplxpp.register.locate import BodyNotFoundError, Candidate, LocateConfig, LocatedBody
from smplxpp.segment import SegmentedScan, read_labels
from smplxpp.template import Template

pytestmark = pytest.mark.long

PERSON = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"
BODY = load_body()
FACES = 20_000
# A search of an eighth of the length, which finds this person; that of the default length is among the slow tests.
FEW = LocateConfig(
    directions=6,
    starts=6,
    limbs_tried=2,
    candidates=2,
    coarse_points=400,
    fine_points=2000,
    dress_steps=5,
    finish_steps=5,
)


@cache
def whole_and_coarse() -> tuple[RawMesh, Simplified]:
    """The fixture's scan, and with fewer faces."""
    raw = read_raw_mesh(PERSON / "scans" / "scan_000000.ply")
    return raw, simplify(TriangleMesh(raw.vertices, raw.faces), FACES)


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """The fixture's scan of fewer faces, in centimetres, lying on its back as files with z up do."""
    raw, coarse = whole_and_coarse()
    x, y, z = coarse.mesh.vertices.T
    path = tmp_path_factory.mktemp("scan") / "me.ply"
    lying = TriangleMesh(100.0 * np.stack([x, -z, y], axis=1), coarse.mesh.faces)
    write_ply(path, lying, vertex_colors=raw.vertex_colors[coarse.source_vertex])
    return path


@pytest.fixture(scope="module")
def alone(scan):
    run = scan.parent / "run"
    with mock.patch.object(locate, "locate_body", partial(locate.locate_body, config=FEW)):
        Build(run_folder=run, scan=scan, until_stage=SEGMENT_STAGE, json=True).run()
    return run


@pytest.mark.slow
def test_the_body_is_found_by_the_default_search_in_the_whole_scan(tmp_path):
    raw = read_raw_mesh(PERSON / "scans" / "scan_000000.ply")
    lying = TriangleMesh(100.0 * raw.vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0], raw.faces)
    write_ply(tmp_path / "me.ply", lying, vertex_colors=raw.vertex_colors)
    Build(run_folder=tmp_path / "run", scan=tmp_path / "me.ply", until_stage=SEGMENT_STAGE, json=True).run()
    test_the_body_is_found(tmp_path / "run")


def test_the_body_is_found(alone):
    true = BODY.forward(load_params(PERSON / "params" / "params.npz").frame(0)).frame(0)
    found = BODY.forward(load_params(alone / "08_capture" / "params.npz")).frame(0)
    assert 1e3 * np.linalg.norm(found.vertices - true.vertices, axis=1).mean() < 15.0
    assert 1e3 * np.linalg.norm(found.joints - true.joints, axis=1)[:22].mean() < 12.0
    numbers = require_stage(alone, LOCATE_STAGE).manifest["numbers"]
    assert (numbers["units"], numbers["up"]) == ("cm", "z") and "cm" in numbers["said"]
    assert abs(numbers["facing_degrees"]) < 10.0 and numbers["confidence"] > 0.5 and numbers["problems"] == []
    facings = [one["facing_degrees"] for one in numbers["candidates"]]
    assert max(np.cos(np.radians(facings))) > 0.9 and min(np.cos(np.radians(facings))) < -0.9


def test_labels_are_told(alone):
    raw, coarse = whole_and_coarse()
    true = read_labels(
        PERSON / "scans" / "scan_000000_labels.npz",
        vertex_count=len(raw.vertices),
        face_count=len(raw.faces),
        label_set="capture",
    )
    with np.load(alone / SEGMENT_STAGE / "labels.npz") as labels, np.load(alone / "08_capture" / "scan.npz") as kept:
        told, source = labels["face_labels"], kept["scan/source_face"]
    corners = true[coarse.source_vertex][coarse.mesh.faces[source]]
    one = (corners == corners[:, :1]).all(axis=1) & (corners[:, 0] != BACKGROUND)
    assert (told[one] == corners[one, 0]).mean() > 0.93
    assert require_stage(alone, SEGMENT_STAGE).manifest["numbers"]["labels_from"] == "body"


def test_what_a_registration_takes_up(alone):
    located = load_located(alone / LOCATE_STAGE)
    params, bare = located.params, located.bare_of(BODY)
    labels = located.labels_of(len(read_raw_mesh(alone / SEGMENT_STAGE / "labels.ply").vertices))
    assert labels is not None
    assert len(params) == 1 and 0.2 < bare.mean() < 0.7
    assert (labels == SKIN.id).mean() > 0.2 and (labels == BACKGROUND).any()
    assert located.labels_of(7) is None


def test_the_report_shows_what_else_it_might_have_been(alone):
    record = require_stage(alone, LOCATE_STAGE)
    with np.load(alone / "08_capture" / "scan.npz") as kept:
        mesh = TriangleMesh(kept["scan/vertices"], kept["scan/faces"])
    section = locate_section(record, BODY, mesh)
    assert len(section.pictures) == 2 and "found units cm" in section.text[0]
    assert [row[0].startswith("chosen") for row in section.tables[0].rows][:2] == [True, False]


@pytest.mark.long
def test_landmarks_by_hand_are_believed_and_make_it_anew(tmp_path, monkeypatch):
    shown, scan = [], tmp_path / "coarse.ply"
    write_ply(scan, simplify(read_mesh(PERSON / "scans" / "scan_000000.ply").mesh, 9500).mesh)
    fit = load_params(PERSON / "params" / "params.npz").frame(0)

    def look(body, mesh, *, colors, landmarks, labeller):
        shown.append(landmarks)
        sure = 0.05 if landmarks is None else 0.15
        return LocatedBody(fit, sure, ("one hand is not there",), (Candidate("by hand", 0.0, 1.0, 1.0, 1.0),))

    monkeypatch.setattr(locate, "locate_body", look)
    run = tmp_path / "run"
    build = Build(run_folder=run, scan=scan, units="m", up="y", until_stage=LOCATE_STAGE, json=True)
    # A body that nobody would show is not built on: the run keeps it, with a picture.
    with pytest.raises(BodyNotFoundError, match="one hand is not there") as stopped:
        build.run()
    assert str(run / NOT_FOUND_PICTURE) in str(stopped.value)
    assert stopped.value.confidence == 0.05
    with Image.open(run / NOT_FOUND_PICTURE) as picture:
        assert np.asarray(picture).std() > 10 and picture.width > picture.height
    # Who accepts failures gets them, and status 0.
    answer = replace(build, accept_failures=True).run()
    assert answer["checks"][0]["status"] == "fail" and (answer["failed"], answer["exit_status"]) == (1, 0)
    # Landmarks make another attempt.
    (run / LANDMARKS_FILE).write_text(json.dumps({"nose": [0.0, 1.5, 0.1]}))
    answer = build.run()
    assert answer["checks"][0]["status"] == "warn" and not (run / NOT_FOUND_PICTURE).exists()
    build.run()
    assert shown[0] is None and set(shown[1]) == {"nose"} and len(shown) == 2


@pytest.mark.long
def test_a_command_stops_at_a_shape_that_no_person_has(tmp_path, monkeypatch):
    fit = load_params(PERSON / "params" / "params.npz").frame(0)
    drawn = replace(fit, betas=np.where(np.arange(fit.betas.shape[1]) % 2, 9.0, -9.0)[None])

    def look(body, mesh, *, colors, landmarks, labeller):
        return LocatedBody(drawn, 0.4, (), (Candidate("by hand", 0.0, 1.0, 1.0, 1.0),))

    monkeypatch.setattr(locate, "locate_body", look)
    scan, run = tmp_path / "coarse.ply", tmp_path / "run"
    write_ply(scan, simplify(read_mesh(PERSON / "scans" / "scan_000000.ply").mesh, 9500).mesh)
    build = Build(run_folder=run, scan=scan, units="m", up="y", until_stage=LOCATE_STAGE, json=True)
    for _ in range(2):  # a stage that stands is asked again
        with pytest.raises(BodyNotFoundError, match=r"a shape that no person has .*81, people have 1"):
            build.run()
        assert (run / NOT_FOUND_PICTURE).is_file()
    assert replace(build, accept_failures=True).run()["checks"][0]["status"] == "warn"


@pytest.mark.long
def test_nothing_is_built_on_what_is_no_person(tmp_path, monkeypatch):
    monkeypatch.setattr(locate, "locate_body", partial(locate.locate_body, config=FEW))
    cube = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=float)
    faces = np.array(
        [
            [0, 1, 3],
            [0, 3, 2],
            [4, 6, 7],
            [4, 7, 5],
            [0, 4, 5],
            [0, 5, 1],
            [2, 3, 7],
            [2, 7, 6],
            [0, 2, 6],
            [0, 6, 4],
            [1, 5, 7],
            [1, 7, 3],
        ]
    )
    write_ply(tmp_path / "cube.ply", TriangleMesh(cube * 1.8, faces))
    with pytest.raises(BodyNotFoundError, match="one whole person"):
        Build(run_folder=tmp_path / "run", scan=tmp_path / "cube.ply", units="m", up="y", json=True).run()
    assert [path.name for path in (tmp_path / "run").glob("[0-9]*")] == [LOCATE_STAGE]
    assert (tmp_path / "run" / NOT_FOUND_PICTURE).is_file()


def test_a_bare_and_bald_person_is_a_template_of_the_body_alone(tmp_path, monkeypatch):
    """A mannequin was refused after its labels were found, with the advice to check the label set."""

    def bare(mesh, *_, **__):
        labels = np.full(mesh.face_count, SKIN.id)
        return SegmentedScan(labels, np.ones(len(labels)), np.ones(len(labels), bool), 0, 0.0, 0.0)

    monkeypatch.setattr(locate, "locate_body", partial(locate.locate_body, config=FEW))
    monkeypatch.setattr("smplxpp.build.segment.label_by_body", bare)
    pose = BodyParams.rest(betas=0).body_pose.copy()
    pose[0, 47], pose[0, 50] = -0.9, 0.9  # arms lowered
    vertices = BODY.forward(replace(BodyParams.rest(betas=0), body_pose=pose)).vertices[0]
    write_ply(tmp_path / "bare.ply", TriangleMesh(vertices, BODY.faces))
    with pytest.warns(GeometryWarning, match="the body alone"):
        answer = Build(run_folder=tmp_path / "run", scan=tmp_path / "bare.ply", units="m", up="y", json=True).run()
    assert answer["exit_status"] == 0
    assert Template.load(tmp_path / "run" / TEMPLATE).part_names == ("body",)
    assert "the template is the body alone" in (tmp_path / "run" / "report.html").read_text()
    # Labels of a file that are skin alone are a mistaken label set.
    mesh, gray = TriangleMesh(vertices, BODY.faces), np.full((len(vertices), 3), 128, np.uint8)
    scan = PreparedScan(mesh, gray, np.arange(len(vertices)), np.arange(len(BODY.faces)))
    with pytest.raises(InputError, match="label set"):
        clean_scan(scan, np.full(len(BODY.faces), SKIN.id), BuildConfig())
