"""glTF files: nodes, shared accessors, strips, skins, colours, lost pictures, false offsets."""

from __future__ import annotations

import base64
import copy
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.core.mesh_files.raw_mesh import RawMesh
from tests.core.gltf_maker import make_document, make_glb, make_gltf, pack_glb

VERTICES = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]])
FACES = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])


@pytest.fixture
def document() -> tuple[dict[str, Any], bytes]:
    made, data = make_document(VERTICES, FACES)
    return {**copy.deepcopy(made), "buffers": [{"byteLength": len(data)}]}, data


def _read(folder: Path, document: tuple[dict[str, Any], bytes]) -> RawMesh:
    path = folder / "a.glb"
    path.write_bytes(pack_glb(*document))
    return read_raw_mesh(path)


@pytest.mark.parametrize(("name", "make"), [("a.gltf", make_gltf), ("a.glb", make_glb)])
def test_accessors_in_their_order_in_the_world(tmp_path: Path, name: str, make):
    (tmp_path / name).write_bytes(make(VERTICES, FACES))
    raw = read_raw_mesh(tmp_path / name)
    np.testing.assert_allclose(raw.vertices, VERTICES + [0, 0, 5], atol=1e-6)
    np.testing.assert_array_equal(raw.faces, FACES)
    assert (raw.vertex_colors == [0, 1, 2]).all()  # the picture's upper left texel: v is 0 at its upper edge


def test_data_in_a_file_beside_it_and_not_elsewhere(tmp_path: Path, document):
    inner = tmp_path / "inner"
    (inner / "more data").mkdir(parents=True)
    (inner / "more data" / "a.bin").write_bytes(document[1])
    (tmp_path / "b.bin").write_bytes(document[1])
    path = inner / "a.gltf"
    document[0]["buffers"][0]["uri"] = "more%20data/a.bin"
    path.write_text(json.dumps(document[0]))
    np.testing.assert_array_equal(read_raw_mesh(path).faces, FACES)
    for uri in (
        "../b.bin",
        str(tmp_path / "b.bin"),
        "..\\b.bin",
        "%2e%2e/b.bin",
        "https://example.org/b.bin",
        "/dev/zero",
    ):
        document[0]["buffers"][0]["uri"] = uri
        path.write_text(json.dumps(document[0]))
        with pytest.raises(InputError, match="mesh file's folder"):
            read_raw_mesh(path)


def test_primitives_that_share_vertices_do_not_repeat_them(tmp_path: Path, document):
    primitives = document[0]["meshes"][0]["primitives"]
    primitives.append({**primitives[0], "mode": 6, "indices": 2})
    raw = _read(tmp_path, document)
    assert len(raw.vertices) == 5 and len(raw.faces) == 4 + 10


def test_strips_turn_every_other_triangle(tmp_path: Path, document):
    primitive = document[0]["meshes"][0]["primitives"][0]
    primitive["mode"] = 5
    del primitive["indices"]
    np.testing.assert_array_equal(_read(tmp_path, document).faces, [[0, 1, 2], [1, 3, 2], [2, 3, 4]])


def test_a_mirrored_node_keeps_faces_outward(tmp_path: Path, document):
    document[0]["nodes"][1]["scale"] = [-1, 1, 1]
    raw = _read(tmp_path, document)
    np.testing.assert_array_equal(raw.faces, FACES[:, ::-1])
    np.testing.assert_allclose(raw.vertices, VERTICES * [-1, 1, 1] + [0, 0, 5], atol=1e-6)


def test_a_mesh_that_two_nodes_show_is_there_twice(tmp_path: Path, document):
    document[0]["nodes"][0]["children"].append(2)
    turned = [0, 0, -1, 0, 0, 1, 0, 0, 1, 0, 0, 0, 7, 0, 0, 1]  # columns: x to -z, z to x, moved along x
    document[0]["nodes"].append({"mesh": 0, "matrix": turned})
    raw = _read(tmp_path, document)
    np.testing.assert_allclose(raw.vertices[5:], VERTICES[:, [2, 1, 0]] * [1, 1, -1] + [7, 0, 5], atol=1e-6)
    np.testing.assert_array_equal(raw.faces[4:], FACES + 5)


