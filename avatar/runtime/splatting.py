"""Draw splats with the native library, without torch: the forward pass of `avatar.rendering.cpu`; relight pictures."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int64

from smplxpp.core import Camera, InputError
from smplxpp.core.errors import one_line
from smplxpp.core.light import Relighting
from smplxpp.native import OverLimitError, address, check_size, native_library

STAGES = ("project", "sort", "bin", "blend")
"""Stages of drawing whose seconds can be measured."""


class SceneCall(ctypes.Structure):
    """Arguments of the kernels, `Scene` of smplxpp/native/gaussians/gaussian.hpp."""

    _fields_ = [
        ("count", ctypes.c_int64),
        *((name, ctypes.c_int32) for name in ("channels", "reserved")),
        *((name, ctypes.c_void_p) for name in ("means", "quats", "scales", "opacities", "features")),
    ]


class CameraCall(ctypes.Structure):
    """Arguments of the kernels, `Camera` of smplxpp/native/gaussians/gaussian.hpp."""

    _fields_ = [
        *((name, ctypes.c_int32) for name in ("width", "height")),
        *((name, ctypes.c_float) for name in ("near", "far", "eps2d")),
        ("reserved", ctypes.c_int32),
        *((name, ctypes.c_void_p) for name in ("viewmat", "intrinsics", "background")),
    ]


@dataclass(frozen=True, eq=False)
class WorldSplats:
    """N Gaussians in world coordinates, in one pose. A player overwrites its arrays at the next pose.

    Attributes:
        means: metres.
        quats: wxyz.
        scales: standard deviations, metres.
        opacities: in [0, 1].
        dc: view-independent colour, sRGB.
        sh: spherical harmonics of degree 1 and up in the triangles' frames.
        face: index of each Gaussian's triangle.
        rotations: of the triangles, world from triangle.
    """

    means: Float32[np.ndarray, "N 3"]
    quats: Float32[np.ndarray, "N 4"]
    scales: Float32[np.ndarray, "N 3"]
    opacities: Float32[np.ndarray, " N"]
    dc: Float32[np.ndarray, "N 3"]
    sh: Float32[np.ndarray, "N K 3"]
    face: Int64[np.ndarray, " N"]
    rotations: Float32[np.ndarray, "F 3 3"]

    __repr__ = one_line

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
    """A renderer of splats that reuses its memory from picture to picture; it is not thread-safe."""

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
            splats: one pose.
            camera: a pinhole camera.
            background: sRGB.
            eps2d: blur of the splats, pixels squared.
            threads: of the kernels.
            seconds: float64, increased by the time of each of `STAGES`.
            features: drawn in the place of colours; None: the splats' colours.

        Raises:
            InputError: an orthographic camera, a picture too large, or splats that would fill the memory.
        """
        if camera.orthographic:
            raise InputError(f"camera {camera.name!r}", expected="a pinhole", received="an orthographic one")
        check_size(camera.width, camera.height, "picture")
        # Colours depend on the direction from the eye; features (such as normals) are drawn as they are.
        count, size = len(splats.means), (camera.height, camera.width)
        colors = features
        if colors is None:
            colors = splats.colors(camera.position.astype(np.float32), threads=threads)
        # Arguments of the kernel.
        view = np.ascontiguousarray(camera.cam_from_world, dtype=np.float32)
        K, behind = np.ascontiguousarray(camera.K, dtype=np.float32), np.array(background, dtype=np.float32)
        gaussians = (splats.means, splats.quats, splats.scales, splats.opacities, colors)
        scene = SceneCall(count, 3, 0, *(address(array) for array in gaussians))
        call = CameraCall(camera.width, camera.height, 0.01, 1e10, eps2d, 0, *map(address, (view, K, behind)))
        # The kernel also writes projected centres, radii and depths, which a player does not need.
        image, alpha = np.empty((*size, 3), np.float32), np.empty(size, np.float32)
        scratch = tuple(np.empty(shape, np.float32) for shape in ((count, 2), (count, 2), (count,)))
        # Of the lists of Gaussians by tile: one GiB while they are built.
        max_entries = (1 << 30) // 24
        try:
            self._library.gaussian_forward(
                self._handle,
                ctypes.byref(scene),
                ctypes.byref(call),
                *(address(array) for array in (image, alpha, *scratch)),
                ctypes.c_int64(max_entries),
                ctypes.c_int32(threads),
                address(seconds, "float64"),
            )
        except OverLimitError:
            raise InputError(
                "Gaussians to draw",
                expected=f"at most {max_entries:,} entries of Gaussians in tiles of the picture",
                received="more: they are too large for it",
                remedy="draw a smaller picture, or from farther away",
            ) from None
        return image, alpha


def facing_normals(
    normals: Float32[np.ndarray, "N 3"], splats: WorldSplats, eye: Float[np.ndarray, " 3"]
) -> Float32[np.ndarray, "N 3"]:
    """Return normals of the side that a point, metres, sees, flipped where the surface clearly faces away.

    A cosine above 0.35 counts as facing away. Nearer to the outline the normal stays, because the outer side is seen
    there.
    """
    # The cosine between the normal and the direction of view is positive where the surface faces away.
    towards = splats.means - np.asarray(eye, dtype=np.float32)
    cosine = np.einsum("nx,nx->n", normals, towards) / np.maximum(np.linalg.norm(towards, axis=1), 1e-9)
    return normals * np.where(cosine > 0.35, np.float32(-1.0), np.float32(1.0))[:, None]


def relit_picture(
    image: Float32[np.ndarray, "H W 3"],
    alpha: Float32[np.ndarray, "H W"],
    normals: Float32[np.ndarray, "H W 3"],
    relighting: Relighting,
    background: tuple[float, float, float],
) -> Float32[np.ndarray, "H W 3"]:
    """Relight a picture by deferred shading; the background does not change.

    Args:
        image: sRGB on the background.
        alpha: opacity; pixels below 1e-3 are left as they are.
        normals: splatted, so that they are shorter where the picture is transparent.
        relighting: the other light.
        background: sRGB.
    """
    # Alpha blending gave I = a C + (1 - a) B: recover the person's own colour C = (I - (1 - a) B) / a, shade it, and
    # composite again. Below an opacity of 1e-3 the division would amplify rounding to visible noise.
    out = image.copy()
    seen = alpha > 1e-3
    share, behind = alpha[seen][:, None], np.asarray(background, dtype=np.float32)
    own = (image[seen] - (1.0 - share) * behind) / share
    out[seen] = share * relighting.colors(own, normals[seen]) + (1.0 - share) * behind
    return out
