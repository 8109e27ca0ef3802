"""`smplxpp check` finds what was planted, where it was planted."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pygltflib
import pytest
import trimesh

from pipelines.commands.check import CheckMesh
from smplxpp.body.named_poses import stress_poses
from smplxpp.core import BodyParams, InputError, SkinWeights, TriangleMesh, read_mesh, write_ply
from smplxpp.export.gltf import write_glb
from smplxpp.export.gltf_skin import with_joint_names
from smplxpp.metrics import edge_stretch, faulty_faces
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


def test_borders_are_counted_in_words_and_coloured(tmp_path, capsys):
    """A verdict said nothing of holes, which `check.json` alone had."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    open_ball = TriangleMesh(ball.vertices, ball.faces[ball.triangles_center[:, 1] < 0.4])
    write_ply(tmp_path / "open.ply", open_ball)
    assert CheckMesh(tmp_path / "open.ply", out=tmp_path / "out").run()["verdict"] == "pass"
    said = " ".join(capsys.readouterr().out.split())
    border = np.linalg.norm(np.diff(open_ball.vertices[open_ball.border_edges], axis=1), axis=2).sum() * 1e3
    assert f"mesh: 1 pieces, 1 borders, the longest {border:,.0f} mm" in said
    assert "faults.ply" in said and "touching" not in said
    marked = (read_mesh(tmp_path / "out" / "faults.ply").vertex_colors != 190).any(axis=1)
    assert set(np.unique(open_ball.border_edges)) <= set(np.flatnonzero(marked)) and marked.mean() < 0.2


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


@pytest.mark.long
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


def accessor_bytes(gltf: pygltflib.GLTF2, index: int, dtype: str) -> np.ndarray:
    """A writable view of the values of an accessor in the blob of a file, whose blob was made a bytearray."""
    accessor = gltf.accessors[index]
    view = gltf.bufferViews[accessor.bufferView]
    width = {"VEC4": 4, "MAT4": 16}[accessor.type]
    start = view.byteOffset + (accessor.byteOffset or 0)
    return np.frombuffer(gltf._glb_data, dtype, accessor.count * width, start).reshape(-1, width)


@pytest.mark.long
def test_a_rigged_file_is_driven_by_its_own_joints_and_its_planted_faults_are_found(tmp_path):
    worn = in_a_shirt(open_body_template())
    path, names = tmp_path / "worn.glb", worn.body.joint_names
    write_glb(path, with_joint_names(worn, "mixamo"), morph_targets=False)
    whole = CheckMesh(path, json=True).run()
    assert not [row for row in whole["checks"] if row["part"] == "rig" and row["status"] != "pass"]
    assert whole["rig"]["joints"] == len(names) and whole["rig"]["roots"] == 1 and len(whole["rig"]["poses"]) == 4
    # Its joints are found by other names, and pose it as the template poses itself, but for correctives of poses.
    (theirs,) = [row for row in found(whole, "stretched") if row["part"] == "upper"]
    shirt, used = worn.mesh.submesh(worn.part_faces("upper"))
    posed = worn.pose(stress_poses(BodyParams.rest(betas=len(worn.betas))))[:, used]
    own = [np.percentile(edge_stretch(shirt, shirt.with_vertices(one)), 99.9) for one in posed]
    assert theirs["value"] == pytest.approx(max(own), rel=0.03)
    # Weights of 40 vertices of the shirt go to a foot, one vertex loses its own, one has half, a bind matrix is flat.
    gltf = pygltflib.GLTF2().load(path)
    gltf._glb_data = bytearray(gltf.binary_blob())
    attributes = gltf.meshes[1].primitives[0].attributes
    next(node for node in gltf.nodes if node.name == "body").name = "skin"  # so that nothing is inside a body
    joints = accessor_bytes(gltf, attributes.JOINTS_0, "u1")
    weights = accessor_bytes(gltf, attributes.WEIGHTS_0, "<f4")
    joints[:40], weights[:40] = names.index("left_ankle"), [1, 0, 0, 0]
    weights[50], weights[51] = 0, [0.5, 0, 0, 0]
    joints[52], weights[52] = 3, [0.5, 0.5, 0, 0]
    gltf.save(tmp_path / "faulty.glb")
    report = CheckMesh(tmp_path / "faulty.glb", json=True, out=tmp_path / "out").run()
    assert found(report, "vertices without weights")[0]["value"] == 1
    assert found(report, "weights off a sum of 1")[0]["value"] == pytest.approx(0.5, abs=0.01)
    assert found(report, "a joint twice at a vertex")[0]["status"] == "warn"
    (torn,) = [row for row in found(report, "stretched") if row["part"] == "upper"]
    assert torn["status"] == "fail" and torn["value"] > 5.0 * theirs["value"]
    marked = (read_mesh(tmp_path / "out" / "faults.ply").vertex_colors == torn["color"]).all(axis=1)
    assert marked.any() and not marked[: worn.part_mesh("body").vertex_count].any()
    accessor_bytes(gltf, gltf.skins[0].inverseBindMatrices, "<f4")[3] = 0.0
    gltf.save(tmp_path / "flat.glb")
    report = CheckMesh(tmp_path / "flat.glb", json=True).run()
    assert found(report, "bind matrices without an inverse")[0]["value"] == 1 and not found(report, "stretched")


@pytest.mark.long
def test_a_rig_that_is_no_person_is_checked_without_poses(tmp_path, capsys):
    worn = in_a_shirt(open_body_template())
    keep = ("pelvis", "spine1", "left_hip")
    names = tuple(name if name in keep else f"bone{k}" for k, name in enumerate(worn.body.joint_names))
    # A chain instead of a tree has no limbs.
    parents = np.arange(len(names)) - 1
    body = replace(worn.body, joint_names=names, parents=parents)
    write_glb(tmp_path / "chain.glb", replace(worn, body=body), morph_targets=False)
    report = CheckMesh(tmp_path / "chain.glb").run()
    assert "poses" not in report["rig"] and not found(report, "stretched")
    assert "no stress poses" in capsys.readouterr().out
