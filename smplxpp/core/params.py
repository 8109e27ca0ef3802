"""BodyParams: SMPL-X-family parameters of T frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from smplxpp.core.errors import InputError

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


@dataclass(frozen=True, eq=False)
class BodyParams:
    """Parameters of T frames; axis-angle in radians, translation in metres.

    Attributes:
        global_orient: (T, 3), about the root joint.
        body_pose: (T, 63).
        jaw_pose, leye_pose, reye_pose: (T, 3).
        left_hand_pose, right_hand_pose: (T, 45) axis-angle, or (T, P) PCA coefficients with P < 45.
        betas: (T, B) shape. expression: (T, E). transl: (T, 3), added last.
        fps: frames a second where the source says so.
    """

    global_orient: np.ndarray
    body_pose: np.ndarray
    jaw_pose: np.ndarray
    leye_pose: np.ndarray
    reye_pose: np.ndarray
    left_hand_pose: np.ndarray
    right_hand_pose: np.ndarray
    betas: np.ndarray
    expression: np.ndarray
    transl: np.ndarray
    fps: float | None = None

    def __post_init__(self) -> None:
        width = {name: 3 * joints for name, joints in POSE_BLOCKS} | {"transl": 3}
        frames = np.atleast_2d(np.asarray(self.global_orient)).shape[0]
        for field in fields(self):
            if field.name == "fps":
                continue
            value = np.array(np.atleast_2d(getattr(self, field.name)), dtype=np.float64)
            expected = width.get(field.name)
            hand = field.name.endswith("hand_pose")
            if value.ndim != 2 or (
                expected and value.shape[1] != expected and not (hand and value.shape[1] < expected)
            ):
                raise InputError(
                    f"parameter {field.name}",
                    expected=f"shape (T, {expected or 'any'})",
                    received=f"shape {value.shape}",
                )
            if value.shape[0] == 1 and frames > 1:
                value = np.repeat(value, frames, axis=0)
            if value.shape[0] != frames:
                raise InputError(
                    f"parameter {field.name}", expected=f"{frames} frames", received=f"{value.shape[0]} frames"
                )
            bad = ~np.isfinite(value).all(axis=1)
            if bad.any():
                raise InputError(
                    f"parameter {field.name}",
                    expected="finite values",
                    received=f"NaN or infinity in {int(bad.sum())} frames, first in frame {int(np.argmax(bad))}",
                )
            value.setflags(write=False)
            object.__setattr__(self, field.name, value)

    def __len__(self) -> int:
        return len(self.global_orient)

    @property
    def full_pose(self) -> np.ndarray:
        """(T, 55, 3) axis-angle in SMPL-X joint order; needs full hands."""
        return np.concatenate([getattr(self, name) for name, _ in POSE_BLOCKS], axis=1).reshape(len(self), -1, 3)

    def frame(self, index: int) -> BodyParams:
        """One frame as a BodyParams of length 1 (negative indices count from the end)."""
        if not -len(self) <= index < len(self):
            raise InputError("frame", expected=f"an index below {len(self)}", received=str(index))
        return self.select([index % len(self)])

    def select(self, indices) -> BodyParams:
        """The frames named by an index array or slice."""
        return replace(self, **{f.name: getattr(self, f.name)[indices] for f in fields(self) if f.name != "fps"})

    @staticmethod
    def rest(*, betas: np.ndarray | int = 10, expressions: int = 10) -> BodyParams:
        """The zero pose (T-pose) of one frame; `betas` as values (B,) or as their number."""
        values = np.zeros(betas) if isinstance(betas, int) else np.asarray(betas)
        zero = {name: np.zeros(3 * joints) for name, joints in POSE_BLOCKS}
        return BodyParams(**zero, betas=values, expression=np.zeros(expressions), transl=np.zeros(3))

    @staticmethod
    def from_full_pose(full_pose: np.ndarray, **others) -> BodyParams:
        """(T, 55, 3) axis-angle plus betas, expression, transl (and fps)."""
        flat = np.asarray(full_pose, dtype=np.float64).reshape(len(full_pose), -1)
        split = np.cumsum([3 * joints for _, joints in POSE_BLOCKS])[:-1]
        blocks = dict(zip([name for name, _ in POSE_BLOCKS], np.split(flat, split, axis=1), strict=True))
        return BodyParams(**blocks, **others)

    def as_dict(self) -> dict[str, np.ndarray]:
        """Arrays by name (fps left out when unknown)."""
        out = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "fps"}
        return out if self.fps is None else {**out, "fps": np.float64(self.fps)}

    @staticmethod
    def from_mapping(values: Mapping[str, np.ndarray], *, source: str = "parameters") -> BodyParams:
        """From arrays by SMPL-X name; face, hands and expression may be missing (zero)."""
        required = ("global_orient", "body_pose", "betas", "transl")
        missing = [name for name in required if name not in values]
        if missing:
            raise InputError(
                source, expected=f"the keys {', '.join(required)}", received=f"keys {sorted(values)}",
                remedy="see `smplxpp params convert --help` for the layouts that are read",
            )  # fmt: skip
        zeros = {name: np.zeros(3 * joints) for name, joints in POSE_BLOCKS} | {"expression": np.zeros(10)}
        known = {f.name for f in fields(BodyParams)} - {"fps"}
        arrays = zeros | {name: values[name] for name in values if name in known}
        fps = float(values["fps"]) if "fps" in values else None
        return BodyParams(**arrays, fps=fps)

    def save(self, path: str | Path) -> None:
        """Write our npz layout (SMPL-X names, stacked frames)."""
        np.savez_compressed(path, **self.as_dict())