def test_a_skinned_mesh_stands_as_its_joints_do(tmp_path: Path, document):
    gltf, data = document
    count = len(VERTICES)
    blobs = [np.zeros((count, 4), "u1").tobytes(), np.tile([1, 0, 0, 0], (count, 1)).astype("<f4").tobytes()]
    for blob in blobs:
        gltf["bufferViews"].append({"buffer": 0, "byteOffset": len(data), "byteLength": len(blob)})
        data += blob
    view = len(gltf["bufferViews"])
    gltf["accessors"] += [
        {"bufferView": view - 2, "componentType": 5121, "count": count, "type": "VEC4"},
        {"bufferView": view - 1, "componentType": 5126, "count": count, "type": "VEC4"},
    ]
    gltf["meshes"][0]["primitives"][0]["attributes"] |= {"JOINTS_0": 4, "WEIGHTS_0": 5}
    gltf["nodes"][1] |= {"skin": 0, "translation": [100, 0, 0]}  # which a skinned mesh does not follow
    gltf["nodes"].append({"translation": [0, 3, 0]})
    gltf["nodes"][0]["children"].append(2)
    gltf["skins"] = [{"joints": [2]}]
    np.testing.assert_allclose(_read(tmp_path, (gltf, data)).vertices, VERTICES + [0, 3, 5], atol=1e-6)


