"""Define BodyParams, the parameters of the SMPL-X family for T frames."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from smplxpp.core.errors import GeometryWarning, InputError
from smplxpp.core.files.atomic import atomic_path
from smplxpp.core.files.json_file import as_number

# Pose blocks in SMPL-X joint order, with their number of joints.
POSE_BLOCKS: tuple[tuple[str, int], ...] = (
    ("global_orient", 1),
    ("body_pose", 21),
    ("jaw_pose", 1),
    ("leye_pose", 1),
    ("reye_pose", 1),
    ("left_hand_pose", 15),
    ("right_hand_pose", 15),
)
# Every array of BodyParams, in the order of its fields.
ARRAY_NAMES: tuple[str, ...] = (*(name for name, _ in POSE_BLOCKS), "betas", "expression", "transl")
DEFAULT_FPS = 30.0
"""Frames per second of a motion or capture that states no rate: the common rate of cameras and animation programs, and
the one that all exports had before there was one default. Files that state a rate keep theirs."""
# Upper bound of the absolute value of radians, metres and coefficients. No valid file is near it, and squares of much
# larger numbers overflow in float32.
LARGEST_PARAMETER = 1e6


@dataclass(frozen=True, eq=False)
class BodyParams:
    """Parameters of T frames; axis-angle in radians, translation in metres.

    Attributes:
        global_orient: (T, 3), about the root joint.
        body_pose: (T, 63).
        jaw_pose: (T, 3).
        leye_pose: (T, 3).
        reye_pose: (T, 3).
        left_hand_pose: (T, 45) axis-angle, or (T, P) PCA coefficients with P < 45.
        right_hand_pose: as `left_hand_pose`.
        betas: (T, B) shape coefficients.
        expression: (T, E) expression coefficients.
        transl: (T, 3), added after posing.
        fps: frames per second where the source states them.
        flat_hand_mean: whether hand poses are complete, so that the body model adds no mean hand (AMASS, AvatarReX).
            False: the model's mean hand is added after the PCA, as SMPL-X does by default.
        v_shape: (1, V, 3) for all frames or (T, V, 3): metres added to the shaped template before joints are regressed
            and the body is posed, for shape that betas do not express (TalkBody4D). None: nothing is added.

    Raises:
        InputError: wrong widths, unequal numbers of frames (one frame stands for all), NaN or infinity.

    Example:
        >>> smplxpp.load_params("data/fixtures/person/params/params.npz").frame(3)
        BodyParams(1 frames at 10 a second, 20 betas, 52 expressions)
    """

    global_orient: Float64[np.ndarray, "T 3"]
    body_pose: Float64[np.ndarray, "T 63"]
    jaw_pose: Float64[np.ndarray, "T 3"]
    leye_pose: Float64[np.ndarray, "T 3"]
    reye_pose: Float64[np.ndarray, "T 3"]
    left_hand_pose: Float64[np.ndarray, "T L"]
    right_hand_pose: Float64[np.ndarray, "T R"]
    betas: Float64[np.ndarray, "T B"]
    expression: Float64[np.ndarray, "T E"]
    transl: Float64[np.ndarray, "T 3"]
    fps: float | None = None
    flat_hand_mean: bool = False
    v_shape: Float64[np.ndarray, "S V 3"] | None = None

    def __post_init__(self) -> None:
        width = {name: 3 * joints for name, joints in POSE_BLOCKS} | {"transl": 3}
        frames = np.atleast_2d(np.asarray(self.global_orient)).shape[0]
        # Every array: convert, check its width, repeat a single row for all frames, check its range, make it read-only.
        for name in ARRAY_NAMES:
            value = _numbers(name, getattr(self, name))
            expected = width.get(name)
            hand = name.endswith("hand_pose")
            if value.ndim != 2 or (
                expected and value.shape[1] != expected and not (hand and value.shape[1] < expected)
            ):
                raise InputError(
                    f"parameter {name}",
                    expected=f"shape (T, {expected or 'any'})",
                    received=f"shape {value.shape}",
                )
            if value.shape[0] == 1 and frames > 1:
                value = np.repeat(value, frames, axis=0)
            if value.shape[0] != frames:
                raise InputError(f"parameter {name}", expected=f"{frames} frames", received=f"{value.shape[0]} frames")
            bad = ~(np.abs(value) <= LARGEST_PARAMETER).all(axis=1)
            if bad.any():
                raise InputError(
                    f"parameter {name}",
                    expected=f"finite values up to {LARGEST_PARAMETER:g}",
                    received=f"others or NaN in {int(bad.sum())} frames, first in frame {int(np.argmax(bad))}",
                )
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if self.v_shape is not None:
            object.__setattr__(self, "v_shape", _vertex_offsets(self.v_shape, frames))

    def __len__(self) -> int:
        return len(self.global_orient)

    def __repr__(self) -> str:
        rate = "" if self.fps is None else f" at {self.fps:g} a second"
        shape, expression = self.betas.shape[1], self.expression.shape[1]
        return f"BodyParams({len(self)} frames{rate}, {shape} betas, {expression} expressions)"

    @property
    def full_pose(self) -> Float64[np.ndarray, "T 55 3"]:
        """Axis-angle vectors of all joints in SMPL-X order.

        Raises:
            InputError: hands given as PCA coefficients, which only a body model can expand.
        """
        for name in ("left_hand_pose", "right_hand_pose"):
            if getattr(self, name).shape[1] != 45:
                raise InputError(
                    f"parameter {name}",
                    expected="45 axis-angle numbers",
                    received=f"{getattr(self, name).shape[1]} PCA coefficients",
                )
        return np.concatenate([getattr(self, name) for name, _ in POSE_BLOCKS], axis=1).reshape(len(self), -1, 3)

    def frame(self, index: int) -> BodyParams:
        """Return one frame as a BodyParams of length 1 (negative indices count from the end)."""
        if not -len(self) <= index < len(self):
            raise InputError("frame", expected=f"an index below {len(self)}", received=str(index))
        return self.select([index % len(self)])

    def select(self, indices: slice | Sequence[int] | np.ndarray) -> BodyParams:
        """Return the frames that indices, a mask or a slice select.

        Every n-th frame of a slice with a step shows 1/n of the frames a second; with others the rate stays.
        """
        offsets = self.v_shape if self.v_shape is None or len(self.v_shape) == 1 else self.v_shape[indices]
        found = self._with_arrays({name: getattr(self, name)[indices] for name in ARRAY_NAMES}, offsets)
        step = abs(indices.step or 1) if isinstance(indices, slice) else 1
        return found if found.fps is None or step == 1 else replace(found, fps=found.fps / step)

    def with_rate(self, fps: float | None = None, *, source: str = "motion") -> BodyParams:
        """Return the frames at a stated rate, else at their own; a motion without any gets `DEFAULT_FPS`.

        Args:
            fps: frames a second; None: as the source states.
            source: in the warning.

        Warns:
            GeometryWarning: several frames that state no rate.
        """
        if fps is None and self.fps is None and len(self) > 1:
            warnings.warn(
                f"{source} states no frame rate: {DEFAULT_FPS:g} frames a second are taken; --fps states others",
                GeometryWarning,
                stacklevel=3,
            )
            fps = DEFAULT_FPS
        return self if fps is None else replace(self, fps=fps)

    def without_shape(self) -> BodyParams:
        """Return the poses without betas and `v_shape`, for a body that already has the person's shape."""
        return replace(self, betas=np.zeros((len(self), 0)), v_shape=None)

    def offsets_by_row(self, frames: Sequence[int] | np.ndarray) -> dict[str, np.ndarray]:
        """Return `v_shape` (if any) for a file whose row index is the frame number, NaN in rows without a frame.

        A single row that stands for all frames stays a single row.
        """
        if self.v_shape is None or len(self.v_shape) == 1:
            return {} if self.v_shape is None else {"v_shape": self.v_shape}
        rows = np.full((int(max(frames)) + 1, *self.v_shape.shape[1:]), np.nan)
        rows[np.asarray(frames)] = self.v_shape
        return {"v_shape": rows}

    @staticmethod
    def concatenate(parts: Sequence[BodyParams]) -> BodyParams:
        """Concatenate frames of several BodyParams; widths, `fps`, `flat_hand_mean` and having `v_shape` must agree.

        Raises:
            InputError: no parts, or parts that disagree.
        """
        if not parts:
            raise InputError("parameters to join", expected="at least one part", received="none")
        for index, part in enumerate(parts):
            for name in (*ARRAY_NAMES, "fps", "flat_hand_mean"):
                first, other = getattr(parts[0], name), getattr(part, name)
                if name in ARRAY_NAMES:
                    first, other = f"width {first.shape[1]}", f"width {other.shape[1]}"
                if first != other:
                    raise InputError(
                        f"parameter {name} of part {index}", expected=f"{first}, as in part 0", received=str(other)
                    )
        joined = {name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAY_NAMES}
        return parts[0]._with_arrays(joined, _joined_offsets(parts))

    @staticmethod
    def rest(
        *,
        betas: Float[np.ndarray, " B"] | int = 10,
        expressions: int = 10,
        v_shape: Float[np.ndarray, "S V 3"] | None = None,
    ) -> BodyParams:
        """Return one frame in the zero pose (T-pose); `betas` as values (B,) or as their number."""
        values = np.zeros(betas) if isinstance(betas, int) else np.asarray(betas)
        arrays = _zero_pose() | {"betas": values, "expression": np.zeros(expressions), "transl": np.zeros(3)}
        return _from_arrays(arrays if v_shape is None else arrays | {"v_shape": v_shape})

    @staticmethod
    def from_full_pose(
        full_pose: Float[np.ndarray, "T 55 3"],
        *,
        betas: np.ndarray,
        expression: np.ndarray,
        transl: np.ndarray,
        fps: float | None = None,
        flat_hand_mean: bool = False,
    ) -> BodyParams:
        """Make parameters from axis-angle poses in SMPL-X joint order; one row of the others stands for all frames."""
        flat = np.asarray(full_pose, dtype=np.float64).reshape(len(full_pose), -1)
        split = np.cumsum([3 * joints for _, joints in POSE_BLOCKS])[:-1]
        blocks = dict(zip([name for name, _ in POSE_BLOCKS], np.split(flat, split, axis=1), strict=True))
        others = {"betas": betas, "expression": expression, "transl": transl}
        return _from_arrays(blocks | others, fps=fps, flat_hand_mean=flat_hand_mean)

    def as_dict(self) -> dict[str, np.ndarray]:
        """Return the arrays by name, with `fps` and `v_shape` if present and `flat_hand_mean` if true."""
        out: dict[str, np.ndarray] = {name: getattr(self, name) for name in ARRAY_NAMES}
        if self.fps is not None:
            out["fps"] = np.asarray(np.float64(self.fps))
        if self.flat_hand_mean:
            out["flat_hand_mean"] = np.asarray(np.bool_(True))
        if self.v_shape is not None:
            out["v_shape"] = self.v_shape
        return out

    @staticmethod
    def from_mapping(values: Mapping[str, np.ndarray], *, source: str = "parameters") -> BodyParams:
        """Read arrays by SMPL-X name; face, hands and expression may be missing (zero), `v_shape` too (none)."""
        required = ("global_orient", "body_pose", "betas", "transl")
        missing = [name for name in required if name not in values]
        if missing:
            raise InputError(
                source,
                expected=f"the keys {', '.join(required)}",
                received=f"keys {sorted(values)}",
                remedy="see `smplxpp params convert --help` for the layouts that are read",
            )
        zeros = _zero_pose() | {"expression": np.zeros(10)}
        arrays = zeros | {name: values[name] for name in (*ARRAY_NAMES, "v_shape") if name in values}
        fps = _single(values["fps"], source, "fps", least=0.0) if "fps" in values else None
        if fps == 0.0:
            raise InputError(f"{source}: fps", expected="a number above 0", received="0")
        flat = _single(values.get("flat_hand_mean", False), source, "flat_hand_mean", least=0.0, most=1.0)
        return _from_arrays(arrays, fps=fps, flat_hand_mean=bool(flat))

    def save(self, path: str | Path) -> None:
        """Write our npz layout (SMPL-X names, stacked frames), whole or not at all."""
        with atomic_path(path) as temporary, open(temporary, "wb") as stream:
            # numpy's signature lists options of its own among the arrays' names.
            np.savez_compressed(stream, **self.as_dict())  # type: ignore[arg-type]

    def _with_arrays(self, arrays: Mapping[str, np.ndarray], offsets: np.ndarray | None) -> BodyParams:
        whole = arrays if offsets is None else {**arrays, "v_shape": offsets}
        return _from_arrays(whole, fps=self.fps, flat_hand_mean=self.flat_hand_mean)


def _from_arrays(
    arrays: Mapping[str, np.ndarray], *, fps: float | None = None, flat_hand_mean: bool = False
) -> BodyParams:
    return BodyParams(
        global_orient=arrays["global_orient"],
        body_pose=arrays["body_pose"],
        jaw_pose=arrays["jaw_pose"],
        leye_pose=arrays["leye_pose"],
        reye_pose=arrays["reye_pose"],
        left_hand_pose=arrays["left_hand_pose"],
        right_hand_pose=arrays["right_hand_pose"],
        betas=arrays["betas"],
        expression=arrays["expression"],
        transl=arrays["transl"],
        fps=fps,
        flat_hand_mean=flat_hand_mean,
        v_shape=arrays.get("v_shape"),
    )


def _zero_pose() -> dict[str, np.ndarray]:
    return {name: np.zeros(3 * joints) for name, joints in POSE_BLOCKS}


def _single(value: object, source: str, name: str, *, least: float, most: float = math.inf) -> float:
    """Return the only number of an array, of any type and shape."""
    array = np.asarray(value)
    number = array.reshape(-1)[0].item() if array.size == 1 and array.dtype.kind in "biuf" else value
    subject = f"{source}: {name}"
    return as_number(int(number) if isinstance(number, bool) else number, subject=subject, least=least, most=most)


