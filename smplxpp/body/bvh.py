"""Motions of other skeletons: Biovision's text files (.bvh), as mocap libraries and animation programs write them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import read_text

_MOST_BYTES, _MOST_JOINTS, _MOST_FRAMES = 1 << 29, 1000, 1_000_000
_FARTHEST = 1e6
_EXPECTED = "a BVH file: HIERARCHY, then MOTION"
_CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")


@dataclass(frozen=True, eq=False)
class BvhMotion:
    """A skeleton and its motion, in the file's own units and axes.

    Attributes:
        names, parents: of the J joints, every parent before its children, -1 for the root; end sites are left out.
        offsets: of each joint from its parent, at rest; the root's from the origin.
        rotations: relative to the parent. root: where the root is.
        fps: frames a second.
    """

    names: tuple[str, ...]
    parents: Int64[np.ndarray, " J"]
    offsets: Float64[np.ndarray, "J 3"]
    rotations: Float64[np.ndarray, "T J 3 3"]
    root: Float64[np.ndarray, "T 3"]
    fps: float

    @property
    def rest(self) -> Float64[np.ndarray, "J 3"]:
        """Where the joints are at rest, the root at its offset."""
        places = np.zeros_like(self.offsets)
        for joint, parent in enumerate(self.parents):
            places[joint] = self.offsets[joint] + (places[parent] if parent >= 0 else 0.0)
        return places


def read_bvh(path: str | Path) -> BvhMotion:
    """Read a BVH file. Positions of joints below the root, which some programs write, are not read.

    Raises:
        InputError: missing, damaged or foreign; numbers that are not finite; no frame.
    """
    return _Reader(read_text(path, subject="motion", most=_MOST_BYTES), f"motion {path}").read()


class _Reader:
    """Reads the words of one file, one after the other."""

    def __init__(self, text: str, subject: str) -> None:
        head, found, self._motion = text.partition("MOTION")
        self._words, self._at, self._subject = head.split(), 0, subject
        self._names: list[str] = []
        self._parents: list[int] = []
        self._offsets: list[list[float]] = []
        self._channels: list[list[str]] = []
        if self._words[:2] != ["HIERARCHY", "ROOT"] or not found:
            raise InputError(subject, expected=_EXPECTED, received=text[:40].strip() or "nothing")

    def read(self) -> BvhMotion:
        """Read all of it."""
        self._at = 1
        self._skeleton()
        widths = [len(channels) for channels in self._channels]
        values, fps = self._numbers(sum(widths))
        first = np.concatenate([[0], np.cumsum(widths)])
        rotations = np.tile(np.eye(3), (len(values), len(widths), 1, 1))
        root = np.repeat(np.array(self._offsets[:1], dtype=np.float64), len(values), axis=0)
        for joint, channels in enumerate(self._channels):
            own = values[:, first[joint] : first[joint + 1]]
            turns = [k for k, name in enumerate(channels) if name.endswith("rotation")]
            if turns:
                axes = "".join(channels[k][0] for k in turns)
                rotations[:, joint] = Rotation.from_euler(axes, own[:, turns], degrees=True).as_matrix()
            for k, name in enumerate(channels):
                if joint == 0 and name.endswith("position"):
                    root[:, "XYZ".index(name[0])] = own[:, k]
        parents, offsets = np.array(self._parents, dtype=np.int64), np.array(self._offsets, dtype=np.float64)
        return BvhMotion(tuple(self._names), parents, offsets, rotations, root, fps)

    def _skeleton(self) -> None:
        open_joints: list[int | None] = []
        current: int | None = None
        while self._at < len(self._words):
            word = self._next()
            if word in ("ROOT", "JOINT"):
                if (word == "ROOT") != (not self._names) or len(self._names) >= _MOST_JOINTS:
                    raise self._wrong(f"one ROOT and at most {_MOST_JOINTS} joints", word)
                parent = next((joint for joint in reversed(open_joints) if joint is not None), -1)
                current = len(self._names)
                self._names.append(self._name())
                self._parents.append(parent)
                self._offsets.append([0.0, 0.0, 0.0])
                self._channels.append([])
            elif word == "End":
                self._next()
                current = None
            elif word == "{":
                open_joints.append(current)
            elif word == "}":
                if not open_joints:
                    raise self._wrong("as many { as }", "one } more")
                open_joints.pop()
            elif word == "OFFSET":
                offset = [self._number(self._next()) for _ in range(3)]
                if current is not None:
                    self._offsets[current] = offset
            elif word == "CHANNELS" and current is not None:
                count = self._next()
                names = [self._next() for _ in range(int(count))] if count in "0123456" else [count]
                turns = [name for name in names if name.endswith("rotation")]
                if not set(names) <= set(_CHANNELS) or len(set(names)) != len(names) or len(turns) not in (0, 1, 2, 3):
                    raise self._wrong("up to six different channels", " ".join(names)[:80])
                self._channels[current] = names
            else:
                raise self._wrong("ROOT, JOINT, End Site, OFFSET, CHANNELS or braces", word[:40])
        if open_joints:
            raise self._wrong("as many { as }", "fewer }")

    def _name(self) -> str:
        """A joint's name, up to the brace: some have blanks."""
        words = []
        while self._at < len(self._words) and self._words[self._at] != "{":
            words.append(self._next())
        name = " ".join(words)
        if not name or name in self._names:
            raise self._wrong("joints of different names", repr(name[:40]))
        return name

    def _numbers(self, width: int) -> tuple[Float64[np.ndarray, "T C"], float]:
        """The frames' numbers, and how many frames a second has."""
        frames_word, _, rest = self._motion.partition("Frame Time:")
        told = frames_word.replace(":", " ").split()
        if len(told) != 2 or told[0] != "Frames" or not told[1].isdigit() or not rest:
            raise self._wrong("Frames: and Frame Time:", " ".join(told)[:40] or "none")
        try:
            values = np.array(rest.split(), dtype=np.float64)
        except ValueError:
            raise self._wrong("numbers after Frame Time:", "others") from None
        count = int(told[1]) if len(told[1]) < 9 else _MOST_FRAMES + 1
        if not 1 <= count <= _MOST_FRAMES or len(values) != 1 + count * width:
            raise self._wrong(f"1 to {_MOST_FRAMES} frames of {width} numbers", f"{told[1][:20]}: {len(values) - 1}")
        if not (np.isfinite(values).all() and np.abs(values).max() <= _FARTHEST and values[0] > 1e-6):
            raise self._wrong(f"numbers within {_FARTHEST:g} and time that goes on", "others")
        return values[1:].reshape(count, width), float(1.0 / values[0])

    def _next(self) -> str:
        if self._at >= len(self._words):
            raise self._wrong("more of the skeleton", "its end")
        self._at += 1
        return self._words[self._at - 1]

    def _number(self, word: str) -> float:
        try:
            value = float(word)
        except ValueError:
            raise self._wrong("a number", word[:40]) from None
        if not abs(value) <= _FARTHEST:
            raise self._wrong(f"a number within {_FARTHEST:g}", word[:40])
        return value

    def _wrong(self, expected: str, received: str) -> InputError:
        return InputError(self._subject, expected=expected, received=received)