def test_vertex_colours_of_16_bits_are_linear_and_base_colours_too(tmp_path: Path, document):
    gltf, data = document
    del gltf["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    start = gltf["bufferViews"][2]["byteOffset"]
    data = data[:start] + np.full(20, 14030, "<u2").tobytes() + data[start + 40 :]
    assert (_read(tmp_path, (gltf, data)).vertex_colors == 128).all()
    del gltf["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
    gltf["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [1, 0.2140, 0, 1]
    assert (_read(tmp_path, (gltf, data)).vertex_colors == [255, 127, 0]).all()
    gltf["materials"] = [{}]
    assert _read(tmp_path, (gltf, data)).vertex_colors is None


def _srgb(linear: float) -> int:
    """IEC 61966-2-1, the slow way."""
    return round(255 * (12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055))


def test_picture_vertex_colours_and_base_colour_are_multiplied_in_linear_light(tmp_path: Path, document):
    gltf, data = document
    stream = io.BytesIO()
    Image.fromarray(np.full((1, 1, 3), 188, np.uint8)).save(stream, "PNG")  # 188 of sRGB is half of the light
    gltf["images"] = [{"uri": "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()}]
    gltf["materials"][0]["pbrMetallicRoughness"]["baseColorFactor"] = [1, 0.5, 0.25, 0.1]
    light = ((188 / 255 + 0.055) / 1.055) ** 2.4
    expected = [188, _srgb(light * 0.5), _srgb(light * 0.25)]
    assert (_read(tmp_path, (gltf, data)).vertex_colors == expected).all()
    start = gltf["bufferViews"][2]["byteOffset"]
    data = data[:start] + np.full(20, 13107, "<u2").tobytes() + data[start + 40 :]  # a fifth of the light
    expected = [_srgb(light * 0.2 * factor) for factor in (1, 0.5, 0.25)]
    assert (_read(tmp_path, (gltf, data)).vertex_colors == expected).all()


@pytest.mark.parametrize(
    ("mode", "offset", "expected"),
    [
        (None, 0.0, 10),  # the maker's coordinates are all 0.25: the first of four texels
        (None, 1.25, 20),
        (10497, -0.25, 40),
        (10497, -0.5, 30),
        (33071, 1.25, 40),
        (33071, -9.0, 10),
        (33648, 1.25, 30),
        (33648, -0.5, 20),
        (33648, -0.75, 30),
    ],
)
def test_pictures_repeat_mirror_or_end_at_their_edges(tmp_path: Path, document, mode, offset: float, expected: int):
    gltf, _ = document
    stream = io.BytesIO()
    row = np.array([[10, 20, 30, 40]], np.uint8)
    Image.fromarray(row.repeat(4, axis=0)).convert("RGB").save(stream, "PNG")
    gltf["images"] = [{"uri": "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode()}]
    use = gltf["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]
    use["extensions"] = {"KHR_texture_transform": {"offset": [offset - 0.125, 0]}}
    if mode is not None:
        gltf["samplers"], gltf["textures"][0]["sampler"] = [{"wrapS": mode}], 0
    assert (_read(tmp_path, document).vertex_colors == expected).all()


@pytest.mark.parametrize(
    "images", [None, [], [{"uri": "gone.png"}], [{"uri": "../gone.png"}], [{"bufferView": 0}], [{}]]
)
def test_lost_pictures_lose_colours_alone(tmp_path: Path, document, images):
    document[0]["images"] = images
    if images is None:
        del document[0]["images"], document[0]["textures"][0]["source"]
    with pytest.warns(GeometryWarning, match="gone.png" if images and "gone" in str(images) else "colours"):
        raw = _read(tmp_path, document)
    assert raw.vertex_colors is None
    np.testing.assert_array_equal(raw.faces, FACES)


@pytest.mark.parametrize(
    ("texture", "start", "words"),
    [
        ({"extensions": {"KHR_texture_basisu": {"source": 0}}}, b"", "only the pictures of KHR_texture_basisu"),
        ({"extensions": {"EXT_texture_avif": {"source": 0}}}, b"", "only the pictures of EXT_texture_avif"),
        ({"source": 0}, b"\xabKTX 20\xbb\r\n", "received KTX2"),
        ({"source": 0}, b"\0\0\0 ftypavif", "received AVIF"),
    ],
)
def test_pictures_of_other_formats_are_named_with_the_remedy(tmp_path: Path, document, texture, start, words):
    gltf, _ = document
    gltf["images"] = [{"uri": "data:;base64," + base64.b64encode(start + bytes(64)).decode()}]
    gltf["textures"] = [texture]
    with pytest.warns(GeometryWarning, match=f"{words}.*PNG or JPEG textures"):
        assert _read(tmp_path, document).vertex_colors is None


def test_points_and_lines_are_left_out_and_counted(tmp_path: Path, document):
    document[0]["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": 0})
    with pytest.warns(GeometryWarning, match="1 primitives of points or lines"):
        assert len(_read(tmp_path, document).faces) == 4


def _set(document: dict[str, Any], where: str, value: Any) -> None:
    *keys, last = [int(key) if key.isdigit() else key for key in where.split("/")]
    for key in keys:
        document = document[key]
    document[last] = value


@pytest.mark.parametrize(
    ("where", "value", "words"),
    [
        ("accessors/0/count", 10**12, "within the 100 bytes"),
        ("accessors/0/byteOffset", 90, "within the 100 bytes"),
        ("accessors/0/bufferView", 77, "index of bufferViews"),
        ("accessors/0/componentType", 1, "component type"),
        ("bufferViews/0/byteStride", 4, "within the 100 bytes"),
        ("bufferViews/0/byteLength", 10**9, "buffer view"),
        ("bufferViews/0/byteOffset", -1, "byteOffset"),
        ("accessors/0/sparse/count", 2, "accessor"),
        ("accessors/0/sparse/indices/componentType", 5126, "unsigned indices"),
        ("accessors/2/componentType", 5126, "whole numbers|within"),
        ("accessors/1", {"count": 10**9, "componentType": 5126, "type": "VEC2"}, "no match needed"),
        ("nodes/1/children", [0], "twice"),
        ("nodes/0/children", [1, 1], "twice"),
        ("nodes/0/translation", [0, 0, "five"], "finite numbers"),
        ("nodes/0/translation", [0, 0, 1e300], "within"),
        ("scene", 3, "index of scenes"),
        ("asset/version", "1.0", "glTF 2.0"),
        ("bufferViews/0/extensions", {"EXT_meshopt_compression": {"buffer": 0}}, "meshopt view.*no mode"),
        ("meshes/0/primitives/0/indices", 0, "whole numbers"),
    ],
)
def test_false_documents_say_what_is_wrong(tmp_path: Path, document, where: str, value: Any, words: str):
    _set(document[0], where, value)
    if where == "accessors/1":
        with pytest.warns(GeometryWarning, match="colours of a primitive are lost"):
            _read(tmp_path, document)
        return
    with pytest.raises(InputError, match=words):
        _read(tmp_path, document)


def test_a_small_file_cannot_repeat_its_mesh_beyond_memory(tmp_path: Path):
    document, data = make_document(np.zeros((10_000, 3)), FACES)
    document |= {"buffers": [{"byteLength": len(data)}], "nodes": [{"mesh": 0}] * 200}
    document["scenes"] = [{"nodes": list(range(200))}]
    with pytest.raises(InputError, match="repeat its meshes"):
        _read(tmp_path, (document, data))


def test_a_glb_whose_lengths_do_not_fit(tmp_path: Path):
    data = make_glb(VERTICES, FACES)
    for damaged in (
        data[:-8],
        data[:12],
        data[:8] + b"\xff\xff\xff\xff" + data[12:],
        data[:12] + b"\xff\xff\xff\x7f" + data[16:],
    ):
        (tmp_path / "a.glb").write_bytes(damaged)
        with pytest.raises(InputError, match="damaged"):
            read_raw_mesh(tmp_path / "a.glb")
