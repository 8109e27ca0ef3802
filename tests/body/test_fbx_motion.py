"""Motions inside of binary FBX files are read as those of other skeletons: pre-rotations, orders, packed keys."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smplxpp.body import load_params
from smplxpp.body.fbx_motion import read_fbx_motion
from smplxpp.body.skeleton_motion import SkeletonMotion
from smplxpp.core import GeometryWarning, InputError
from tests.body.test_skeletons import called, lively, motion, relative

__all__ = ["motion"]
FPS, SECOND = 30.0, 46_186_158_000


def node(name: str, *values: object, below: tuple[bytes, ...] = (), wide: bool = False, at: int = 0) -> bytes:
    """A node that begins at a place of the file; `below` are made by `later`."""
    packed = b"".join(map(prop, values))
    head = 25 if wide else 13
    begin = at + head + len(name) + len(packed)
    children, place = b"", begin
    for make in below:
        one = make(place)
        children, place = children + one, place + len(one)
    children += b"\0" * head if below else b""
    counts = (begin + len(children), len(values), len(packed), len(name))
    return struct.pack("<QQQB" if wide else "<IIIB", *counts) + name.encode() + packed + children


def later(name: str, *values: object, below: tuple = (), wide: bool = False):
    return lambda at: node(name, *values, below=below, wide=wide, at=at)


def prop(value: object) -> bytes:
    if isinstance(value, np.ndarray):
        kind = {"float32": b"f", "float64": b"d", "int64": b"l"}[value.dtype.name]
        data = zlib.compress(value.tobytes())
        return kind + struct.pack("<III", value.size, 1, len(data)) + data
    if isinstance(value, float):
        return b"D" + struct.pack("<d", value)
    if isinstance(value, int):
        return b"L" + struct.pack("<q", value)
    data = str(value).encode()
    return b"S" + struct.pack("<I", len(data)) + data


def scene_of(motion: SkeletonMotion, path: Path, *, wide: bool = True, skin: bool = True, takes: int = 1) -> Path:
    """An FBX of a motion: joints with pre-rotations, Euler angles in the order z x y, a skin, one or more takes."""
    count, frames = len(motion.names), len(motion.root)
    own = Rotation.random(count, random_state=3)
    times = (np.arange(frames) * SECOND / FPS).astype(np.int64)
    objects, links = [], []

    def add(kind: str, *values: object, below: tuple = ()) -> None:
        objects.append(later(kind, *values, below=below, wide=wide))

    def link(child: int, parent: int, name: str = "") -> None:
        links.append(later("C", *(("OP", child, parent, name) if name else ("OO", child, parent)), wide=wide))

    for take in range(takes):
        add("AnimationStack", 10 + take, f"take {take}\0\1AnimStack", "")
        add("AnimationLayer", 20 + take, "base\0\1AnimLayer", "")
        link(20 + take, 10 + take)
    for k, parent in enumerate(motion.parents):
        base = Rotation.identity() if parent < 0 else own[parent]
        # Pre-rotation is the joint's own axes at rest; R turns about them. Angles go on beyond half a turn.
        before = base.inv() * own[k]
        turn = before.inv() * base.inv() * Rotation.from_matrix(motion.rotations[:, k]) * own[k]
        angles = np.unwrap(turn.as_euler("zxy"), axis=0)[:, [1, 2, 0]]
        step = motion.root if parent < 0 else np.repeat((base.inv().apply(motion.offsets[k]))[None], frames, axis=0)
        fixed = {"PreRotation": before.as_euler("xyz", degrees=True), "Lcl Translation": step[0]}
        table = [("P", "RotationOrder", "enum", "", "", 4)]
        table += [("P", name, "Vector", "", "A", *map(float, value)) for name, value in fixed.items()]
        rows = later("Properties70", below=tuple(later(*row, wide=wide) for row in table), wide=wide)
        add("Model", 100 + k, f"{motion.names[k]}\0\1Model", "LimbNode", below=(rows,))
        link(100 + k, 100 + int(parent) if parent >= 0 else 0)
        if skin:
            bind = np.eye(4)
            bind[:3, :3], bind[:3, 3] = own[k].as_matrix(), motion.rest[k]
            add(
                "Deformer",
                300 + k,
                "\0\1SubDeformer",
                "Cluster",
                below=(later("TransformLink", bind.T.copy(), wide=wide),),
            )
            link(100 + k, 300 + k)
        for take in range(takes):
            for what, values in (
                ("Lcl Rotation", np.degrees(angles)),
                *((("Lcl Translation", step),) if k == 0 else ()),
            ):
                curve = 1000 + 1000 * len(objects)
                add("AnimationCurveNode", curve, "R\0\1AnimCurveNode", "")
                link(curve, 100 + k, what)
                link(curve, 20 + take)
                for axis in range(3):
                    keys = (np.float32(values[:, axis]) * (1 if take == 0 else 0), times)
                    below = (later("KeyTime", keys[1], wide=wide), later("KeyValueFloat", keys[0], wide=wide))
                    add("AnimationCurve", curve + 1 + axis, "\0\1AnimCurve", "", below=below)
                    link(curve + 1 + axis, curve, f"d|{'XYZ'[axis]}")
    data = b"Kaydara FBX Binary  \0\x1a\0" + struct.pack("<I", 7500 if wide else 7400)
    for name, below in (("Objects", objects), ("Connections", links)):
        data += node(name, below=tuple(below), wide=wide, at=len(data))
    path.write_bytes(data + b"\0" * (25 if wide else 13))
    return path


@pytest.mark.parametrize("wide", [False, True])
def test_a_motion_comes_back(tmp_path, motion, wide):
    params = load_params(scene_of(called(motion, "humanik"), tmp_path / "a.fbx", wide=wide))
    assert params.fps == pytest.approx(FPS) and len(params) == len(motion.root)
    np.testing.assert_allclose(relative(params), relative(lively()), atol=2e-5)
    way = [np.ptp(one.transl[:, 2]) for one in (params, lively())]
    assert way[0] == pytest.approx(way[1], abs=1e-4) and way[0] > 0.2


def test_a_skeleton_alone_and_several_takes(tmp_path, motion):
    """Without a skin a frame that stands is the rest pose; of takes the first is read, and the others named."""
    path = scene_of(called(motion, "humanik"), tmp_path / "a.fbx", skin=False, takes=2)
    with pytest.warns(GeometryWarning, match="first of 2 motions is read; --clip NAME chooses another: take 0, take 1"):
        alone = load_params(path)
    np.testing.assert_allclose(relative(alone), relative(lively()), atol=0.03)
    assert read_fbx_motion(path, clip="take 1").rotations.std(axis=0).max() < 1e-6


def test_what_is_no_motion_is_refused(tmp_path, motion):
    data = scene_of(called(motion, "humanik"), tmp_path / "a.fbx").read_bytes()
    cut = data.index(b"KeyValueFloat") + 30
    changes = {
        "a text, or another file": b"; FBX 7.4.0 project file\n",
        "version 6100": data[:23] + struct.pack("<I", 6100) + data[27:],
        "a node from": data[:-4000],
        "whole arrays": data[:cut] + bytes(8) + data[cut + 8 :],
        "an animation of a skeleton": data.replace(b"Lcl Rotation", b"Lcl Rotatiox"),
        "a tree of models": data.replace(prop(100) + prop(0), prop(100) + prop(121)),
    }
    for words, changed in changes.items():
        assert changed != data
        (tmp_path / "b.fbx").write_bytes(changed)
        with pytest.raises(InputError, match=words):
            load_params(tmp_path / "b.fbx")
