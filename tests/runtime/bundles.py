"""Small students as bundles, and a dressed person whose skirt is simulated."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from avatar.export.bundle import BundleConfig, BundleExtras, write_bundle
from avatar.gaussians.sampling import SamplingConfig, sample_on_mesh
from avatar.models.networks.blend_shapes import BlendShapeConfig
from avatar.models.networks.deformation_field import FieldConfig
from avatar.models.student import Student, StudentConfig
from avatar.rig.rig import Rig
from avatar.runtime import AvatarPlayer
from smplxpp.core.files.tensor_bytes import pack_tensors, unpack_tensors
from smplxpp.core.params import BodyParams
from tests.cloth.persons import person, standing
from tests.cloth.test_driver import QUICK, garment, swaying
from tests.dolls.dancing import dance, template
from tests.models.test_model_file import make

KINDS = (
    *("student", "no field", "control points", "still body", "regression"),
    *("shapes", "local", "gated", "pruned", "whole"),
)
EXACT = BundleConfig(exact=True)


@cache
def rig() -> Rig:
    """Of the doll that dances."""
    return Rig(template())


def student(kind: str) -> Student:
    """A doll's student of one of `KINDS`; "whole" has everything that one can have."""
    if kind != "whole":
        return make(kind, rig())
    torch.manual_seed(3)
    known = torch.tensor(dance().body_pose[:4], dtype=torch.float32)
    config = StudentConfig(
        FieldConfig(width=24, hidden_layers=3, code_size=4, local_pose=2),
        BlendShapeConfig(expression_size=2, head_shapes=3, body_shapes=5, width=8, gated=True, jaw=True, parts=3),
        control_points=60,
    )
    it = Student(config, rig(), sample_on_mesh(template(), SamplingConfig(count=400)), (0, 1, 2), known_poses=known)
    with torch.no_grad():
        for name, value in it.named_parameters():
            if not name.startswith("gaussians."):
                # Centimetres, not decimetres: what the hidden layers say is of the order of one.
                size = 0.005 if name.startswith("field.") and ".last." in name else 0.05
                value.add_(size * torch.randn(value.shape))
    return it


def write(path: Path, it: Student, config: BundleConfig | None = None, **extras) -> dict[str, int]:
    """Write a student with a motion."""
    return write_bundle(path, it, BundleExtras(name="doll", motion=dance(), **extras), config)


@cache
def dressed() -> Student:
    """The person of balls in a skirt."""
    torch.manual_seed(1)
    config = StudentConfig(FieldConfig(width=8, hidden_layers=2, code_size=4), None, control_points=40)
    it = Student(config, Rig(person()), sample_on_mesh(person(), SamplingConfig(count=600)), (0, 1))
    with torch.no_grad():
        for value in it.field.parameters():
            value.add_(0.02 * torch.randn(value.shape))
    return it


def write_dressed(folder: Path, config: BundleConfig | None = None) -> None:
    """Write her, with her skirt to be simulated."""
    extras = BundleExtras(name="dressed", garments=[garment()], motion=replace(standing(), fps=20.0))
    write_bundle(folder / "me.avatar", dressed(), extras, config)


def play_dressed(path: Path) -> list[np.ndarray]:
    """Play a bundle as a program does; return where its splats are."""
    player = AvatarPlayer(path, threads=1, cloth=replace(QUICK, ramp=0.0, hold=0.0))
    motion = player.motion
    seen = [] if motion is None else [player.pose(motion.frame(0)).means.copy()]
    frames: list[BodyParams] = [swaying(k / 20.0) for k in range(2)]
    return seen + [player.step(frame, 0.05).means.copy() for frame in frames]


def tampered(good: Path) -> Iterator[tuple[str, bytes]]:
    """Yield copies of a bundle with one fault each, by name: of archive, manifest, headers of pieces, and tensors.

    Digests and checksums are right wherever they are not the fault; some faults leave a bundle that is one.
    """
    with zipfile.ZipFile(good) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    yield "as it was", _zipped(files)
    yield from _bad_archives(_zipped(files))
    manifest = json.loads(files["manifest.json"])
    for where in ("", "model", "pieces", *(f"pieces/{piece}" for piece in manifest["pieces"])):
        yield from _bad_entries(files, manifest, where)
    for piece, entry in manifest["pieces"].items():
        data = files[entry["file"]]
        for what, content in (*_bad_headers(data), *_bad_tensors(data)):
            yield f"{piece}: {what}", _zipped({**files, entry["file"]: content}, digests=True)


