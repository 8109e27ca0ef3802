"""`smplxpp check` finds what was planted, where it was planted."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from pipelines.commands.check import CheckMesh
from smplxpp.core import InputError, SkinWeights, TriangleMesh, read_mesh, write_ply
from smplxpp.metrics import faulty_faces
from smplxpp.template.template import Template
from tests.export.templates import open_body_template


def found(report: dict, name: str) -> list[dict]:
    return [row for row in report["checks"] if row["name"] == name]


def test_planted_faults_of_a_mesh_are_named_and_coloured(tmp_path, capsys):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    vertices, faces = np.array(ball.vertices), np.array(ball.faces)
    faces[17] = faces[17, ::-1]
    spike = np.unique(ball.faces)[np.argmax(vertices[:, 1])]
    vertices[spike] = [0.02, -0.6, 0.013]  # through the other side
    faces = np.concatenate([faces, faces[40:41], [[0, 0, 1]]])
    mesh = TriangleMesh(vertices, faces)
    faults = faulty_faces(mesh)
    assert np.flatnonzero(faults["faces that repeat another"]).tolist() == [len(ball.faces)]
    assert np.flatnonzero(faults["faces without area"]).tolist() == [len(ball.faces) + 1]
    assert faults["faces wound the other way"][17] and faults["faces at an edge of three"][40]
    # trimesh's rays know which faces the spike goes through: those around the opposite pole.
    through = np.flatnonzero(faults["faces that cut another"])
    assert {*ball.vertex_faces[spike][ball.vertex_faces[spike] >= 0]} <= {*through}
    assert mesh.face_centers[through][:, 1].min() < -0.49 and len(through) < 20
    write_ply(tmp_path / "ball.ply", mesh)
    report = CheckMesh(tmp_path / "ball.ply", out=tmp_path / "out", strict=True).run()
    assert report["verdict"] == "fail" and report["exit_status"] == 1
    assert found(report, "faces that repeat another")[0]["value"] == 1
    assert "faces wound the other way" in capsys.readouterr().out
    stored = json.loads((tmp_path / "out" / "check.json").read_text())
    assert stored["checks"] == json.loads(json.dumps(report["checks"]))
    colors = read_mesh(tmp_path / "out" / "faults.ply").vertex_colors
    marked = np.zeros(len(vertices), dtype=bool)
    marked[faces[np.any([*faults.values()], axis=0)]] = True
    assert ((colors != 190).any(axis=1) == marked).all()


def test_a_whole_mesh_passes_and_its_weights_and_scan_are_checked(tmp_path, capsys):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    mesh = TriangleMesh(ball.vertices, ball.faces)
    write_ply(tmp_path / "ball.ply", mesh)
    write_ply(tmp_path / "scan.ply", mesh.with_vertices(1.006 * mesh.vertices))
    share = 0.5 + mesh.vertices[:, 1]
    SkinWeights.from_dense(np.stack([share, 1 - share], axis=1)).save(tmp_path / "w.npz")
    assert CheckMesh(tmp_path / "ball.ply").run()["verdict"] == "pass"
    report = CheckMesh(tmp_path / "ball.ply", weights=tmp_path / "w.npz", scan=tmp_path / "scan.ply", json=True).run()
    assert report["verdict"] == "warn" and found(report, "off the scan")[0]["value"] == pytest.approx(3.0, abs=0.1)
    assert found(report, "largest jump of weights along an edge")[0]["value"] < 0.15
    assert report["scan"]["hausdorff_upper"] >= report["scan"]["hausdorff"]
    with pytest.raises(InputError, match="option params"):
        CheckMesh(tmp_path / "ball.ply", params=tmp_path / "w.npz").run()


def in_a_shirt(template: Template) -> Template:
    """The open body in a shirt of its trunk's skin, 1 cm off it on the left and 1 cm within it on the right."""
    names, dense = template.body.joint_names, template.weights.dense()
    trunk = dense[:, [names.index(name) for name in ("spine1", "spine2", "spine3")]].sum(axis=1) > 0.6
    part, used = template.mesh.submesh(trunk[template.faces].all(axis=1))
    count, more = template.vertex_count, part.vertex_count
    offset = np.where(part.vertices[:, :1] > 0, 0.01, -0.01)
    return replace(
        template,
        vertices=np.concatenate([template.vertices, part.vertices + offset * template.mesh.vertex_normals[used]]),
        faces=np.concatenate([template.faces, part.faces + count]),
        vertex_labels=np.concatenate([template.vertex_labels, np.full(more, 3)]),
        vertex_part=np.concatenate([template.vertex_part, np.full(more, 1)]),
        part_names=("body", "upper"),
        vertex_colors=np.concatenate([template.vertex_colors, template.vertex_colors[used]]),
        weights=SkinWeights.from_dense(np.concatenate([dense, dense[used]])),
        body_index=np.concatenate([template.body_index, used]),
        scan_index=np.full(count + more, -1),
    )


def test_a_template_is_driven_and_its_parts_held_against_the_body(tmp_path):
    worn = in_a_shirt(open_body_template())
    worn.save(tmp_path / "smplxpp.npz")
    report = CheckMesh(tmp_path / "smplxpp.npz", json=True, out=tmp_path / "out").run()
    shirt = worn.part_mesh("upper")
    share = 100 * float((shirt.vertices[:, 0] < 0).mean())
    (rest,) = found(report, "inside the body")
    (posed,) = found(report, "inside the body in a pose")
    assert rest["part"] == "upper" and rest["value"] == pytest.approx(share, abs=2.0) and rest["status"] == "fail"
    assert share - 2.0 < posed["value"] < share + 15.0
    assert 1.0 < found(report, "stretched")[0]["value"] < 4.0
    assert not any(row["part"] == "body" for row in report["checks"])
    # Red is on the right side alone, but for the faces across the middle.
    red = (read_mesh(tmp_path / "out" / "faults.ply").vertex_colors == (230, 30, 30)).all(axis=1)
    assert red.sum() > 0.9 * (shirt.vertices[:, 0] < 0).sum() and worn.vertices[red][:, 0].max() < 0.03
