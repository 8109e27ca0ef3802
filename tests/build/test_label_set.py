"""A user's own labels go from the file through every stage of a build into the template and its files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pygltflib
import pytest

from pipelines.commands.build import Build
from pipelines.report.sections.template import scan_section, weights_section
from pipelines.runs.artefacts import load_scan
from pipelines.runs.layout import ASSEMBLE_STAGE, SEGMENT_STAGE, TEMPLATE, TRANSFER_STAGE
from pipelines.stages.build import build
from pipelines.viewer.run_scene import open_session
from smplxpp.body.named_poses import worn_poses
from smplxpp.build import BuildConfig, build_template
from smplxpp.cloth.collider import _layers_under
from smplxpp.core import BodyParams, InputError
from smplxpp.figures import body_cameras
from smplxpp.segment import find_label_set
from smplxpp.template.template import Template
from tests.build.many_classes import CLASSES, dressed_scan, many_classes

PARTS = ("dress", "coat", "socks", "glasses", "hat", "bag", "hair")
pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore::smplxpp.core.errors.GeometryWarning")]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scan, its labels, its parameters, and the label set as a user writes it."""
    folder = tmp_path_factory.mktemp("wardrobe")
    mesh, ids, params = dressed_scan()
    np.savez(folder / "scan.npz", vertices=mesh.vertices, faces=mesh.faces)
    np.savez(folder / "labels.npz", labels=ids)
    params.save(folder / "params.npz")
    lines = ["classes:  # from the skin outwards"]
    for row in CLASSES:
        lines += [
            f"  {'- ' if k == 0 else '  '}{name}: {json.dumps(value)}" for k, (name, value) in enumerate(row.items())
        ]
    (folder / "labels.yaml").write_text("\n".join(lines) + "\n")
    return folder


@pytest.fixture(scope="module")
def run(files: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """A run of the command up to the template; the second largest piece of the glasses follows the jaw."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    given = {"scan": files / "scan.npz", "params": files / "params.npz", "labels": files / "labels.npz"}
    rules = {"glasses/1": "rigid:jaw"}
    command = Build(run_folder=folder, **given, label_set=str(files / "labels.yaml"), rules=rules, samples=2000)
    plan = command.plan()
    return folder, build(folder, plan.inputs, plan.config, last=ASSEMBLE_STAGE)


def test_the_file_says_what_the_python_set_says(files):
    assert find_label_set(files / "labels.yaml").labels == many_classes().labels
    assert find_label_set(files / "labels.yaml").classes == many_classes().classes


def test_parts_keep_names_layers_and_colours_in_template_glb_report_and_viewer(run, tmp_path):
    folder, records = run
    template = Template.load(folder / TEMPLATE)
    assert set(template.part_names) == {"body", *PARTS} and template.labels == many_classes().labels
    assert template.cloth_parts == template.loose_parts == ("dress", "coat")  # what may be simulated
    nodes = [
        node.name
        for node in pygltflib.GLTF2().load(str(folder / ASSEMBLE_STAGE / "template.glb")).nodes
        if node.mesh is not None
    ]
    assert nodes == list(template.part_names)
    # Layers: socks under all, the hat over the hair; a bag is no layer. A colour of one's own is shown.
    assert _layers_under(template, "coat") == ["socks", "dress"]
    assert _layers_under(template, "hat") == ["socks", "dress", "coat", "hair"]
    bag = template.vertex_labels[template.vertex_part == template.part_names.index("coat")]
    assert (template.labels.display_colors(bag) == (60, 90, 150)).all()
    budgets = {name: template.part_faces(name).sum() for name in ("dress", "coat", "hat")}
    assert budgets["dress"] <= 1.05 * 1200 and budgets["coat"] <= 1.05 * 1200 and budgets["hat"] <= 1.05 * 500
    # The report lists the classes and the rules; the viewer paints with them.
    mesh, colors, _ = load_scan(folder)
    cameras = body_cameras(mesh, views=("front",), height=64)
    legend = scan_section(folder, records[SEGMENT_STAGE], mesh, colors, cameras, ()).legend
    assert {name for name, _ in legend} == {"skin", *PARTS}
    rows = {row[0]: row for row in weights_section(folder, records[TRANSFER_STAGE], cameras, ()).tables[0].rows}
    assert rows["hat"][3] == "rigid:head" and rows["bag"][4].startswith("rigid:")
    session = open_session(folder)
    bag_id = session.scan.known.named("bag").id
    session.patch(bag_id, int(np.flatnonzero(session.labels() == session.scan.known.named("hat").id)[0]))
    session.save(tmp_path)
    assert json.loads((tmp_path / "labels_corrections.json").read_text())["corrections"][0]["label"] == "bag"


def test_rules_hold_in_every_pose(run):
    """Edges of a rigid part keep their length; a piece with a rule of its own follows that."""
    template = Template.load(run[0] / TEMPLATE)
    params = BodyParams.rest(betas=template.betas, expressions=template.body.num_expressions)
    posed = template.pose(worn_poses(params))
    for part in ("hat", "glasses", "bag"):
        faces = template.faces[template.part_faces(part)]
        before = np.linalg.norm(np.diff(template.vertices[faces], axis=1), axis=2)
        for vertices in posed:
            np.testing.assert_allclose(np.linalg.norm(np.diff(vertices[faces], axis=1), axis=2), before, atol=1e-6)
    names, dense = template.body.joint_names, template.weights.dense()
    glasses = template.vertex_part == template.part_names.index("glasses")
    assert {names[j] for j in dense[glasses].argmax(axis=1)} == {"head", "jaw"}
    socks = template.vertex_part == template.part_names.index("socks")
    assert dense[socks][:, [names.index("left_foot"), names.index("right_foot")]].max() > 0.9  # no shoe: toes bend


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"labels": np.array([0, 10, 99])}, r"received \[99\]"),
        ({"config": {"rules": {"hta": "rigid:head"}}}, "Did you mean 'hat'"),
        ({"config": {"rules": {"hat": "rigid:haed"}}}, "Did you mean 'head'"),
        ({"config": {"rules": {"hat": "rigid"}}}, "rigid:JOINT"),
        ({"config": {"budgets": {"dres": 500}}}, "Did you mean 'dress'"),
    ],
)
def test_what_no_class_part_or_joint_has_is_refused_before_work(change, said):
    mesh, ids, params = TINY
    steps: list[str] = []
    with pytest.raises(InputError, match=said):
        build_template(
            mesh,
            params=params,
            labels=change.get("labels", ids),
            config=BuildConfig(label_set=many_classes(), **change.get("config", {})),
            on_stage=lambda name, done: steps.append(name),
        )
    assert not steps


TINY = (
    (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]])),
    np.array([0]),
    BodyParams.rest(betas=np.zeros(10)),
)