def _zipped(files: Mapping[str, bytes], *, digests: bool = False) -> bytes:
    if digests:
        manifest = json.loads(files["manifest.json"])
        for entry in manifest["pieces"].values():
            content = files[entry["file"]]
            entry |= {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        files = {**files, "manifest.json": json.dumps(manifest).encode()}
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content)
    return stream.getvalue()


def _bad_archives(data: bytes) -> Iterator[tuple[str, bytes]]:
    # The directory, whose first entry is the manifest's, and the record behind it.
    at, end = int.from_bytes(data[-6:-2], "little"), len(data) - 22

    def with_bytes(place: int, *value: int) -> bytes:
        return data[:place] + bytes(value) + data[place + len(value) :]

    yield "a byte before it", b"x" + data
    yield "a byte behind it", data + b"x"
    yield "a comment", data[:-2] + b"\1\0x"
    yield "cut off", data[:-40]
    yield "empty", b""
    yield "a checksum", with_bytes(at + 16, data[at + 16] ^ 1)
    yield "an encrypted piece", with_bytes(at + 8, 1)
    yield "a patch", with_bytes(at + 8, 0x20)
    yield "another method", with_bytes(at + 10, 9)
    yield "another name behind the directory's", with_bytes(30, ord("n"))
    yield "a longer piece", with_bytes(at + 24, data[at + 24] ^ 1)
    yield "a piece elsewhere", with_bytes(at + 42, 1)
    yield "a count of pieces", with_bytes(end + 10, data[end + 10] + 1)
    yield "a size of the directory", with_bytes(end + 12, data[end + 12] ^ 1)


_ODD: tuple[Any, ...] = (
    *(None, True, -5, 0, 2.0, 2.5, 1e300, "2", "x", [], {}, [None], ["x"], {"x": 1}, 10**18, float("nan")),
)


def _bad_entries(files: Mapping[str, bytes], manifest: dict[str, Any], where: str) -> Iterator[tuple[str, bytes]]:
    def changed(change: Callable[[dict[str, Any]], object]) -> bytes:
        copy = json.loads(json.dumps(manifest))
        node = copy
        for key in where.split("/") if where else ():
            node = node[key]
        change(node)
        return _zipped({**files, "manifest.json": json.dumps(copy).encode()})

    node = manifest
    for key in where.split("/") if where else ():
        node = node[key]
    for name in node:
        yield f"{where}/{name}: missing", changed(lambda own, name=name: own.pop(name))
        for odd in _ODD:
            yield f"{where}/{name}: {odd!r}", changed(lambda own, name=name, odd=odd: own.update({name: odd}))
        if isinstance(node[name], list) and node[name]:
            yield f"{where}/{name}: one less", changed(lambda own, name=name: own[name].pop())
            yield f"{where}/{name}: one number", changed(lambda own, name=name: own[name].__setitem__(0, -1.5))
    if not where:
        text = files["manifest.json"].decode()
        for what, content in (
            ("UTF-16", text.encode("utf-16")),
            ("a mark of UTF-8", b"\xef\xbb\xbf" + text.encode()),
            ("no UTF-8", text.encode().replace(b"doll", b"d\xffll").replace(b"dressed", b"d\xffll")),
            ("half a character", text.replace('smplxpp-avatar"', 'smplxpp-avatar", "x": "\\ud800"').encode()),
            ("NUL", text.replace('smplxpp-avatar"', 'smplxpp-avatar", "x": "\\u0000"').encode()),
            ("a long integer", text.replace('smplxpp-avatar"', f'smplxpp-avatar", "x": {"1" * 30}').encode()),
            ("deep", text.replace('smplxpp-avatar"', f'smplxpp-avatar", "x": {"[" * 70}{"]" * 70}').encode()),
            ("no object", b"[]"),
            ("no JSON", b"hello"),
        ):
            yield f"manifest: {what}", _zipped({**files, "manifest.json": content})
        yield "a file beside", _zipped({**files, "more.bin": b"1"})
        yield "a path", _zipped({**files, "../more.bin": b"1"})
        yield "a piece that none knows", changed(lambda own: own["pieces"].update(more=own["pieces"]["skeleton"]))
        yield "another field", changed(lambda own: own["model"].update(more=1))


