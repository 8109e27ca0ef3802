"""What a written GLB holds: parts, colours, influences, morph targets; trimesh as a second reader."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from smplxpp.core.skin_weights import SkinWeights
from smplxpp.export import write_glb
from smplxpp.export.gltf import linear_rgba16
from smplxpp.export.gltf_skin import quantized_influences
from tests.export.glb_reader import GlbReader
from tests.export.templates import open_body_template, random_motion, random_template

PARTS = ("body", "upper", "shoes")


@pytest.fixture(scope="module")
def template():
    return random_template()


@pytest.fixture
def reader(tmp_path, template) -> GlbReader:
    write_glb(tmp_path / "a.glb", template)
    return GlbReader(tmp_path / "a.glb")


def test_trimesh_reads_the_same_parts(tmp_path, template):
    write_glb(tmp_path / "a.glb", template, animation=random_motion(2, expressions=3))
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    assert set(scene.geometry) == set(PARTS)
    for index, name in enumerate(PARTS):
        mesh, rows = scene.geometry[name], template.vertex_part == index
        np.testing.assert_allclose(mesh.vertices, template.vertices[rows], atol=1e-6)
        np.testing.assert_array_equal(mesh.faces, template.faces[template.part_faces(name)] - np.flatnonzero(rows)[0])


def test_a_part_without_faces_is_left_out(reader):
    assert [mesh["name"] for mesh in reader.json["meshes"]] == list(PARTS)


def test_a_material_for_each_part_named_by_its_label(reader):
    materials = reader.json["materials"]
    assert [material["name"] for material in materials] == ["skin", "upper", "shoe"]
    assert [material.get("doubleSided", False) for material in materials] == [False, True, True]
    assert [reader.mesh(name)[1]["material"] for name in PARTS] == [0, 1, 2]


def test_joints_are_named_and_stand_in_their_hierarchy(reader, template):
    nodes, (skin,) = reader.json["nodes"], reader.json["skins"]
    assert [nodes[j]["name"] for j in skin["joints"]] == list(template.body.joint_names)
    place = {node: j for j, node in enumerate(skin["joints"])}
    for j, node in enumerate(skin["joints"]):
        assert {place[child] for child in nodes[node].get("children", [])} == set(
            np.flatnonzero(template.body.parents == j).tolist()
        )


def test_colours_are_linear(reader, template):
    found = reader.array(reader.mesh("upper")[1]["attributes"]["COLOR_0"])
    linear = found[:, :3]
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_array_equal(np.rint(255 * srgb), template.vertex_colors[template.vertex_part == 1])
    assert (found[:, 3] == 1).all()


def test_every_srgb_tone_stays_apart():
    tones = linear_rgba16(np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1))[:, 0]
    assert (np.diff(tones.astype(int)) > 0).all()
    assert (tones[0], tones[255]) == (0, 65535)
    assert tones[188] / 65535 == pytest.approx(0.5029, abs=1e-4)  # mid grey of sRGB


def test_weights_sum_to_exactly_one_in_float32(reader):
    for name in PARTS:
        joints, weights = reader.influences(name)
        assert weights.dtype == np.float32
        # In any order of summation: as they stand, and backwards.
        for row in (weights, weights[:, ::-1]):
            assert (np.add.accumulate(row, axis=1, dtype=np.float32)[:, -1] == 1).all()
        assert (joints[weights == 0] == 0).all()
        assert (np.diff(weights, axis=1) <= 0).all()


def test_parts_of_few_influences_take_one_set(tmp_path):
    template = random_template(influences=4)
    write_glb(tmp_path / "four.glb", template)
    write_glb(tmp_path / "six.glb", random_template(influences=6))
    assert "JOINTS_1" not in GlbReader(tmp_path / "four.glb").mesh("body")[1]["attributes"]
    assert "JOINTS_1" in GlbReader(tmp_path / "six.glb").mesh("body")[1]["attributes"]


def test_a_joint_named_twice_becomes_one_influence():
    one = SkinWeights.from_dense(np.ones((1, 300)), max_influences=3)
    twice = replace(one, joint_indices=np.array([[4, 4, 1]], np.int32), joint_weights=np.array([[0.25, 0.5, 0.25]]))
    joints, weights = quantized_influences(twice)
    np.testing.assert_array_equal(joints, [[4, 1]])
    np.testing.assert_array_equal(weights, [[0.75, 0.25]])
    assert joints.dtype == np.uint16


def test_a_weight_below_the_step_vanishes_without_a_slot():
    joints, weights = quantized_influences(SkinWeights.from_dense(np.array([[1e-9, 1.0]])))
    np.testing.assert_array_equal(joints, [[1]])
    np.testing.assert_array_equal(weights, [[1.0]])


def test_morph_targets_are_the_expression_basis_on_the_body_alone(reader, template):
    mesh, primitive = reader.mesh("body")
    assert mesh["extras"]["targetNames"] == ["expression_00", "expression_01", "expression_02"]
    assert mesh["weights"] == [0, 0, 0]
    for k, target in enumerate(primitive["targets"]):
        np.testing.assert_allclose(reader.array(target["POSITION"]), template.body.exprdirs[..., k], atol=1e-6)
    accessors = [reader.json["accessors"][target["POSITION"]] for target in primitive["targets"]]
    assert accessors[0]["sparse"]["count"] == 10  # few rows
    assert accessors[1]["sparse"]["count"] == 1  # none: assimp reads no accessor without any bytes
    assert "sparse" not in accessors[2]  # all
    assert "targets" not in reader.mesh("upper")[1]


def test_without_morph_targets_none_are_written(tmp_path, template):
    write_glb(tmp_path / "a.glb", template, morph_targets=False)
    mesh, primitive = GlbReader(tmp_path / "a.glb").mesh("body")
    assert "targets" not in primitive and "extras" not in mesh


def test_bounds_are_those_of_the_stored_values(reader):
    bounded = [k for k, accessor in enumerate(reader.json["accessors"]) if "min" in accessor]
    assert len(bounded) == 3 + 3  # positions of three parts, three morph targets
    for k in bounded:
        values = reader.array(k)
        np.testing.assert_array_equal(np.float32(reader.json["accessors"][k]["min"]), values.min(axis=0))
        np.testing.assert_array_equal(np.float32(reader.json["accessors"][k]["max"]), values.max(axis=0))


def test_normals_are_unit_even_without_faces(reader, template):
    for name in PARTS:
        normals = reader.array(reader.mesh(name)[1]["attributes"]["NORMAL"])
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)


def test_the_same_template_gives_the_same_bytes(tmp_path, template):
    motion = random_motion(3, expressions=2)
    for name in ("a.glb", "b.glb"):
        write_glb(tmp_path / name, template, animation=motion)
    assert (tmp_path / "a.glb").read_bytes() == (tmp_path / "b.glb").read_bytes()


def test_open_body_is_small(tmp_path):
    template = open_body_template()
    write_glb(tmp_path / "a.glb", template)
    write_glb(tmp_path / "b.glb", template, morph_targets=False)
    sizes = [(tmp_path / name).stat().st_size for name in ("a.glb", "b.glb")]
    # Full arrays for 52 targets would take 8.7 MB.
    assert sizes[1] < 1.5e6
    assert sizes[0] - sizes[1] < 1.5e6
    reader = GlbReader(tmp_path / "a.glb")
    assert reader.json["accessors"][reader.mesh("body")[1]["indices"]]["componentType"] == 5123
    np.testing.assert_allclose(reader.posed("body"), template.vertices, atol=1e-6)
