"""Splats to a picture through the native library, without torch: the forward pass of `avatar.rendering.cpu`."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from smplxpp.core.camera import Camera
from smplxpp.core.errors import InputError
from smplxpp.native import OverLimitError, address, check_size, native_library

STAGES = ("project", "sort", "bin", "blend")
# Entries of the lists of Gaussians by tile: a GiB of them while they are made.
_MOST_ENTRIES = (1 << 30) // 24
_NEAR, _FAR = 0.01, 1e10


class SceneCall(ctypes.Structure):
    """Scene of smplxpp/native/gaussians/gaussian.hpp."""

    _fields_ = [
        ("count", ctypes.c_int64),
        *((name, ctypes.c_int32) for name in ("channels", "reserved")),
        *((name, ctypes.c_void_p) for name in ("means", "quats", "scales", "opacities", "features")),
    ]


class CameraCall(ctypes.Structure):
    """Camera of smplxpp/native/gaussians/gaussian.hpp."""

    _fields_ = [
        *((name, ctypes.c_int32) for name in ("width", "height")),
        *((name, ctypes.c_float) for name in ("near", "far", "eps2d")),
        ("reserved", ctypes.c_int32),
        *((name, ctypes.c_void_p) for name in ("viewmat", "intrinsics", "background")),
    ]


@dataclass(frozen=True, eq=False)
class WorldSplats:
    """N Gaussians in the world, in one pose; the arrays may be a player's own, which the next pose writes anew.

    Attributes:
        means: metres. quats: wxyz. scales: standard deviations, metres. opacities: in [0, 1].
        dc: colour that does not depend on the view, sRGB. sh: harmonics of degree 1 and up in the triangles' frames.
        face: the triangle of each. rotations: world from triangle.
    """

    means: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    scales: Float32[np.ndarray, "N 3"]
    opacities: Float32[np.ndarray, " N"]
    dc: Float32[np.ndarray, "N 3"]
    sh: Float32[np.ndarray, "N K 3"]
    face: Int64[np.ndarray, " N"]
    rotations: Float32[np.ndarray, "F 3 3"]

    def colors(self, eye: Float32[np.ndarray, " 3"], *, threads: int = 1) -> Float32[np.ndarray, "N 3"]:
        """Return the colours towards a point in the world, metres: `max(0, dc + sum_k sh_k Y_k(R^T d))`."""
        out = np.empty_like(self.dc)
        native_library().smplxpp_colors_forward(
            address(self.face, "int64"),
            *(address(array) for array in (self.rotations, self.dc, self.sh, self.means, eye)),
            *(ctypes.c_int64(n) for n in (len(self.dc), 1)),
            self.sh.shape[1],
            address(out),
            threads,
        )
        return out


class Splatter:
    """Draws splats, with memory that it keeps from picture to picture; not for two threads at once."""

    def __init__(self) -> None:
        self._library = native_library()
        handle = ctypes.c_void_p()
        self._library.gaussian_workspace_new(ctypes.byref(handle))
        self._handle: ctypes.c_void_p | None = handle

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self._library.gaussian_workspace_free(self._handle)
            self._handle = None

    def draw(
        self,
        splats: WorldSplats,
        camera: Camera,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        eps2d: float = 0.1,
        threads: int = 1,
        seconds: np.ndarray | None = None,
        features: Float32[np.ndarray, "N 3"] | None = None,
    ) -> tuple[Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
        """Return the picture, sRGB and not clamped, and its opacity.

        Args:
            camera: a pinhole. background: sRGB. eps2d: pixels squared by which splats are blurred.
            seconds: float64, added to by `STAGES`. features: in the place of colours; None: the splats' own.

        Raises:
            InputError: a parallel camera, a picture too large, or splats that would fill the memory.
        """
        if camera.orthographic:
            raise InputError(f"camera {camera.name!r}", expected="a pinhole", received="an orthographic one")
        check_size(camera.width, camera.height, "picture")
        count, size = len(splats.means), (camera.height, camera.width)
        colors = features
        if colors is None:
            colors = splats.colors(camera.position.astype(np.float32), threads=threads)
        view = np.ascontiguousarray(camera.cam_from_world, dtype=np.float32)
        K, behind = np.ascontiguousarray(camera.K, dtype=np.float32), np.array(background, dtype=np.float32)
        gaussians = (splats.means, splats.quats, splats.scales, splats.opacities, colors)
        scene = SceneCall(count, 3, 0, *(address(array) for array in gaussians))
        call = CameraCall(camera.width, camera.height, _NEAR, _FAR, eps2d, 0, *map(address, (view, K, behind)))
        image, alpha = np.empty((*size, 3), np.float32), np.empty(size, np.float32)
        scratch = tuple(np.empty(shape, np.float32) for shape in ((count, 2), (count, 2), (count,)))
        try:
            self._library.gaussian_forward(
                self._handle,
                ctypes.byref(scene),
                ctypes.byref(call),
                *(address(array) for array in (image, alpha, *scratch)),
                ctypes.c_int64(_MOST_ENTRIES),
                ctypes.c_int32(threads),
                address(seconds, "float64"),
            )
        except OverLimitError:
            raise InputError(
                "Gaussians to draw",
                expected=f"at most {_MOST_ENTRIES:,} entries of Gaussians in tiles of the picture",
                received="more: they are too large for it",
                remedy="draw a smaller picture, or from farther away",
            ) from None
        return image, alpha
