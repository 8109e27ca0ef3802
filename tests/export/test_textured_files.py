"""Textures in files of other programs: places, pictures and copies at seams, read back by other readers."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest

from smplxpp.core import InputError
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.export import write_glb, write_obj
from smplxpp.export.fbx import blender_command
from smplxpp.template.template import Template
from smplxpp.template.texture import Texture, encode_texture, split_at_seams
from tests.export.glb_reader import GlbReader
from tests.export.templates import random_template
from tests.export.test_glb_validator import validate


@pytest.fixture(scope="module")
def textured() -> Template:
    """A random template whose every third corner has a place of its own, with two pictures."""
    template, rng = random_template(), np.random.default_rng(0)
    corners = template.faces.ravel()
    own = rng.uniform(size=len(corners)) < 1 / 3
    face_uv = np.where(own, template.vertex_count + np.arange(len(corners)), corners)
    pictures = [rng.integers(0, 256, (64, 64, 3)).astype(np.uint8) for _ in range(2)]
    colors, normals = encode_texture(pictures, [np.full((64, 64, 3), (128, 128, 255), np.uint8)] * 2)
    texture = Texture(
        uv=rng.uniform(size=(template.vertex_count + len(corners), 2)),
        face_uv=face_uv.reshape(-1, 3),
        picture=np.array([0, 1, 1, 0]),
        colors=colors,
        normals=normals,
    )
    return replace(template, texture=texture)


def test_glb_has_places_pictures_and_equal_copies_at_seams(tmp_path, textured):
    write_glb(tmp_path / "a.glb", textured)
    reader = GlbReader(tmp_path / "a.glb")
    for index, name in enumerate(textured.part_names[:3]):
        chosen, first = textured.part_faces(name), int(np.flatnonzero(textured.vertex_part == index)[0])
        primitive = reader.mesh(name)[1]
        indices = reader.array(primitive["indices"]).reshape(-1, 3)
        found = {key: reader.array(value) for key, value in primitive["attributes"].items()}
        # A viewer would multiply the texture by COLOR_0.
        assert "COLOR_0" not in found
        faces = textured.faces[chosen]
        np.testing.assert_allclose(found["POSITION"][indices], textured.vertices[faces], atol=1e-6)
        np.testing.assert_allclose(
            found["TEXCOORD_0"][indices], textured.texture.uv[textured.texture.face_uv[chosen]], atol=1e-6
        )
        np.testing.assert_allclose(np.linalg.norm(found["TANGENT"][:, :3], axis=1), 1.0, atol=1e-5)
        # Copies have all that their vertex has, morph targets included.
        count = int((textured.vertex_part == index).sum())
        rows = np.empty(len(found["POSITION"]), int)
        rows[indices.ravel()] = faces.ravel() - first
        copies = np.arange(count, len(rows))
        assert len(copies)
        shared = [key for key in found if key.startswith(("NORMAL", "JOINTS", "WEIGHTS"))]
        for key in shared:
            np.testing.assert_array_equal(found[key][copies], found[key][rows[copies]])
        for target in primitive.get("targets", []):
            moved = reader.array(target["POSITION"])
            np.testing.assert_array_equal(moved[copies], moved[rows[copies]])
        material = reader.json["materials"][primitive["material"]]
        image = reader.json["textures"][material["pbrMetallicRoughness"]["baseColorTexture"]["index"]]["source"]
        view = reader.json["bufferViews"][reader.json["images"][image]["bufferView"]]
        data = reader.binary[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
        assert data == textured.texture.colors[textured.texture.picture[index]]
    assert validate(tmp_path / "a.glb")["issues"]["messages"] == []


def test_fbx_carries_the_pictures_under_names_that_engines_unpack(tmp_path, textured, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where nothing else may appear
    try:
        blender_command()
    except InputError:
        pytest.skip("neither bpy nor Blender is installed")
    data = textured.export(tmp_path / "anna.fbx").read_bytes()
    assert all(picture in data for picture in (*textured.texture.colors, *textured.texture.normals))
    names = [f"anna_{k}.{suffix}".encode() for k, suffix in enumerate(("jpg", "png", "jpg", "png"))]
    assert all(name in data for name in names) and b".anna." not in data
    assert [path.name for path in tmp_path.iterdir()] == ["anna.fbx"]


def test_obj_and_glb_come_back_with_the_same_places(tmp_path, textured):
    write_obj(tmp_path / "a.obj", textured)
    text = (tmp_path / "a.obj").read_text()
    # Without the colours of the vertices our reader takes the materials, as other programs do.
    lines = [" ".join(line.split()[:4]) if line.startswith("v ") else line for line in text.splitlines()]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    write_glb(tmp_path / "a.glb", textured)
    wanted = textured.texture.uv[textured.texture.face_uv]
    kept = textured.vertex_part[textured.faces[:, 0]]
    for name in ("a.obj", "a.glb"):
        raw = read_raw_mesh(tmp_path / name)
        np.testing.assert_allclose(raw.pictures.uv, wanted, atol=2e-6)
        for face in (0, len(raw.faces) - 1):
            loaded = raw.pictures.load[raw.pictures.picture[face]]()
            np.testing.assert_array_equal(loaded, textured.texture.color_image(textured.texture.picture[kept[face]]))


def test_usd_names_pictures_beside_it_or_packs_them(tmp_path, textured):
    pxr = pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdShade, UsdValidation

    from smplxpp.export.usd import write_usd

    assert pxr
    for name in ("a.usdc", "b.usdz"):
        write_usd(tmp_path / name, textured)
        stage = Usd.Stage.Open(str(tmp_path / name))
        body = UsdGeom.Mesh(stage.GetPrimAtPath("/template/upper"))
        corners = np.array(body.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        places = np.array(UsdGeom.PrimvarsAPI(body).GetPrimvar("st").Get())[corners] * [1, -1] + [0, 1]
        wanted = textured.texture.uv[textured.texture.face_uv[textured.part_faces("upper")]]
        np.testing.assert_allclose(places, wanted, atol=1e-6)
        material, _ = UsdShade.MaterialBindingAPI(body.GetPrim()).ComputeBoundMaterial()
        color = UsdShade.Shader(stage.GetPrimAtPath(material.GetPath().AppendChild("color")))
        asset = color.GetInput("file").Get()
        assert asset.resolvedPath, "the picture that the stage names is there"
        validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
        remarks = UsdValidation.ValidationContext(validators).Validate(stage)
        assert not [str(remark.GetErrorAsString()) for remark in remarks]
    assert (tmp_path / "a_color_1.jpg").read_bytes() == textured.texture.colors[1]


def test_seams_split_the_vertices_that_need_it_and_no_others():
    faces, face_uv = np.array([[0, 1, 2], [2, 1, 3]]), np.array([[0, 1, 2], [4, 1, 3]])
    source, rows, split = split_at_seams(faces, face_uv, 5)
    np.testing.assert_array_equal(source, [0, 1, 2, 3, 4, 2])
    np.testing.assert_array_equal(rows, [0, 1, 2, 3, -1, 4])
    np.testing.assert_array_equal(split, [[0, 1, 2], [5, 1, 3]])


def test_a_template_keeps_its_texture_in_its_file_and_undressed(tmp_path, textured):
    textured.save(tmp_path / "a.npz")
    back = Template.load(tmp_path / "a.npz")
    assert back.texture.colors == textured.texture.colors and back.texture.normals == textured.texture.normals
    for name in ("uv", "face_uv", "picture"):
        np.testing.assert_array_equal(getattr(back.texture, name), getattr(textured.texture, name))
    naked = back.naked()
    np.testing.assert_array_equal(naked.texture.face_uv, textured.texture.face_uv[textured.part_faces("body")])
    small = back.texture.resized(16)
    assert small.size == 16 and back.texture.resized(4096) is back.texture
    mean = np.mean(PIL.Image.open(io.BytesIO(small.colors[0])))
    assert abs(mean - np.mean(back.texture.color_image(0))) < 2


def test_an_export_may_have_smaller_pictures_or_the_colours_of_vertices_alone(tmp_path, textured):
    textured.export(tmp_path / "small.obj", texture_size=1024)
    with PIL.Image.open(tmp_path / "small_color_0.jpg") as image:
        assert image.size == (64, 64), "pictures are not made larger"
    textured.export(tmp_path / "plain.glb", texture_size=0)
    reader = GlbReader(tmp_path / "plain.glb")
    assert "images" not in reader.json or not reader.json["images"]
    assert "COLOR_0" in reader.mesh("upper")[1]["attributes"]
    with pytest.raises(InputError, match=r"texture_size.*1024"):
        textured.export(tmp_path / "x.glb", texture_size=1000)
