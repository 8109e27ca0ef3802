"""Read motions of skeletons from binary FBX files, as Mixamo, motion capture and 3D programs write them.

A node of the file is a name, properties and nodes below it; models, curves and skins are joined by its connections.
Transforms are those of FBX 7: `T Ro Rp Rpre R Rpost^-1 Rp^-1 So Sp S Sp^-1`, angles in degrees.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from smplxpp.body.skeleton_motion import (
    SkeletonMotion,
    chosen_clip,
    moving_skeleton,
    rate_of_keys,
    rest_transforms,
)
from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_bytes

_MAGIC = b"Kaydara FBX Binary  \0\x1a\0"
_SCALARS = {b"Y": "<h", b"C": "<?", b"I": "<i", b"F": "<f", b"D": "<d", b"L": "<q"}
_ARRAYS = {b"f": "<f4", b"d": "<f8", b"l": "<i8", b"i": "<i4", b"b": "|b1"}
_ORDERS = ("xyz", "xzy", "yzx", "yxz", "zxy", "zyx")
_KINDS = {"Lcl Translation": 0.0, "Lcl Rotation": 0.0, "Lcl Scaling": 1.0}
_REMEDY = "export it again, as binary FBX 7 or as GLB"


@dataclass(frozen=True, eq=False)
class _Node:
    """A node: its name, plain properties, arrays still packed, and the nodes below it."""

    name: str
    values: list[Any]
    below: list[_Node] = field(default_factory=list)

    def child(self, name: str) -> _Node | None:
        return next((one for one in self.below if one.name == name), None)


@dataclass(frozen=True)
class _Packed:
    """An array as it lies in the file."""

    kind: str
    count: int
    packed: bool
    data: memoryview

    def read(self, subject: str) -> np.ndarray:
        """Return the numbers; refuses streams that are longer or shorter than they say."""
        size = self.count * np.dtype(self.kind).itemsize
        data: bytes | memoryview = self.data
        if self.packed:
            try:
                data = zlib.decompressobj().decompress(self.data, size + 1)
            except zlib.error as error:
                raise InputError(subject, expected="whole arrays", received=str(error), remedy=_REMEDY) from None
        if len(data) != size:
            raise InputError(subject, expected=f"{size} bytes", received=str(len(data)), remedy=_REMEDY)
        return np.frombuffer(data, self.kind)


class _Parser:
    """Reads nodes one after another, within the bounds of the file."""

    def __init__(self, data: bytes, subject: str) -> None:
        self._data, self._view, self._subject, self._count = data, memoryview(data), subject, 0
        version = int.from_bytes(data[23:27], "little")
        if not data.startswith(_MAGIC) or not 6100 < version < 10_000:
            received = f"version {version}" if data.startswith(_MAGIC) else "a text, or another file"
            raise InputError(subject, expected="a binary FBX file, version 7", received=received, remedy=_REMEDY)
        self._wide = version >= 7500

    def nodes(self) -> list[_Node]:
        """Return the nodes at the top."""
        return self._list(27, len(self._data), 0)

    def _list(self, at: int, end: int, depth: int) -> list[_Node]:
        found = []
        head = "<QQQB" if self._wide else "<IIIB"
        size = struct.calcsize(head)
        while at + size <= end:
            stop, count, length, name = struct.unpack_from(head, self._data, at)
            if not stop:  # an empty node ends the list; behind the last one stands a footer
                if depth and at + size != end:
                    raise self._damaged("a list of nodes that ends early")
                break
            self._count += 1
            begin = at + size + name + length
            most_nodes, deepest = 4_000_000, 64  # films of crowds have fewer, and no file nests as deep
            if not at < begin <= stop <= end or self._count > most_nodes or depth > deepest:
                raise self._damaged(f"a node from {at} to {stop}")
            values = self._values(at + size + name, begin, count)
            text = self._data[at + size : at + size + name].decode("utf-8", "replace")
            found.append(_Node(text, values, self._list(begin, stop, depth + 1) if begin < stop else []))
            at = stop
        return found

    def _values(self, at: int, end: int, count: int) -> list[Any]:
        values: list[Any] = []
        while len(values) < count:
            kind = self._data[at : at + 1]
            at += 1
            if kind in _SCALARS and at + struct.calcsize(_SCALARS[kind]) <= end:
                values.append(struct.unpack_from(_SCALARS[kind], self._data, at)[0])
                at += struct.calcsize(_SCALARS[kind])
            elif kind in (b"S", b"R") and at + 4 <= end:
                size = struct.unpack_from("<I", self._data, at)[0]
                values.append(self._data[at + 4 : at + 4 + size])
                at += 4 + size
            elif kind in _ARRAYS and at + 12 <= end:
                number, packed, size = struct.unpack_from("<III", self._data, at)
                size = size if packed else number * np.dtype(_ARRAYS[kind]).itemsize
                values.append(_Packed(_ARRAYS[kind], number, bool(packed), self._view[at + 12 : at + 12 + size]))
                at += 12 + size
            else:
                raise self._damaged(f"a property of kind {kind!r}")
            if at > end:
                raise self._damaged("a property beyond its node")
        return values

    def _damaged(self, received: str) -> InputError:
        return InputError(self._subject, expected="a whole FBX file", received=received, remedy=_REMEDY)


class _Scene:
    """The objects of a file, and what hangs on what."""

    def __init__(self, nodes: list[_Node], subject: str) -> None:
        self.subject = subject
        self.objects: dict[int, _Node] = {}
        self._up: dict[int, list[tuple[int, str]]] = {}
        for top in nodes:
            for one in top.below if top.name == "Objects" else ():
                if one.values and isinstance(one.values[0], int):
                    self.objects[one.values[0]] = one
        for top in nodes:
            for one in top.below if top.name == "Connections" else ():
                kind, child, parent, *more = [*one.values, b"", b"", b""][:4] if len(one.values) > 2 else (b"", 0, 0)
                if isinstance(child, int) and isinstance(parent, int):
                    self._up.setdefault(child, []).append((parent, _text(more[0] if kind == b"OP" and more else b"")))

    def of(self, kind: str, sort: str = "") -> Iterator[int]:
        """Yield the objects of a kind."""
        for key, one in self.objects.items():
            if one.name == kind and (not sort or (len(one.values) > 2 and _text(one.values[2]) == sort)):
                yield key

    def above(self, key: int, kind: str) -> list[tuple[int, str]]:
        """Return the objects of a kind that another one is connected to, and to which of their properties."""
        return [
            (up, name) for up, name in self._up.get(key, []) if up in self.objects and self.objects[up].name == kind
        ]

    def name(self, key: int) -> str:
        values = self.objects[key].values
        return _text(values[1]).partition("\0")[0] if len(values) > 1 else ""

    def vector(self, key: int, name: str, default: float = 0.0) -> Float64[np.ndarray, " 3"]:
        """Return a property of three numbers; the default where there is none."""
        values = [one for one in self._property(key, name) if isinstance(one, int | float)][:3]
        found = np.array(values if len(values) == 3 else [default] * 3, dtype=np.float64)
        return found if np.isfinite(found).all() else np.full(3, default)

    def number(self, key: int, name: str, default: float = 0.0) -> float:
        values = [one for one in self._property(key, name) if isinstance(one, int | float)]
        return float(values[0]) if values and np.isfinite(values[0]) else default

    def _property(self, key: int, name: str) -> list[Any]:
        table = self.objects[key].child("Properties70")
        found = [one.values for one in table.below if one.values and one.values[0] == name.encode()] if table else []
        return found[0][4:] if found else []

    def array(self, node: _Node, name: str) -> np.ndarray:
        """Return an array below a node as float64; empty where there is none."""
        found = node.child(name)
        packed = found.values[0] if found is not None and found.values else None
        return packed.read(self.subject).astype(np.float64) if isinstance(packed, _Packed) else np.zeros(0)


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else ""


_Curves = dict[tuple[int, str], list[tuple[Float64[np.ndarray, " K"], Float64[np.ndarray, " K"]] | None]]
"""Keys of X, Y and Z of a property of a model: times in seconds, and values."""


def read_fbx_motion(path: str | Path, *, clip: str | None = None) -> SkeletonMotion:
    """Read an animation of a skeleton from a binary FBX file.

    The skeleton is that which its skins are bound to, or the bones that move. Frames are taken at the rate of the keys
    (`rate_of_keys`), angles between keys are linear.

    Args:
        path: of the file.
        clip: name of the take (animation stack); None: the first that moves a skeleton.

    Raises:
        InputError: a text or an older version of FBX, a damaged one, no animation of a skeleton, no take of that name.

    Warns:
        GeometryWarning: takes that are not chosen.
    """
    subject = f"motion {path}"
    most_bytes = 1 << 30
    scene = _Scene(_Parser(read_bytes(path, subject="motion", most=most_bytes), subject).nodes(), subject)
    parents = _parents(scene)
    clips: dict[str, _Curves] = {}
    for stack in scene.of("AnimationStack"):
        curves = _curves(scene, stack, parents)
        if any(name == "Lcl Rotation" for _, name in curves):
            clips[scene.name(stack) or f"take {len(clips)}"] = curves
    if not clips:
        raise InputError(
            subject,
            expected="an animation of a skeleton",
            received=f"none among {len(parents)} nodes",
            remedy="export it with its animation; a mesh alone is no motion",
        )
    curves = list(clips.values())[chosen_clip(list(clips), clip, subject)]
    # Skins are bound to bones: `TransformLink` is a bone's transform to the world, row by row.
    bound: dict[int, Float64[np.ndarray, "4 4"]] = {}
    for bone in parents:
        for cluster, _ in scene.above(bone, "Deformer"):
            matrix = scene.array(scene.objects[cluster], "TransformLink")
            if matrix.shape == (16,) and np.isfinite(matrix).all() and abs(np.linalg.det(matrix.reshape(4, 4))) > 0.0:
                bound.setdefault(bone, matrix.reshape(4, 4).T)
    joints = moving_skeleton(parents, [set(bound)], {node for node, name in curves if name == "Lcl Rotation"})
    every = [keys[0] for one in curves.values() for keys in one if keys is not None]
    times, fps = rate_of_keys(every, len(joints), subject)
    standing = _world(scene, list(parents), parents, {}, np.zeros(1))
    bound = {node: matrix for node, matrix in bound.items() if node in joints}
    world = _world(scene, joints, parents, curves, times)
    motion = SkeletonMotion.from_transforms(
        _names(scene, joints),
        np.array([joints.index(parents[k]) if parents[k] in joints else -1 for k in joints]),
        rest_transforms(joints, parents, {node: standing[node][0] for node in joints}, bound),
        np.stack([world[node] for node in joints], axis=1),
        fps=fps,
    )
    return replace(motion, neutral=bool(bound))


def _parents(scene: _Scene) -> dict[int, int]:
    """Return the parent of each model that leads to the scene's root, parents before children; 0 for the root."""
    above = {one: next((up for up, _ in scene.above(one, "Model")), 0) for one in scene.of("Model")}
    found: dict[int, int] = {}
    for one in above:
        line = []
        # Up to a node that is known, or to the root; a ring ends at the node that was seen.
        while one and one not in found and one not in line:
            line.append(one)
            one = above.get(one, 0)
        if one in line:
            raise InputError(scene.subject, expected="a tree of models", received="a ring", remedy=_REMEDY)
        found |= {node: above[node] for node in reversed(line)}
    return found