def _bad_headers(data: bytes) -> Iterator[tuple[str, bytes]]:
    length = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    names = [name for name in header if name != "__metadata__"]

    def packed(header: Any, body: bytes) -> bytes:
        text = json.dumps(header).encode()
        return len(text).to_bytes(8, "little") + text + body

    def with_entry(name: str, **values: Any) -> dict[str, Any]:
        return {**header, name: {**header[name], **values}}

    last = max(names, key=lambda name: header[name]["data_offsets"])
    start, end = header[last]["data_offsets"]
    yield "no header", data[:4]
    yield "a header longer than the piece", (1 << 40).to_bytes(8, "little") + data[8:]
    yield "a header that is a list", packed([], body)
    yield "a byte behind the tensors", packed(header, body + b"x")
    yield "a byte less", packed(header, body[:-1])
    yield "a hole", packed(with_entry(last, data_offsets=[start + 8, end + 8]), body[:start] + bytes(8) + body[start:])
    yield "shared bytes", packed({**header, "again": header[last]}, body)
    yield "no offsets", packed(with_entry(last, data_offsets=[]), body)
    yield "offsets as texts", packed(with_entry(last, data_offsets=[str(start), str(end)]), body)
    yield "a negative size", packed(with_entry(last, shape=[-1, *header[last]["shape"]]), body)
    yield "a size as a fraction", packed(with_entry(last, shape=[0.5, *header[last]["shape"]]), body)
    yield "a size of one", packed(with_entry(last, shape=[1, *header[last]["shape"]]), body)
    yield "no kind", packed(with_entry(last, dtype=None), body)
    yield "a kind of the language", packed(with_entry(last, dtype="constructor"), body)
    yield "bools", packed(with_entry(last, dtype="BOOL", shape=[end - start]), body)
    for about in ("{", "[]", "1", '{"schema": NaN}', '{"schema": 9, "garments": []}', '{"schema": 1, "garments": [1]}'):
        yield f"it says {about} of itself", packed({**header, "__metadata__": {"about": about}}, body)
    yield "it says nothing in words", packed({**header, "__metadata__": {"about": 1}}, body)
    yield "another thing of itself", packed({**header, "__metadata__": 1}, body)


def _bad_tensors(data: bytes) -> Iterator[tuple[str, bytes]]:
    tensors, about = unpack_tensors(data, subject="piece")

    def packed(changes: Mapping[str, np.ndarray], without: str = "") -> bytes:
        return pack_tensors({name: v for name, v in {**tensors, **changes}.items() if name != without}, about or None)

    for name, value in tensors.items():
        yield f"{name} missing", packed({}, name)
        yield f"{name} renamed", packed({f"{name}x": value}, name)
        if value.ndim:
            yield f"{name} turned", packed({name: value.T})
            yield f"{name} with an axis", packed({name: value[None]})
            yield f"{name} shorter", packed({name: value[:-1]})
            yield f"{name} narrower", packed({name: value[..., :-1]})
            yield f"{name} empty", packed({name: value[:0]})
        yield f"{name} as doubles", packed({name: value.astype(np.float64)})
        yield f"{name} as whole numbers", packed({name: value.astype(np.int64)})
        yield f"{name} as bools", packed({name: value.astype(bool)})
        odd = (np.nan, np.inf, -1.0, 1e30, 0.0) if value.dtype.kind == "f" else (-1, 2**31 - 1, 2**62, 0)
        for number in odd if value.size else ():
            kind = value.dtype if value.dtype.kind == "f" else np.dtype(np.int64)
            with np.errstate(over="ignore"):
                changed = value.astype(kind)
                changed.flat[0] = number
            if value.dtype.kind != "f" and number in (0, -1):
                changed = changed.astype(value.dtype)
            yield f"{name} with {number}", packed({name: changed})
        if value.ndim and value.shape[0] > 1:
            yield f"{name} backwards", packed({name: value[::-1]})
