"""Call the kernels of `smplxpp/native/runtime` on numpy arrays: arguments prepared once, and a call a frame."""

from __future__ import annotations

import ctypes
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int32

from smplxpp.native import address, native_library

LANES = 16
"""Rows that a kernel processes at a time; prepared arrays are padded to a multiple."""
CHANNELS = 6
"""Values of a Gaussian that a blend shape changes: position and colour."""


class _Struct(ctypes.Structure):
    """A structure of the kernels that keeps the arrays alive that it points to."""

    def point(self, **arrays: tuple[np.ndarray | None, str]) -> None:
        # The structure holds bare addresses: numpy would free the arrays without these references.
        self.kept = {
            name: None if array is None else np.ascontiguousarray(array) for name, (array, _) in arrays.items()
        }
        for name, (_, dtype) in arrays.items():
            setattr(self, name, address(self.kept[name], dtype))


def _fields(sizes: str, pointers: str) -> list[tuple[str, Any]]:
    return [(name, ctypes.c_int64) for name in sizes.split()] + [(name, ctypes.c_void_p) for name in pointers.split()]


class _Network(_Struct):
    _fields_ = _fields("points width layers inputs", "of_point of_frame frame_bias hidden hidden_bias last last_bias")


class _Surface(_Struct):
    _fields_ = _fields("vertices joints influences controls neighbours", "joint weight neighbour share")


class _Shapes(_Struct):
    _fields_ = _fields("rows shapes count parts", "steps values scale row part")


class _Bound(_Struct):
    _fields_ = [
        *_fields("faces count vertices", "face first barycentric offset scales quats dc"),
        ("thickness", ctypes.c_float),
        ("reserved", ctypes.c_int32),
    ]


def joint_transforms(
    parents: Int32[np.ndarray, " J"],
    turns: Float64[np.ndarray, "J 3"],
    rest: Float64[np.ndarray, "J 3"],
    transl: Float64[np.ndarray, " 3"],
    *,
    features: bool = False,
) -> tuple[Float32[np.ndarray, "J 3 4"], Float32[np.ndarray, " P"] | None]:
    """Return the transforms of a skeleton from the T-pose, and the features of pose correctives if requested.

    Args:
        parents: -1 first, each before its children.
        turns: axis-angle vectors relative to the parent, radians.
        rest: joints in the T-pose, metres.
        transl: metres.
        features: whether to return the features of pose correctives.
    """
    # A pose corrective is driven by the 9 entries of R_j - I for
    # every joint but the root (SMPL), hence 9 (J - 1) features.
    count = len(parents)
    out = np.empty((count, 3, 4), np.float32)
    driving = np.empty(9 * (count - 1), np.float32) if features else None
    native_library().smplxpp_runtime_pose(
        ctypes.c_int64(count),
        address(parents, "int32"),
        *(address(array, "float64") for array in (turns, rest, transl)),
        address(out),
        address(driving),
    )
    return out, driving


def add_basis(
    out: Float32[np.ndarray, "V 3"],
    rows: Int32[np.ndarray, " R"],
    basis: Float32[np.ndarray, "R 3 E"],
    coefficients: Float32[np.ndarray, " E"],
) -> None:
    """Add `basis coefficients` to some rows of `out`, in place."""
    native_library().smplxpp_runtime_basis(
        *(ctypes.c_int64(n) for n in (len(rows), basis.shape[2], len(out))),
        address(rows, "int32"),
        *(address(array) for array in (basis, coefficients, out)),
    )


class FieldKernel:
    """One network of the displacement field, evaluated at its control points.

    Args:
        tensors: of the network, as the bundle names them.
        encodings: of its points.
        member: index of the set of joints that each point depends on.
        at: rows of the output to add to; None: the output is overwritten, row by row.
    """

    def __init__(
        self,
        tensors: dict[str, np.ndarray],
        encodings: Float32[np.ndarray, "C X"],
        member: Int32[np.ndarray, " C"],
        at: Int32[np.ndarray, " C"] | None = None,
    ) -> None:
        # The first layer is linear in the encoded point and in the inputs of the frame, so that the point's part, W_p
        # phi(v), is computed once here, and only the frame's part remains for every pose.
        width = len(tensors["of_frame.bias"])
        self._member, self._at = np.ascontiguousarray(member), None if at is None else np.ascontiguousarray(at)
        self._native = _Network(
            len(encodings), width, len(tensors["hidden.weight"]), tensors["of_frame.weight"].shape[1]
        )
        names = {"of_frame": "of_frame.weight", "frame_bias": "of_frame.bias", "hidden": "hidden.weight"}
        names |= {"hidden_bias": "hidden.bias", "last": "last.weight", "last_bias": "last.bias"}
        self._native.point(
            of_point=(in_lanes(encodings @ tensors["of_point.weight"].T), "float32"),
            **{name: (tensors[own], "float32") for name, own in names.items()},
        )

    def __call__(self, frames: Float32[np.ndarray, "S Y"], out: Float32[np.ndarray, "C 3"], threads: int) -> None:
        """Write, or add, the displacements of the points; `frames` is pose and code of each set of joints."""
        if self._native.points:
            native_library().smplxpp_runtime_field(
                ctypes.byref(self._native),
                ctypes.c_int64(len(frames)),
                address(frames),
                address(self._member, "int32"),
                address(self._at, "int32"),
                ctypes.c_int64(len(out)),
                address(out),
                ctypes.c_int32(threads),
            )


