"""Small glTF files with what real ones have: strides, normalised colours, a picture, sparse values, nodes in nodes."""

from __future__ import annotations

import base64
import io
import json
import struct
from typing import Any

import numpy as np
from PIL import Image


def make_document(vertices: np.ndarray, faces: np.ndarray) -> tuple[dict[str, Any], bytes]:
    """The JSON and the bytes of one mesh, moved by (0, 0, 5) by a node below another, turned by none."""
    count = len(vertices)
    interleaved = np.zeros(count, [("p", "<f4", 3), ("uv", "<f4", 2)])
    interleaved["p"], interleaved["uv"] = vertices, 0.25
    stream = io.BytesIO()
    Image.fromarray(np.arange(12, dtype=np.uint8).reshape(2, 2, 3)).save(stream, "PNG")
    blobs = [
        interleaved.tobytes(),
        faces.astype("<u2").tobytes(),
        np.full((count, 4), 65535, "<u2").tobytes(),
        np.array([0], "<u2").tobytes() + b"\0\0",
        vertices[:1].astype("<f4").tobytes(),
        stream.getvalue(),
    ]
    starts = np.cumsum([0] + [len(blob) + -len(blob) % 4 for blob in blobs])
    views = [
        {"buffer": 0, "byteOffset": int(start), "byteLength": len(blob)}
        for start, blob in zip(starts[:-1], blobs, strict=True)
    ]
    views[0]["byteStride"] = 20
    sparse = {
        "count": 1,
        "indices": {"bufferView": 3, "componentType": 5123},
        "values": {"bufferView": 4, "byteOffset": 0},
    }
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"children": [1], "translation": [0, 0, 5]},
            {"mesh": 0, "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]},
        ],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {"POSITION": 0, "TEXCOORD_0": 1, "COLOR_0": 3},
                        "indices": 2,
                        "material": 0,
                        "mode": 4,
                    }
                ]
            }
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 1, 1, 1]}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 5, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3", "sparse": sparse},
            {"bufferView": 0, "byteOffset": 12, "componentType": 5126, "count": count, "type": "VEC2"},
            {"bufferView": 1, "componentType": 5123, "count": faces.size, "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5123, "normalized": True, "count": count, "type": "VEC4"},
        ],
        "bufferViews": views,
    }
    return document, b"".join(blob + bytes(-len(blob) % 4) for blob in blobs)


def make_gltf(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """A `.gltf` with its bytes in a data URI."""
    document, data = make_document(vertices, faces)
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    return json.dumps({**document, "buffers": [{"byteLength": len(data), "uri": uri}]}).encode()


def make_glb(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """The same as a `.glb`."""
    document, data = make_document(vertices, faces)
    return pack_glb({**document, "buffers": [{"byteLength": len(data)}]}, data)


def pack_glb(document: dict[str, Any], data: bytes) -> bytes:
    """A GLB of a document and its binary chunk."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks
