"""Compressed glTF files: what Draco's and meshoptimizer's own encoders wrote is read as the same mesh."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import DracoPy
import meshoptimizer
import numpy as np
import pytest

from smplxpp.core.errors import InputError, MissingExtraError
from smplxpp.core.mesh_files.mesh_io import read_raw_mesh
from smplxpp.core.mesh_files.raw_mesh import RawMesh
from tests.core.gltf_maker import pack_glb

# A grid of 6 x 6 vertices with heights, so that the codecs have something to predict.
_X, _Y = np.meshgrid(np.arange(6.0), np.arange(6.0))
VERTICES = np.stack([_X, _Y, np.sin(_X) * np.cos(_Y)], axis=-1).reshape(-1, 3).astype(np.float32)
_CORNER = (6 * np.arange(5)[:, None] + np.arange(5)).reshape(-1)
FACES = np.concatenate([np.stack(_CORNER + np.array([[0], [a], [b]]), axis=-1) for a, b in ((1, 7), (7, 6))])
COLORS = np.stack([_X, _Y, 0 * _X], axis=-1).reshape(-1, 3).astype(np.uint16) * 13107


def _document(views: list[dict[str, Any]], primitive: dict[str, Any]) -> dict[str, Any]:
    view = (lambda k: {"bufferView": k}) if len(views) > 1 else (lambda _: {})
    return {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, **primitive}]}],
        "accessors": [
            {**view(0), "componentType": 5126, "count": 36, "type": "VEC3"},
            {**view(1), "componentType": 5123, "count": 36, "type": "VEC4", "normalized": True},
            {**view(2), "componentType": 5123, "count": 150, "type": "SCALAR"},
        ],
        "bufferViews": views,
    }


def _draco() -> tuple[dict[str, Any], bytes]:
    data = DracoPy.encode(VERTICES, FACES, colors=(COLORS >> 8).astype(np.uint8), quantization_bits=16)
    # Draco's kinds of attributes: 0 are positions, 2 colours.
    ids = {row["attribute_type"]: row["unique_id"] for row in DracoPy.decode(data).attributes}
    attributes = {"POSITION": ids[0], "COLOR_0": ids[2]}
    extension = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": attributes}}
    document = _document([{"buffer": 0, "byteLength": len(data)}], {"extensions": extension})
    document["accessors"][1] |= {"componentType": 5121, "type": "VEC3"}
    return {**document, "buffers": [{"byteLength": len(data)}]}, data


def _meshopt() -> tuple[dict[str, Any], bytes]:
    colors = np.concatenate([COLORS, np.full((36, 1), 65535, np.uint16)], axis=1)
    blocks = [
        (meshoptimizer.encode_vertex_buffer(VERTICES, 36, 12), 12, 36, "ATTRIBUTES"),
        (meshoptimizer.encode_vertex_buffer(colors, 36, 8), 8, 36, "ATTRIBUTES"),
        (meshoptimizer.encode_index_buffer(FACES.reshape(-1).astype(np.uint32), 150, 36), 2, 150, "TRIANGLES"),
    ]
    views, data = [], b""
    for block, stride, count, mode in blocks:
        packed = bytes(block)
        place = {"buffer": 0, "byteOffset": len(data), "byteLength": len(packed), "byteStride": stride}
        extension = {"EXT_meshopt_compression": {**place, "count": count, "mode": mode}}
        views.append({"buffer": 1, "byteLength": count * stride, "extensions": extension})
        data += packed
    fallback = {"byteLength": 1, "extensions": {"EXT_meshopt_compression": {"fallback": True}}}
    return {**_document(views, {}), "buffers": [{"byteLength": len(data)}, fallback]}, data


def _read(folder: Path, document: dict[str, Any], data: bytes) -> RawMesh:
    path = folder / "a.glb"
    path.write_bytes(pack_glb(document, data))
    return read_raw_mesh(path)


def _corners(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The corners of the faces, each from its lowest one on, in one order: the codecs turn and sort triangles."""
    rounded = np.round(vertices[faces].astype(np.float64), 3)
    first = np.array([min(range(3), key=lambda k, face=face: tuple(face[k])) for face in rounded])
    turned = rounded[np.arange(len(faces))[:, None], (first[:, None] + np.arange(3)) % 3].reshape(len(faces), -1)
    return turned[np.lexsort(turned.T)]


@pytest.mark.parametrize("make", [_draco, _meshopt])
def test_a_compressed_mesh_is_the_mesh(tmp_path: Path, make):
    raw = _read(tmp_path, *make())
    np.testing.assert_allclose(_corners(raw.vertices, raw.faces), _corners(VERTICES, FACES), atol=2e-3)
    # 16 bits are linear, 8 bits sRGB.
    place = np.array([np.linalg.norm(VERTICES - v, axis=1).argmin() for v in raw.vertices])
    bright = COLORS[place, 0] > 40_000
    assert raw.vertex_colors is not None
    assert raw.vertex_colors[bright, 0].min() > raw.vertex_colors[~bright, 0].max()


