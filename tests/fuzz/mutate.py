"""Valid files made invalid: by bytes, by the tokens of a text, by the values of a structure."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import re
import struct
import warnings
import zipfile
from collections.abc import Callable
from typing import Any

import numpy as np

from smplxpp.core.files.pickle_machine import PickleMachine

Rng = np.random.Generator

_NUMBERS = (0, 1, -1, 2, 127, 128, 255, 256, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1)
_TOKENS = (
    *(
        "nan",
        "inf",
        "-inf",
        "1e999",
        "1e308",
        "-1",
        "0",
        "1e-320",
        "9" * 30,
        "1" * 5000,
        "0x10",
        "1,5",
        "",
        "-",
        "true",
    ),
    *(
        "../../../../etc/passwd",
        "/dev/zero",
        "\0",
        "\ud83d\ude00",
        "a" * 3000,
        "[" * 500,
        "{}",
        "%s",
        '"',
        "'",
        "#",
        "\n",
    ),
)
_NUMBER = re.compile(rb"[-+]?\d+\.?\d*(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_]{2,}")


def mutated(name: str, data: bytes, rng: Rng) -> bytes:
    """The content of a file of this name with one to four faults."""
    suffix = name.rpartition(".")[2].lower()
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        for _ in range(int(rng.integers(1, 5))):
            data = _once(suffix, data, rng)
    return data


def _once(suffix: str, data: bytes, rng: Rng) -> bytes:
    ways = _BY_SUFFIX.get(suffix, (_bytes,))
    way = ways[int(rng.integers(len(ways)))] if rng.random() > 0.15 else _bytes
    try:
        return way(data, rng)
    except Exception:  # noqa: BLE001  earlier faults may have left nothing that the way can read
        return _bytes(data, rng)


def _place(data: bytes, rng: Rng) -> int:
    """Somewhere, the beginning more often: headers lie there."""
    return int(rng.integers(max(1, len(data) if rng.random() < 0.5 else min(len(data), 400))))


def _bytes(data: bytes, rng: Rng) -> bytes:
    at, length = _place(data, rng), int(rng.integers(1, 40))
    match int(rng.integers(9)):
        case 0:
            return data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :] if data else data
        case 1:
            return data[:at] + bytes([int(rng.integers(256))]) + data[at + 1 :]
        case 2:
            return data[:at] + data[at + length :]
        case 3:
            return data[:at] + rng.bytes(length) + data[at:]
        case 4:
            return data[: _place(data, rng)]
        case 5:
            number = _NUMBERS[int(rng.integers(len(_NUMBERS)))]
            kinds = ("<I", ">I", "<Q", ">Q", "<H", ">H", "<d", "<f")
            kind = kinds[int(rng.integers(len(kinds)))]
            value = float(number) if kind in ("<d", "<f") else number & (256 ** struct.calcsize(kind) - 1)
            if kind in ("<d", "<f") and rng.random() < 0.5:
                value = (np.nan, np.inf, 1e30)[int(rng.integers(3))]
            packed = struct.pack(kind, value)
            return data[:at] + packed + data[at + len(packed) :]
        case 6:
            return data[:at] + data[at : at + length] * int(rng.integers(2, 300)) + data[at + length :]
        case 7:
            return data[:at] + bytes([0 if rng.random() < 0.5 else 255]) * length + data[at + length :]
        case _:
            return data + data[at : at + length * 10]


def _text(data: bytes, rng: Rng) -> bytes:
    token = _TOKENS[int(rng.integers(len(_TOKENS)))].encode(errors="surrogatepass")
    found = list((_NUMBER if rng.random() < 0.7 else _WORD).finditer(data))
    lines = data.split(b"\n")
    match int(rng.integers(5)):
        case 0 | 1 if found:
            one = found[int(rng.integers(len(found)))]
            return data[: one.start()] + token + data[one.end() :]
        case 2:
            at = int(rng.integers(len(lines)))
            return b"\n".join(lines[:at] + lines[at + 1 :])
        case 3:
            at, other = (int(rng.integers(len(lines))) for _ in range(2))
            return b"\n".join([*lines[:at], lines[other], *lines[at:]])
        case _:
            at = _place(data, rng)
            return data[:at] + token + data[at:]


def _hostile_value(rng: Rng) -> Any:
    deep: Any = 1
    for _ in range(int(rng.integers(1, 90))):
        deep = [deep]
    values = (
        *(None, True, False, "", "x", "1", "a\0b", "../../../x", "/dev/zero", "\ud83d\ude00", "y" * 3000),
        *(0, -1, 1, 3, 1e999, -1e999, float("nan"), 1e308, 1e-320, 10**30, 10**400, 2**31, 2**63, 0.5),
        *([], {}, [[]], [None], {"": {}}, [1, [2, 3]], [0] * 1000, {"a": 1, "b": [2]}, deep),
    )
    return values[int(rng.integers(len(values)))]


def changed(value: Any, rng: Rng) -> Any:
    """A copy of nested dictionaries and lists with one node replaced, removed, doubled or renamed."""
    nodes: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        for key in list(keys)[:60]:
            nodes.append((node, key))
            walk(node[key])

    walk(value)
    if not nodes or rng.random() < 0.03:
        return _hostile_value(rng)
    node, key = nodes[int(rng.integers(len(nodes)))]
    match int(rng.integers(6)):
        case 0:
            del node[key]
        case 1 if isinstance(node, dict):
            node[str(_TOKENS[int(rng.integers(len(_TOKENS)))])] = node.pop(key)
        case 1 if isinstance(node, list):
            node.append(node[key])
        case 2:
            other, its = nodes[int(rng.integers(len(nodes)))]
            try:
                node[key] = json.loads(json.dumps(other[its]))
            except (TypeError, ValueError, KeyError, IndexError):
                node[key] = None
        case 3 if isinstance(node[key], int | float) and not isinstance(node[key], bool):
            node[key] = node[key] * float((-1, 0, 1e-9, 1e9, 1e30, np.inf)[int(rng.integers(6))])
        case _:
            node[key] = _hostile_value(rng)
    return value


def _json(data: bytes, rng: Rng) -> bytes:
    return json.dumps(changed(json.loads(data), rng)).encode()


def _lines_of_json(data: bytes, rng: Rng) -> bytes:
    lines = data.splitlines()
    at = int(rng.integers(len(lines)))
    return b"\n".join([*lines[:at], _json(lines[at], rng), *lines[at + 1 :]])


def _array(array: np.ndarray, rng: Rng) -> np.ndarray:
    match int(rng.integers(10)):
        case 0:
            return array.astype(("f2", "f8", "i4", "i8", "u1", "U9", "?", "c16", "S4")[int(rng.integers(9))])
        case 1:
            return array.ravel()
        case 2:
            return array[..., :-1] if array.ndim else np.array([array, array])
        case 3:
            return array[: len(array) // 2] if array.ndim else array
        case 4:
            return array[None]
        case 5:
            return np.empty((0, *array.shape[1:]), array.dtype)
        case 6:
            return array.T
        case 7:
            return np.array(_hostile_value(rng))
        case 8:
            return np.array([_hostile_value(rng), {"a": 1}], dtype=object)
        case _:
            out = np.array(array, dtype=np.float64)
            flat = out.reshape(-1)
            flat[int(rng.integers(len(flat)))] = (np.nan, np.inf, -1, 1e30, 1e300, 2**40)[int(rng.integers(6))]
            return out if array.dtype.kind == "f" else out.astype(array.dtype)


def _npz(data: bytes, rng: Rng) -> bytes:
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    name = list(arrays)[int(rng.integers(len(arrays)))]
    match int(rng.integers(6)):
        case 0:
            del arrays[name]
        case 1:
            arrays[f"{name}x"] = arrays.pop(name)
        case 2:
            return _raw_npz(data, rng)
        case _:
            arrays[name] = _array(arrays[name], rng)
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def _raw_npz(data: bytes, rng: Rng) -> bytes:
    """The archive again, one entry's bytes changed under a right checksum."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    name = list(entries)[int(rng.integers(len(entries)))]
    entries[name] = _npy(entries[name], rng)
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for entry, content in entries.items():
            archive.writestr(entry, content)
    return stream.getvalue()


def _npy(data: bytes, rng: Rng) -> bytes:
    return _text(data[:128], rng) + data[128:] if rng.random() < 0.6 else _bytes(data, rng)


def _pkl(data: bytes, rng: Rng) -> bytes:
    value = PickleMachine(data).load()  # earlier faults are in it already
    if isinstance(value, dict) and rng.random() < 0.7:
        key = list(value)[int(rng.integers(len(value)))]
        if isinstance(value[key], np.ndarray):
            value[key] = _array(value[key], rng)
            return pickle.dumps(value, protocol=int(rng.integers(2, 6)))
    return pickle.dumps(changed(value, rng), protocol=int(rng.integers(0, 6)))


def _with_json_header(data: bytes, rng: Rng, start: int, width: int) -> bytes:
    """A binary file with a length of `width` bytes, four more (GLB) and a JSON text from `start` on."""
    at = start - (8 if width == 4 else width)
    length = int.from_bytes(data[at : at + width], "little")
    header = json.dumps(changed(json.loads(data[start : start + length]), rng)).encode()
    header += b" " * (-len(header) % 8)
    return (
        data[:at] + len(header).to_bytes(width, "little") + data[at + width : start] + header + data[start + length :]
    )


def _glb(data: bytes, rng: Rng) -> bytes:
    out = _with_json_header(data, rng, 20, 4)
    return out[:8] + len(out).to_bytes(4, "little") + out[12:]


