"""The native solver: one garment's particles moved on through a span of time."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil

import numpy as np
from jaxtyping import Float, Float32, Int32

from smplxpp.cloth.model import ClothModel, Fabric, SolverConfig
from smplxpp.core.errors import InputError
from smplxpp.native import address, native_library


@dataclass(frozen=True, eq=False)
class Collider:
    """What cloth may touch: c vertices whose places move, and d faces, oriented outwards.

    Attributes:
        margin: metres that cloth keeps from each vertex's neighbourhood.
        deepest: metres; cloth that lies deeper is taken to be on the other side and left alone.
    """

    faces: Int32[np.ndarray, "d 3"]
    margin: Float32[np.ndarray, " c"]
    deepest: Float32[np.ndarray, " c"]


@dataclass(eq=False)
class ClothState:
    """Particles: metres and metres a second."""

    position: Float32[np.ndarray, "n 3"]
    velocity: Float32[np.ndarray, "n 3"]

    @staticmethod
    def at_rest(position: Float[np.ndarray, "n 3"]) -> ClothState:
        """Return particles that do not move."""
        return ClothState(np.array(position, dtype=np.float32), np.zeros(position.shape, dtype=np.float32))


class _Model(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int64) for name in ("particles", "faces", "edges", "hinges", "skin", "skin_faces")),
        *(
            (name, ctypes.c_void_p)
            for name in (
                *("inverse_mass", "face", "edge", "length", "stretch", "compress", "hinge", "curvature"),
                *("rest_curvature", "bend", "spring", "anchor", "tether", "apart"),
                *("collider_face", "margin", "deepest"),
            )
        ),
    ]


class _Forces(ctypes.Structure):
    _fields_ = [
        *(
            (name, ctypes.c_double)
            for name in ("gravity", "drag", "normal_drag", "inner_friction", "friction", "own_margin", "most_speed")
        ),
        ("most_stretch", ctypes.c_double),
        ("report", ctypes.c_void_p),
    ]


class _Moments(ctypes.Structure):
    _fields_ = [("place", ctypes.c_void_p * 4), ("collider", ctypes.c_void_p * 4)]


class ClothSolver:
    """Steps one garment; the state is the caller's."""

    def __init__(self, model: ClothModel, collider: Collider, fabric: Fabric, config: SolverConfig) -> None:
        self.model, self.collider, self.config = model, collider, config
        arrays = (
            *((model.inverse_mass, "float32"), (model.faces, "int32"), (model.edges, "int32")),
            *((model.lengths, "float32"), (model.stretch, "float32"), (model.compress, "float32")),
            *((model.hinges, "int32"), (model.curvature, "float32"), (model.rest_curvature, "float32")),
            *((model.bend, "float32"), (model.spring, "float32"), (model.anchor, "int32"), (model.tether, "float32")),
            (model.apart, "float32"),
            *((collider.faces, "int32"), (collider.margin, "float32"), (collider.deepest, "float32")),
        )
        self._native = _Model(
            *(len(a) for a in (model.inverse_mass, model.faces, model.edges, model.hinges)),
            *(len(collider.margin), len(collider.faces)),
            *(address(array, dtype) for array, dtype in arrays),
        )
        self._report = np.zeros(2, dtype=np.int64)
        self._forces = _Forces(
            config.gravity,
            *(fabric.drag, fabric.normal_drag, fabric.inner_friction, fabric.friction),
            *(config.own_margin, config.most_speed, config.most_stretch, address(self._report, "int64")),
        )

    @property
    def released(self) -> int:
        """Return how many contacts were let go until now because cloth between them could not keep its length."""
        return int(self._report[0])

    def advance(
        self,
        state: ClothState,
        seconds: float,
        places: Sequence[Float32[np.ndarray, "n 3"]],
        skin: Sequence[Float32[np.ndarray, "c 3"]],
    ) -> None:
        """Move the particles on, in place, on one thread; the same bits on every CPU.

        Args:
            places: where the particles would be on the body, metres, at four moments `seconds` apart: the last one,
                this span's start and end, the next one. Between them they move along Catmull and Rom's curve.
            skin: the collider's vertices at the same moments.

        Raises:
            InputError: another number of moments, particles or vertices.
        """
        for name, arrays, count in (
            ("particles", (state.position, state.velocity), len(self.model.inverse_mass)),
            ("four moments of places", places, len(self.model.inverse_mass)),
            ("four moments of the collider", skin, len(self.collider.margin)),
        ):
            # Four moments let the native code interpolate positions with continuous velocity between the middle two.
            wanted = [(count, 3)] * (2 if name == "particles" else 4)
            if [array.shape for array in arrays] != wanted:
                received = str([array.shape for array in arrays])
                raise InputError(f"cloth: {name}", expected=str(wanted), received=received)
        moments = _Moments(
            (ctypes.c_void_p * 4)(*(address(array).value for array in places)),
            (ctypes.c_void_p * 4)(*(address(array).value for array in skin)),
        )
        # Whole substeps of at most the configured length; the small term keeps round-off from adding one. The kernel
        # takes shorter ones where skin or cloth would move by more than the cloth's thickness in one.
        native_library().smplxpp_cloth_advance(
            *(ctypes.byref(self._native), ctypes.byref(self._forces), ctypes.byref(moments)),
            ctypes.c_float(seconds),
            ctypes.c_int32(max(1, ceil(seconds / self.config.substep - 1e-6))),
            ctypes.c_int32(self.config.contacts_every),
            *(address(state.position), address(state.velocity)),
        )


def move_before_collider(
    points: Float32[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    surface: Float32[np.ndarray, "c 3"],
    collider: Collider,
    *,
    margin: float,
) -> Float32[np.ndarray, "N 3"]:
    """Return points that lie behind a surface moved to `margin` metres before it, along its smooth normal.

    Args:
        normals: of the cloth at the points; skin that faces its outer side is not looked at.
        surface: the collider's vertices now, metres.
    """
    out = np.array(points, dtype=np.float32)
    native_library().smplxpp_cloth_push_out(
        *(ctypes.c_int64(len(out)), address(out), address(np.ascontiguousarray(normals, dtype=np.float32))),
        *(ctypes.c_int64(len(surface)), address(surface), address(collider.faces, "int32")),
        *(ctypes.c_int64(len(collider.faces)), ctypes.c_float(margin), address(collider.deepest)),
    )
    return out