def test_views_with_a_filter(tmp_path: Path):
    document, data = _meshopt()
    # Exponents of 8 bits over mantissas of 24: whole numbers are exact.
    whole = (np.round(VERTICES).astype(np.int32) & 0xFFFFFF).astype(np.uint32)
    packed = bytes(meshoptimizer.encode_vertex_buffer(whole.view(np.float32), 36, 12))
    view = document["bufferViews"][0]["extensions"]["EXT_meshopt_compression"]
    view |= {"byteOffset": len(data), "byteLength": len(packed), "filter": "EXPONENTIAL"}
    document["buffers"][0]["byteLength"] += len(packed)
    np.testing.assert_array_equal(_read(tmp_path, document, data + packed).vertices, np.round(VERTICES))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"mode": "CUBES"}, "ATTRIBUTES.*CUBES"),
        ({"byteStride": 7}, "known stride.*7 bytes"),
        ({"filter": "SEPIA"}, "SEPIA"),
        ({"byteLength": 1 << 30}, "bytes below"),
        ({"count": 1 << 36}, "1 GiB"),
        ({"count": 40_000}, "data of the codec"),
        ({"byteLength": 20}, "data of the codec"),
        ({"count": "many"}, "count"),
    ],
)
def test_damaged_views_say_what_is_wrong(tmp_path: Path, change: dict[str, Any], words: str):
    document, data = _meshopt()
    document["bufferViews"][0]["extensions"]["EXT_meshopt_compression"] |= change
    with pytest.raises(InputError, match=words):
        _read(tmp_path, document, data)


@pytest.mark.parametrize("cut", [4, 20, 200])
def test_damaged_draco_says_so(tmp_path: Path, cut: int):
    document, data = _draco()
    document["bufferViews"][0]["byteLength"] = min(cut, len(data) - 10)
    with pytest.raises(InputError, match=r"Draco primitive.*data of the codec"):
        _read(tmp_path, document, data)


def test_an_attribute_that_draco_does_not_have(tmp_path: Path):
    document, data = _draco()
    primitive = document["meshes"][0]["primitives"][0]
    primitive["extensions"]["KHR_draco_mesh_compression"]["attributes"]["COLOR_0"] = 9
    with pytest.raises(InputError, match="attribute COLOR_0"):
        _read(tmp_path, document, data)


def test_draco_beside_a_copy_without_compression_needs_no_codec(tmp_path: Path, monkeypatch):
    document, data = _draco()
    plain = VERTICES.tobytes() + FACES.astype(np.uint16).tobytes()
    document["bufferViews"] += [
        {"buffer": 0, "byteOffset": len(data), "byteLength": VERTICES.nbytes},
        {"buffer": 0, "byteOffset": len(data) + VERTICES.nbytes, "byteLength": 300},
    ]
    document["accessors"][0]["bufferView"], document["accessors"][2]["bufferView"] = 1, 2
    del document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
    document["buffers"][0]["byteLength"] += len(plain)
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    np.testing.assert_array_equal(_read(tmp_path, document, data + plain).faces, FACES)


@pytest.mark.parametrize(("make", "module"), [(_draco, "DracoPy"), (_meshopt, "meshoptimizer")])
def test_without_the_codec_the_extra_is_named(tmp_path: Path, monkeypatch, make, module: str):
    document, data = make()
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingExtraError, match=r"compressed glTF files needs.*gltf"):
        _read(tmp_path, document, data)


def test_a_dense_scan_in_less_than_a_byte_a_face_is_not_taken_for_a_repeated_mesh(tmp_path: Path):
    # Draco packs a fine scan of half a million vertices into fewer bytes than it has vertices and faces. Here the least
    # that is always allowed is out of reach: 250 x 250 vertices and their faces are 186,502, seen six times.
    side = 250
    x, y = np.meshgrid(np.arange(float(side)), np.arange(float(side)))
    points = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = (side * np.arange(side - 1)[:, None] + np.arange(side - 1)).reshape(-1)
    faces = np.concatenate([corner[:, None] + np.array(k) for k in ((0, 1, side + 1), (0, side + 1, side))])
    data = DracoPy.encode(points, faces, quantization_bits=8)
    assert len(data) < len(points) + len(faces)
    extension = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    document = _document([{"buffer": 0, "byteLength": len(data)}], {"extensions": extension})
    document["meshes"][0]["primitives"][0]["attributes"] = {"POSITION": 0}
    document |= {"nodes": [{"mesh": 0}] * 6, "scenes": [{"nodes": list(range(6))}]}
    document |= {"buffers": [{"byteLength": len(data)}]}
    raw = _read(tmp_path, document, data)
    assert len(raw.vertices) + len(raw.faces) > 1_000_000