class SurfaceKernel:
    """Skinning of the surface, with displacements of field and cloth."""

    def __init__(
        self,
        joints: int,
        joint_indices: Int32[np.ndarray, "V k"],
        joint_weights: Float32[np.ndarray, "V k"],
        neighbours: Int32[np.ndarray, "V n"] | None,
        weights: Float32[np.ndarray, "V n"] | None,
        controls: int,
    ) -> None:
        # Without a field there are no control points, and the kernel skips the interpolation.
        count, influences = joint_indices.shape
        self._native = _Surface(count, joints, influences, controls, 0 if neighbours is None else neighbours.shape[1])
        self._native.point(
            joint=(joint_indices, "int32"),
            weight=(joint_weights, "float32"),
            neighbour=(neighbours, "int32"),
            share=(weights, "float32"),
        )

    def __call__(
        self,
        rest: Float32[np.ndarray, "V 3"],
        moved: Float32[np.ndarray, "C 3"] | None,
        cloth: tuple[Float32[np.ndarray, "V 3"], Float32[np.ndarray, " V"]] | None,
        transforms: Float32[np.ndarray, "J 3 4"],
        posed: Float32[np.ndarray, "V 3"],
        threads: int,
    ) -> None:
        """Write the posed vertices, metres; `cloth` is displacements and their weights."""
        native_library().smplxpp_runtime_surface(
            ctypes.byref(self._native),
            *(address(array) for array in (rest, moved, *(cloth or (None, None)), transforms, posed)),
            ctypes.c_int32(threads),
        )


class BlendKernel:
    """The blend shapes of head or body.

    Args:
        values: int8 multiples of `steps`, or floats.
        steps: quantisation steps; None for floats.
        exponent: powers of 2 that scale each row; None: 0.
        rows: indices of the Gaussians; None: all.
        part: part of each of them; None: a single part.
        count: number of all Gaussians.
    """

    def __init__(
        self,
        values: np.ndarray,
        steps: Float32[np.ndarray, "n 6"] | None,
        exponent: Int32[np.ndarray, " M"] | None,
        rows: Int32[np.ndarray, " M"] | None,
        part: Int32[np.ndarray, " M"] | None,
        *,
        count: int,
    ) -> None:
        # The layout of the kernel: blocks of 16 rows, shapes and channels inside.
        shapes, _, held = values.shape
        self._steps = np.ones((shapes, CHANNELS), np.float32) if steps is None else steps
        padded = np.zeros((-(-held // LANES) * LANES, shapes, CHANNELS), values.dtype)
        padded[:held] = values.transpose(2, 0, 1)
        blocks = padded.reshape(-1, LANES, shapes, CHANNELS).transpose(0, 2, 3, 1)
        # Row i stores integers q_i with the value q_i step 2^exponent_i; floats have step 1 and exponent 0.
        scale = np.ones(len(padded), np.float32)
        if exponent is not None:
            scale[:held] = np.exp2(exponent)
        parts = 1 if part is None else int(part.max(initial=0)) + 1
        self._native = _Shapes(held, shapes, count, parts)
        whole = values.dtype == np.int8
        self._native.point(
            steps=(blocks if whole else None, "int8"),
            values=(None if whole else blocks, "float32"),
            scale=(scale, "float32"),
            row=(rows, "int32"),
            part=(part, "int32"),
        )

    def __call__(
        self,
        coefficients: Float32[np.ndarray, "parts n"],
        keep: Float32[np.ndarray, " N"] | None,
        added: Float32[np.ndarray, "N 6"],
        threads: int,
    ) -> None:
        """Add the shapes times their coefficients; `keep` is a factor of each Gaussian, None: 1."""
        # The steps are multiplied into the coefficients once a pose, instead of into every stored number.
        if self._native.rows:
            scaled = np.ascontiguousarray(coefficients[:, :, None] * self._steps, dtype=np.float32)
            native_library().smplxpp_runtime_blend(
                ctypes.byref(self._native),
                *(address(array) for array in (scaled, keep, added)),
                ctypes.c_int32(threads),
            )


class WorldKernel:
    """The transform of Gaussians from their triangles to the world."""

    def __init__(
        self,
        faces: Int32[np.ndarray, "F 3"],
        first: Int32[np.ndarray, " G"],
        tensors: dict[str, np.ndarray],
        *,
        vertices: int,
        thickness: float,
    ) -> None:
        self._native = _Bound(len(faces), int(first[-1]), vertices)
        self._native.thickness = thickness
        self._native.point(
            face=(faces, "int32"),
            first=(first, "int32"),
            **{name: (tensors[name], "float32") for name in ("barycentric", "offset", "scales", "quats", "dc")},
        )

    def __call__(
        self,
        posed: Float32[np.ndarray, "V 3"],
        added: Float32[np.ndarray, "N 6"] | None,
        out: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray],
        threads: int,
    ) -> None:
        """Write means, quaternions, scales and colours of the Gaussians, and rotations of the triangles."""
        native_library().smplxpp_runtime_world(
            ctypes.byref(self._native), *(address(array) for array in (posed, added, *out)), ctypes.c_int32(threads)
        )


def in_lanes(rows: Float32[np.ndarray, "C W"]) -> Float32[np.ndarray, "b W 16"]:
    """Return rows in blocks of sixteen side by side, the last block padded with zeros."""
    # Transposed within a block, the same channel of sixteen rows is contiguous and fills a vector register.
    blocks = -(-len(rows) // LANES)
    padded = np.zeros((blocks * LANES, rows.shape[1]), np.float32)
    padded[: len(rows)] = rows
    return np.ascontiguousarray(padded.reshape(blocks, LANES, rows.shape[1]).transpose(0, 2, 1))
