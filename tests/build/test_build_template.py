"""`smplxpp.build_template` and `smplxpp build` are two doors to one build: the digits are the same."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from pipelines.commands.build import Build
from pipelines.runs.artefacts import load_parts, load_weights
from pipelines.runs.layout import METRICS_FILE, TEMPLATE
from pipelines.stages.build import build
from smplxpp.body import load_params
from smplxpp.build import BuildConfig, build_template, parts, template
from smplxpp.build.config import STEPS
from smplxpp.build.data import LocatedInScan
from smplxpp.capture import open_capture
from smplxpp.clean import simplify
from smplxpp.core import InputError, StageOutput, TriangleMesh
from smplxpp.core.files.json_file import read_json
from smplxpp.core.mesh_files.mesh_io import read_mesh, write_ply
from smplxpp.register.locate import BodyNotFoundError

PERSON = Path(__file__).resolve().parents[2] / "data" / "fixtures" / "person"
SCAN, PARAMS = PERSON / "scans" / "scan_000000.ply", PERSON / "params" / "params.npz"
FEW = {"hair": 400, "shoe": 400, "upper": 1500, "lower": 1500, "outer": 400}
pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore::smplxpp.core.errors.GeometryWarning")]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> tuple[TriangleMesh, Path]:
    """A coarse copy of the fixture's scan in memory, and in a file without colours."""
    scan = read_mesh(SCAN).mesh
    mesh = simplify(scan, 8000).mesh
    path = tmp_path_factory.mktemp("small") / "scan.npz"
    np.savez(path, vertices=mesh.vertices, faces=mesh.faces)
    return mesh, path


@pytest.fixture(scope="module")
def by_command(small: tuple[TriangleMesh, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = tmp_path_factory.mktemp("command") / "run"
    command = Build(run_folder=run, scan=small[1], params=PARAMS, budgets=FEW, samples=2000, label_source="body")
    plan = command.plan()
    build(run, plan.inputs, plan.config)
    return run


@pytest.fixture(scope="module")
def built(small: tuple[TriangleMesh, Path]):
    """The same by the library, from a mesh and parameters in memory, with the progress that it reports."""
    seen: list[tuple[str, bool]] = []
    config = BuildConfig(budgets=FEW, samples=2000, label_source="body")
    given = trimesh.Trimesh(small[0].vertices, small[0].faces, process=False)
    fit = load_params(PARAMS)
    return build_template(given, params=fit, config=config, on_stage=lambda *step: seen.append(step)), seen


def test_both_doors_give_the_same_template(by_command, built, tmp_path):
    result, _ = built
    result.template.save(tmp_path / "template.npz")
    assert (tmp_path / "template.npz").read_bytes() == (by_command / TEMPLATE).read_bytes()
    theirs = load_parts(by_command)
    weights = load_weights(by_command, theirs)
    assert list(result.parts) == list(theirs)
    for name, part in result.parts.items():
        assert np.array_equal(part.posed.mesh.vertices, theirs[name].mesh.vertices)
        assert np.array_equal(part.weights.joint_weights, weights[name].joint_weights)


def test_both_doors_report_the_same_checks(by_command, built):
    result, seen = built
    metrics = read_json(by_command / METRICS_FILE)
    theirs = [(check["name"], check["value"], check["status"]) for check in metrics["checks"]]
    assert [(check.name, check.value, check.status) for check in result.report.checks] == theirs
    assert [check.name for check in result.report.failed] == [name for name, _, status in theirs if status == "fail"]
    names = [name for name in STEPS if name not in ("reconstruct", "locate", "register")]
    assert seen == [(name, done) for name in names for done in (False, True)]
    assert list(result.report.numbers) == names and result.capture is None
    assert len(str(result.report).splitlines()) == len(theirs)


def test_a_file_and_a_mesh_in_memory_are_the_same_input(small, monkeypatch):
    """A build from memory is that of the command above; one from files begins with the same arrays."""
    monkeypatch.setattr(template._Build, "run", lambda made: (made._read_scan(), made._params(None, None)))
    mesh, path = small
    in_memory = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    (one, its), (other, others) = (
        build_template(scan, params=params) for scan, params in ((path, PARAMS), (in_memory, load_params(PARAMS)))
    )
    assert np.array_equal(one.clean.mesh.vertices, other.clean.mesh.vertices)
    assert np.array_equal(one.clean.mesh.faces, other.clean.mesh.faces) and (one.units, one.up) == (
        other.units,
        other.up,
    )
    assert all(np.array_equal(a, b) for a, b in zip(its.as_dict().values(), others.as_dict().values(), strict=True))


@pytest.fixture
def unmeasured(monkeypatch):
    """Templates are not measured, which is half of the time."""
    monkeypatch.setattr(template, "validate_template", lambda *made: (None, StageOutput([], {})))


def test_labels_in_memory_are_used(small, unmeasured, monkeypatch):
    mesh, _ = small
    searched = searches(monkeypatch)
    labels = np.where(mesh.face_centers[:, 1] < 0.5, 5, 0)
    config = BuildConfig(budgets=FEW, samples=2000)
    result = build_template(mesh, params=PARAMS, labels=labels, config=config)
    assert result.template.part_names == ("body", "lower") or len(result.template.part_names) == 2
    assert result.report.numbers["segment"]["labels_from"] == "file"
    # Bridges and tears are searched once of every part that a cut has left: an empty search was repeated six times.
    assert searched and len({(find, id(part)) for find, part in searched}) == len(searched)
    with pytest.raises(InputError, match="labels of the scan"):
        build_template(mesh, params=PARAMS, labels=labels[:-1], config=config)


def searches(monkeypatch) -> list[tuple[str, TriangleMesh]]:
    """Return a list that gets the parts of which bridges and tears are searched."""
    seen: list[tuple[str, TriangleMesh]] = []
    for name in ("find_bridges", "find_tears"):
        find = getattr(parts, name)

        def counted(part, *others, name=name, find=find, **config):
            seen.append((name, part))
            return find(part, *others, **config)

        monkeypatch.setattr(parts, name, counted)
    return seen


def test_the_capture_comes_back_with_the_parameters_that_were_used(small, tmp_path, unmeasured):
    root = tmp_path / "capture"
    (root / "scans").mkdir(parents=True)
    for name in ("cameras.json", "rgbs", "masks", "params"):
        (root / name).symlink_to(PERSON / name)
    write_ply(root / "scans" / "scan_000000.ply", small[0])
    # The scan's frame is exact, because clothes that a wrong pose drives into the body take most of a build.
    exact, noisy = load_params(PARAMS), load_params(PERSON / "params" / "params_noisy.npz")
    given = replace(exact, body_pose=np.concatenate([exact.body_pose[:1], noisy.body_pose[1:]]))
    config = BuildConfig(budgets=FEW, samples=2000, label_source="body", texture_size=0)
    result = build_template(capture=open_capture(root), params=given, config=config)
    found = result.capture.params(3)
    assert np.array_equal(found.body_pose[0], given.body_pose[3])
    assert not np.array_equal(found.body_pose, open_capture(root).params(3).body_pose)


def test_what_is_asked_for_has_to_be_one_thing():
    with pytest.raises(InputError, match="received neither"):
        build_template()
    with pytest.raises(InputError, match="received both"):
        build_template(SCAN, capture=PERSON)
    with pytest.raises(InputError, match="option budgets"):
        BuildConfig(budgets={"cape": 100})


@pytest.mark.slow
def test_the_embedded_person_is_the_same_through_both_doors(tmp_path):
    """As `make demo` builds it: tracked parameters, registered to keypoints, masks and label maps."""
    budgets = {"upper": 8000, "lower": 8000}
    plan = Build(run_folder=tmp_path / "run", capture=PERSON, protocol="tracked", budgets=budgets).plan()
    build(tmp_path / "run", plan.inputs, plan.config, registration=plan.registration)
    config = BuildConfig(protocol="tracked", budgets=BuildConfig().budgets | budgets)
    result = build_template(capture=PERSON, config=config)
    result.template.save(tmp_path / "template.npz")
    assert (tmp_path / "template.npz").read_bytes() == (tmp_path / "run" / TEMPLATE).read_bytes()
    registered = open_capture(PERSON, params=tmp_path / "run" / "05_register" / "params.npz", protocol="tracked")
    for frame in registered.frames:
        one, other = registered.params(frame), result.capture.params(frame)
        assert all(np.array_equal(a, b) for a, b in zip(one.as_dict().values(), other.as_dict().values(), strict=True))


def test_a_build_stops_with_the_finding_where_nobody_was_surely_found(small, monkeypatch):
    """A woman who carries a child became a template with an arm over her head, at a confidence of .003."""
    fit = load_params(PARAMS).frame(0)

    def located(file, body, **known):
        numbers = {"confidence": 0.003, "findings": ["2 heads, 1.62 and 1.54 m above the lowest point"], "problems": []}
        return LocatedInScan(fit, np.zeros(0, np.int64), np.zeros(0, bool)), StageOutput([], numbers)

    monkeypatch.setattr(template, "locate_in_scan", located)
    with pytest.raises(BodyNotFoundError, match="2 heads") as stopped:
        build_template(small[1])
    error = stopped.value
    assert error.confidence == 0.003 and "--landmarks" in str(error) and "--accept-failures" in str(error)
    # The picture shows the scan, and the body in it from front and side.
    assert error.picture is not None and error.picture.shape[1] > error.picture.shape[0]
    assert (error.picture < 250).any(axis=(0, 2)).mean() > 0.5


def test_a_build_stops_at_a_shape_that_no_person_has(small, monkeypatch):
    """A drawn figure's limbs made betas of a mean square of 90; a template with a waist like a wrist came of them."""
    fit = load_params(PARAMS).frame(0)
    strange = replace(fit, betas=np.where(np.arange(fit.betas.shape[1]) % 2, 9.0, -9.0)[None])

    def located(file, body, **known):
        numbers = {"confidence": 0.4, "findings": [], "problems": []}
        return LocatedInScan(strange, np.zeros(0, np.int64), np.zeros(0, bool)), StageOutput([], numbers)

    monkeypatch.setattr(template, "locate_in_scan", located)
    with pytest.raises(BodyNotFoundError, match=r"a body with a shape that no person has .*81, people have 1"):
        build_template(small[1])