def _safetensors(data: bytes, rng: Rng) -> bytes:
    """Faults that leave a whole file: of what it says of itself, of its numbers, names and types."""
    length = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    names = [name for name in header if name != "__metadata__"]
    name = names[int(rng.integers(len(names)))]
    begin, end = header[name]["data_offsets"]
    match int(rng.integers(0 if "__metadata__" in header else 2, 6)):
        case 0 | 1:
            about = header["__metadata__"]
            key = list(about)[int(rng.integers(len(about)))]
            about[key] = json.dumps(changed(json.loads(about[key]), rng))
        case 2 if end - begin >= 4:
            at = begin + 4 * int(rng.integers((end - begin) // 4))
            body = (
                body[:at]
                + struct.pack("<I", (0x7FC00000, 0x7F800000, 0xFFFFFFFF)[int(rng.integers(3))])
                + body[at + 4 :]
            )
        case 3:
            header[f"{name}x"] = header.pop(name)
        case 4:
            header[name]["shape"] = (
                [*header[name]["shape"][::-1]] if rng.random() < 0.5 else [1, *header[name]["shape"]]
            )
        case _:
            same = {"F32": "I32", "I64": "F64", "I32": "F32", "F16": "I16", "BOOL": "U8"}
            header[name]["dtype"] = same.get(header[name]["dtype"], "U8")
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(8, "little") + text + body


def _avatar(data: bytes, rng: Rng) -> bytes:
    """A bundle again, one of its pieces changed; mostly under digests that are right."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    name = list(entries)[int(rng.integers(len(entries)))]
    match int(rng.integers(8)):
        case 0:
            del entries[name]
        case 1:
            entries[f"../{name}"] = entries.pop(name)
        case 2:
            entries["manifest.json"] = _json(entries["manifest.json"], rng)
        case _:
            entries[name] = _json(entries[name], rng) if name.endswith("json") else _safetensors(entries[name], rng)
    manifest = json.loads(entries["manifest.json"])
    if rng.random() < 0.9:
        for entry in manifest["pieces"].values():
            content = entries[entry["file"]]
            entry |= {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        entries["manifest.json"] = json.dumps(manifest).encode()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for entry, content in entries.items():
            archive.writestr(entry, content)
    return stream.getvalue()


def _safetensors_header(data: bytes, rng: Rng) -> bytes:
    return _with_json_header(data, rng, 8, 8)


def _ply(data: bytes, rng: Rng) -> bytes:
    end = data.index(b"end_header") + 10
    return _text(data[:end], rng) + data[end:] if rng.random() < 0.7 else data[:end] + _bytes(data[end:], rng)


_BY_SUFFIX: dict[str, tuple[Callable[[bytes, Rng], bytes], ...]] = {
    "json": (_json, _json, _text),
    "gltf": (_json, _json, _text),
    "jsonl": (_lines_of_json, _text),
    "npz": (_npz, _npz, _raw_npz),
    "npy": (_npy,),
    "pkl": (_pkl, _pkl, _bytes),
    "glb": (_glb, _glb, _bytes),
    "safetensors": (_safetensors, _safetensors, _safetensors, _safetensors_header),
    "avatar": (_avatar, _avatar, _avatar, _avatar, _bytes),
    "ply": (_ply, _text),
    **dict.fromkeys(("csv", "yml", "txt", "obj", "mtl", "off"), (_text,)),
}