def _curves(scene: _Scene, stack: int, parents: Mapping[int, int]) -> _Curves:
    """Return the curves of a take, of its first layer that has some for a property."""
    layers = {one for one in scene.of("AnimationLayer") if stack in dict(scene.above(one, "AnimationStack"))}
    nodes: dict[int, tuple[int, str]] = {}
    for one in scene.of("AnimationCurveNode"):
        if layers & {layer for layer, _ in scene.above(one, "AnimationLayer")}:
            for model, name in scene.above(one, "Model"):
                if name in _KINDS and model in parents:
                    nodes[one] = model, name
    found: _Curves = {}
    second = 46_186_158_000  # ticks of FBX's clock
    for one in scene.of("AnimationCurve"):
        for node, name in scene.above(one, "AnimationCurveNode"):
            if node not in nodes or name not in ("d|X", "d|Y", "d|Z"):
                continue
            curve = scene.objects[one]
            times, values = scene.array(curve, "KeyTime") / second, scene.array(curve, "KeyValueFloat")
            whole = len(times) == len(values) > 0 and bool(np.isfinite(values).all() and (np.diff(times) >= 0.0).all())
            if not whole:
                raise InputError(scene.subject, expected="finite keys in the order of time", received="others")
            axes = found.setdefault(nodes[node], [None, None, None])
            axes["XYZ".index(name[-1])] = axes["XYZ".index(name[-1])] or (times, values)
    return found