def _numbers(name: str, value: object) -> np.ndarray:
    """Return a (T, width) float64 copy of an array or a row."""
    try:
        return np.array(np.atleast_2d(np.asarray(value)), dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"parameter {name}", expected="numbers of shape (T, width)", received=str(error)) from error


def _vertex_offsets(value: object, frames: int) -> np.ndarray:
    """Return a read-only float64 copy of shape (1, V, 3) or (frames, V, 3)."""
    subject = "parameter v_shape"
    try:
        offsets = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(subject, expected="numbers of shape (V, 3) or (T, V, 3)", received=str(error)) from error
    offsets = offsets[None] if offsets.ndim == 2 else offsets
    if offsets.ndim != 3 or offsets.shape[2] != 3 or len(offsets) not in (1, frames):
        raise InputError(
            subject, expected=f"shape (V, 3), (1, V, 3) or ({frames}, V, 3)", received=f"shape {offsets.shape}"
        )
    if not (np.abs(offsets) <= LARGEST_PARAMETER).all():
        raise InputError(subject, expected=f"finite values up to {LARGEST_PARAMETER:g}", received="others or NaN")
    offsets.setflags(write=False)
    return offsets


def _joined_offsets(parts: Sequence[BodyParams]) -> np.ndarray | None:
    """Concatenate `v_shape` of parts: a single row if it is the same in all, else a row for each frame."""
    given = [part.v_shape for part in parts if part.v_shape is not None]
    shapes = {None if part.v_shape is None else part.v_shape.shape[1] for part in parts}
    if len(shapes) > 1:
        raise InputError(
            "parameter v_shape of parts to join",
            expected="offsets of the same vertices in all parts, or in none",
            received=" and ".join("none" if count is None else f"{count} vertices" for count in shapes),
        )
    if not given or (all(len(one) == 1 for one in given) and all(np.array_equal(one, given[0]) for one in given)):
        return given[0] if given else None
    return np.concatenate(
        [np.broadcast_to(one, (len(part), *one.shape[1:])) for part, one in zip(parts, given, strict=True)]
    )
