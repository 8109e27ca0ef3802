"""Read motions of other skeletons from Biovision files (.bvh), as mocap libraries and animation programs write them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from smplxpp.body.skeleton_motion import SkeletonMotion
from smplxpp.core.errors import InputError
from smplxpp.core.files.paths import ascii_numbers, read_text

# Limits that no motion reaches, so that damaged files are refused before they fill the memory.
_MOST_BYTES, _MOST_JOINTS, _MOST_FRAMES, _FARTHEST = 1 << 29, 1000, 1_000_000, 1e6
_EXPECTED = "a BVH file: HIERARCHY, then MOTION"
_CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")


def read_bvh(path: str | Path) -> SkeletonMotion:
    """Read a BVH file.

    Some programs write positions for every joint (Blender's unconnected bones; hips below a root that stands still).
    They replace the joint's offset in that frame. Where all of them are nearer to zero than to the offsets, they are
    taken for displacements from the offsets, as other programs mean them.

    Raises:
        InputError: missing, damaged or foreign; numbers that are not finite; no frame.
    """
    return _Reader(read_text(path, subject="motion", most=_MOST_BYTES), f"motion {path}").read()


class _Reader:
    """A recursive-descent reader of the words of one file."""

    def __init__(self, text: str, subject: str) -> None:
        # The word on a line of its own: joints may be named after it.
        head, found, self._motion = re.sub(r"(?m)^[ \t]*MOTION[ \t\r]*$", "\0", text, count=1).partition("\0")
        self._words, self._at, self._subject = head.split(), 0, subject
        self._names: list[str] = []
        self._parents: list[int] = []
        self._offsets: list[list[float]] = []
        self._channels: list[list[str]] = []
        self._tips: dict[int, Float64[np.ndarray, " 3"]] = {}
        if self._words[:2] != ["HIERARCHY", "ROOT"] or not found:
            raise InputError(subject, expected=_EXPECTED, received=text[:40].strip() or "nothing")

    def read(self) -> SkeletonMotion:
        """Parse the skeleton and convert the channels of all frames to rotations and root positions."""
        self._at = 1
        self._skeleton()
        widths = [len(channels) for channels in self._channels]
        values, fps = self._numbers(sum(widths))
        first = np.concatenate([[0], np.cumsum(widths)])
        # Every joint has its columns in the frames; Euler angles are applied in the order of the channels.
        rotations = np.tile(np.eye(3), (len(values), len(widths), 1, 1))
        root = np.repeat(np.array(self._offsets[:1], dtype=np.float64), len(values), axis=0)
        positions: dict[int, Float64[np.ndarray, "T 3"]] = {}
        for joint, channels in enumerate(self._channels):
            own = values[:, first[joint] : first[joint + 1]]
            rotating = [k for k, name in enumerate(channels) if name.endswith("rotation")]
            if rotating:
                axes = "".join(channels[k][0] for k in rotating)
                rotations[:, joint] = Rotation.from_euler(axes, own[:, rotating], degrees=True).as_matrix()
            moving = [k for k, name in enumerate(channels) if name.endswith("position")]
            if moving:
                place = root if joint == 0 else np.repeat(np.array([self._offsets[joint]]), len(values), axis=0)
                place[:, ["XYZ".index(channels[k][0]) for k in moving]] = own[:, moving]
                if joint:
                    positions[joint] = place
        parents, offsets = np.array(self._parents, dtype=np.int64), np.array(self._offsets, dtype=np.float64)
        _add_offsets(positions, offsets)
        return SkeletonMotion(tuple(self._names), parents, offsets, rotations, root, fps, positions, self._tips)

    def _skeleton(self) -> None:
        """Parse the hierarchy; `open_joints` is the stack of braces, None for end sites."""
        open_joints: list[int | None] = []
        current: int | None = None
        while self._at < len(self._words):
            word = self._next()
            if word in ("ROOT", "JOINT"):
                # Exactly the first joint is the root.
                if (word == "ROOT") != (not self._names) or len(self._names) >= _MOST_JOINTS:
                    raise self._wrong(f"one ROOT and at most {_MOST_JOINTS} joints", word)
                # The innermost open brace that belongs to a joint, not to an end site, is the parent.
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
                elif joints := [joint for joint in open_joints if joint is not None]:
                    self._tips[joints[-1]] = np.array(offset)
            elif word == "CHANNELS" and current is not None:
                count = self._next()
                # "ZPosition" of some writers.
                names = [self._next() for _ in range(int(count))] if count in "0123456" else [count]
                names = [name[:1].upper() + name[1:].lower() for name in names]
                rotating = [name for name in names if name.endswith("rotation")]
                if (
                    not set(names) <= set(_CHANNELS)
                    or len(set(names)) != len(names)
                    or len(rotating) not in (0, 1, 2, 3)
                ):
                    raise self._wrong("up to six different channels", " ".join(names)[:80])
                self._channels[current] = names
            else:
                raise self._wrong("ROOT, JOINT, End Site, OFFSET, CHANNELS or braces", word[:40])
        if open_joints:
            raise self._wrong("as many { as }", "fewer }")

    def _name(self) -> str:
        """Read a joint's name up to the brace, since some names have blanks."""
        words = []
        while self._at < len(self._words) and self._words[self._at] != "{":
            words.append(self._next())
        name = " ".join(words)
        if not name or name in self._names:
            raise self._wrong("joints of different names", repr(name[:40]))
        return name

    def _numbers(self, width: int) -> tuple[Float64[np.ndarray, "T C"], float]:
        """Parse the numbers of all frames, and return them with the frame rate."""
        frames_word, _, rest = self._motion.partition("Frame Time:")
        header = frames_word.replace(":", " ").split()
        if len(header) != 2 or header[0] != "Frames" or not (header[1].isascii() and header[1].isdecimal()) or not rest:
            raise self._wrong("Frames: and Frame Time:", " ".join(header)[:40] or "none")
        try:
            # The frame time stands before the motion's numbers, so that it is the first of them.
            values = np.array(ascii_numbers(rest).split(), dtype=np.float64)
        except ValueError:
            raise self._wrong("numbers after Frame Time:", "others") from None
        count = int(header[1]) if len(header[1]) < 9 else _MOST_FRAMES + 1
        if not 1 <= count <= _MOST_FRAMES or len(values) != 1 + count * width:
            raise self._wrong(f"1 to {_MOST_FRAMES} frames of {width} numbers", f"{header[1][:20]}: {len(values) - 1}")
        if not (np.isfinite(values).all() and np.abs(values).max() <= _FARTHEST and values[0] > 1e-6):
            raise self._wrong(f"numbers within {_FARTHEST:g} and a positive frame time", "others")
        return values[1:].reshape(count, width), float(1.0 / values[0])

    def _next(self) -> str:
        if self._at >= len(self._words):
            raise self._wrong("more of the skeleton", "its end")
        self._at += 1
        return self._words[self._at - 1]

    def _number(self, word: str) -> float:
        try:
            value = float(ascii_numbers(word))
        except ValueError:
            raise self._wrong("a number", word[:40]) from None
        if not abs(value) <= _FARTHEST:
            raise self._wrong(f"a number within {_FARTHEST:g}", word[:40])
        return value

    def _wrong(self, expected: str, received: str) -> InputError:
        return InputError(self._subject, expected=expected, received=received)


def _add_offsets(positions: dict[int, Float64[np.ndarray, "T 3"]], offsets: Float64[np.ndarray, "J 3"]) -> None:
    """Add the offsets, in place, where the positions of a file are displacements from them."""
    # Compare medians over frames and joints: the joint that carries the motion is far from both.
    distance = {joint: np.linalg.norm(place - offsets[joint], axis=1) for joint, place in positions.items()}
    length = {joint: np.linalg.norm(place, axis=1) for joint, place in positions.items()}
    if positions and np.median(list(length.values())) < np.median(list(distance.values())):
        for joint in positions:
            positions[joint] += offsets[joint]