def _names(scene: _Scene, joints: list[int]) -> tuple[str, ...]:
    """Return the models' names; one that has none, or that of another, gets its rank."""
    names: list[str] = []
    for k, key in enumerate(joints):
        own = scene.name(key) or f"model {k}"
        names.append(own if own not in names else f"{own} ({k})")
    return tuple(names)


def _world(
    scene: _Scene, models: list[int], parents: Mapping[int, int], curves: _Curves, times: Float64[np.ndarray, " T"]
) -> dict[int, Float64[np.ndarray, "T 4 4"]]:
    """Return the transforms of models, parents before children, to the world at times."""
    world: dict[int, Float64[np.ndarray, "T 4 4"]] = {}
    for key in models:

        def moved(name: str, key: int = key) -> Float64[np.ndarray, "T 3"]:
            """Return a property at times: by its curves, else as the model stands."""
            stands = scene.vector(key, name, _KINDS[name])
            axes = curves.get((key, name), [None, None, None])
            columns = [
                np.full(len(times), own) if k is None else np.interp(times, *k)
                for own, k in zip(stands, axes, strict=True)
            ]
            return np.stack(columns, axis=1)

        order = int(scene.number(key, "RotationOrder"))
        axes = _ORDERS[order] if 0 <= order < len(_ORDERS) else "xyz"
        turns = Rotation.from_euler(axes, moved("Lcl Rotation")[:, ["xyz".index(one) for one in axes]], degrees=True)
        before, after = (
            Rotation.from_euler("xyz", scene.vector(key, name), degrees=True)
            for name in ("PreRotation", "PostRotation")
        )
        turn = (before * turns * after.inv()).as_matrix()
        pivot, offset = scene.vector(key, "RotationPivot"), scene.vector(key, "RotationOffset")
        scaled = turn * moved("Lcl Scaling")[:, None, :]
        own = np.tile(np.eye(4), (len(times), 1, 1))
        own[:, :3, :3] = scaled
        # The pivot of the scale is that of the turn, or in the origin: both give this where bones are not scaled.
        own[:, :3, 3] = moved("Lcl Translation") + offset + pivot - turn @ pivot
        world[key] = world[parents[key]] @ own if parents[key] in world else own
    return world
