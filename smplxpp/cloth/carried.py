"""Kernels of what cloth carries: fine vertices over particles, and vertices between the T-pose and the pose."""

from __future__ import annotations

import ctypes

import numpy as np
from jaxtyping import Float, Float32, Int, Int64

from smplxpp.body.model import PosedBody
from smplxpp.cloth.embedding import Embedding
from smplxpp.cloth.solver import Collider
from smplxpp.core.skin_weights import SkinWeights
from smplxpp.native import address, native_library


class _Carried(ctypes.Structure):
    _fields_ = [
        *(
            (name, ctypes.c_int64)
            for name in ("vertices", "triangles", "particles", "faces", "collider_vertices", "collider_faces")
        ),
        *(
            (name, ctypes.c_void_p)
            for name in ("triangle", "which", "weight", "offset", "face", "collider_face", "deepest")
        ),
    ]


class CarriedVertices:
    """N vertices that n particles carry, kept out of a collider of c vertices; `Embedding.carried` by a kernel.

    Args:
        embedding: of the vertices.
        faces: of the particles.
        collider: what they keep out of.
        particles: their number n.
    """

    def __init__(self, embedding: Embedding, faces: Int[np.ndarray, "m 3"], collider: Collider, particles: int) -> None:
        # Many vertices ride on one triangle; each distinct triangle is posed once.
        triangles, which = np.unique(embedding.corners, axis=0, return_inverse=True)
        self._count, self._shapes = len(embedding.corners), ((particles, 3), (len(collider.margin), 3))
        arrays = (
            *((np.ascontiguousarray(triangles, dtype=np.int32), "int32"),),
            *((np.ascontiguousarray(which.ravel(), dtype=np.int32), "int32"),),
            *(
                (np.ascontiguousarray(embedding.weights), "float32"),
                (np.ascontiguousarray(embedding.offset), "float32"),
            ),
            *((np.ascontiguousarray(faces, dtype=np.int32), "int32"), (collider.faces, "int32")),
            (collider.deepest, "float32"),
        )
        self._kept = [address(array, dtype) for array, dtype in arrays]
        self._native = _Carried(
            *(self._count, len(triangles), particles, len(faces), len(collider.margin), len(collider.faces)),
            *self._kept,
        )

    def at(
        self, particles: Float32[np.ndarray, "n 3"], surface: Float32[np.ndarray, "c 3"], *, margin: float
    ) -> Float32[np.ndarray, "N 3"]:
        """Return where the vertices are, metres: `margin` metres before the surface where they lie behind that.

        Args:
            particles: where they are.
            surface: where the collider's vertices are.
        """
        assert (particles.shape, surface.shape) == self._shapes
        out = np.empty((self._count, 3), dtype=np.float32)
        native_library().smplxpp_cloth_carry(
            *(ctypes.byref(self._native), address(particles), address(surface), ctypes.c_float(margin), address(out))
        )
        return out


class _Skinned(ctypes.Structure):
    _fields_ = [
        *((name, ctypes.c_int64) for name in ("rows", "vertices", "joints", "influences")),
        *((name, ctypes.c_void_p) for name in ("row", "joint", "weight")),
    ]


class SkinnedRows:
    """R of V vertices under linear blend skinning, there and back.

    Args:
        weights: of all V vertices.
        rows: which of them.
    """

    def __init__(self, weights: SkinWeights, rows: Int64[np.ndarray, " R"]) -> None:
        arrays = (
            *((rows.astype(np.int32), "int32"), (np.ascontiguousarray(weights.joint_indices, dtype=np.int32), "int32")),
            (np.ascontiguousarray(weights.joint_weights, dtype=np.float32), "float32"),
        )
        self._kept = [address(array, dtype) for array, dtype in arrays]
        self._count, self._joints = len(rows), weights.joint_count
        self._native = _Skinned(
            self._count, len(weights), weights.joint_count, weights.joint_indices.shape[1], *self._kept
        )

    def posed(
        self, body: PosedBody, rest: Float32[np.ndarray, "V 3"], *, origin: Float[np.ndarray, " 3"]
    ) -> Float32[np.ndarray, "R 3"]:
        """Return where skinning takes them from rest, metres from the origin: `sum_j w_j G_j v`."""
        out = np.empty((self._count, 3), dtype=np.float32)
        native_library().smplxpp_cloth_posed(
            ctypes.byref(self._native), address(self._transforms(body, origin)), address(rest), address(out)
        )
        return out

    def unposed(
        self,
        body: PosedBody,
        rest: Float32[np.ndarray, "V 3"],
        places: Float32[np.ndarray, "R 3"],
        *,
        origin: Float[np.ndarray, " 3"],
    ) -> Float32[np.ndarray, "R 3"]:
        """Return the displacements in the T-pose that skinning takes to places: `(sum_j w_j G_j)^-1 x - v`, metres.

        Joints that turn against each other flatten a blend; such a vertex stays with skinning.
        """
        assert places.shape == (self._count, 3)
        out = np.empty((self._count, 3), dtype=np.float32)
        # Of a blend of rotations; below, its inverse blows up what the cloth did.
        least_determinant = 0.2
        native_library().smplxpp_cloth_unposed(
            *(ctypes.byref(self._native), address(self._transforms(body, origin)), address(rest), address(places)),
            *(ctypes.c_float(least_determinant), address(out)),
        )
        return out

    def _transforms(self, body: PosedBody, origin: Float[np.ndarray, " 3"]) -> Float32[np.ndarray, "J 12"]:
        transforms = np.array(body.posed_from_rest[0, :, :3])
        assert len(transforms) == self._joints
        transforms[:, :, 3] -= origin
        return transforms.reshape(-1, 12).astype(np.float32)
