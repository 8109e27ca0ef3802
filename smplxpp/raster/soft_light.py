"""Ambient light with the shadows that the person casts on herself: irradiance of every vertex.

Depth images from many directions show which vertices light from there reaches, so that shading changes with the pose.
Interreflection is estimated from the colour of the surface itself, without path tracing.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64

from smplxpp.core import Camera, TriangleMesh, require_positive
from smplxpp.core.light import Irradiance, panorama_directions
from smplxpp.raster.zbuffer import rasterize_mesh, view_directions

# Radiance of the stage from above and from below: brighter above, as lit stages are.
_SKY, _GROUND = 1.16, 0.68


@dataclass(frozen=True)
class LightConfig:
    """Sampling and accuracy of the ambient light.

    Attributes:
        directions: number of directions from which light comes.
        resolution: pixels a side of a direction's depth image.
        lift: metres off the surface at which visibility is tested, against self-shadowing by the image's grain.
        slack: metres that a visible point may lie behind the depth image.
    """

    directions: int = 72
    resolution: int = 384
    lift: float = 0.006
    slack: float = 0.004


@dataclass(frozen=True, eq=False)
class Environment:
    """A panorama that replaces the stage's light.

    Attributes:
        panorama: linear radiance (`smplxpp.core.light`).
        name: name of the panorama.
        turn: rotation about +Y in degrees.
        exposure: factor on it; None: the mean brightness of the stage.

    Raises:
        InputError: negative light, NaN or infinity, or no light at all; an exposure that is not above 0.
    """

    panorama: Float[np.ndarray, "h w 3"]
    name: str = "panorama"
    turn: float = 0.0
    exposure: float | None = None

    def __post_init__(self) -> None:
        light = Irradiance.of_environment(self.panorama)
        exposure = stage_light().mean / max(light.mean, 1e-12) if self.exposure is None else self.exposure
        require_positive("--exposure", exposure)
        object.__setattr__(self, "exposure", exposure)

    def at(self, mesh: TriangleMesh, config: LightConfig) -> Float64[np.ndarray, "2 N 3"]:
        """Return the irradiance of the vertices under the exposed panorama; see `environment_light`."""
        assert self.exposure is not None  # set above
        return environment_light(mesh, config, self.exposure * self.panorama, turn=self.turn)


def vertex_light(mesh: TriangleMesh, config: LightConfig) -> Float64[np.ndarray, "2 N"]:
    """Return the irradiance over pi at each vertex, on its outer and its inner side; 1 is an open vertex's mean.

    `E(n) = 1/pi integral of L(w) V(w) max(n . w, 0) dw`, with V from depth images along `w`.
    """

    def stage(direction: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, " 1"]:
        return np.array([_GROUND + (_SKY - _GROUND) * 0.5 * (1.0 + direction[1])])

    return _gathered(mesh, config, stage)[..., 0]


def stage_light() -> Irradiance:
    """Return the unshadowed irradiance of the stage as spherical harmonics."""
    coefficients = np.zeros((9, 3))
    # A linear gradient in y has two coefficients: the constant and the first-order one of y.
    coefficients[0] = 0.5 * (_SKY + _GROUND) * np.sqrt(4.0 * np.pi)
    coefficients[1] = 0.5 * (_SKY - _GROUND) * np.sqrt(4.0 * np.pi / 3.0)
    return Irradiance(coefficients)


def environment_light(
    mesh: TriangleMesh, config: LightConfig, panorama: Float[np.ndarray, "h w 3"], *, turn: float = 0.0
) -> Float64[np.ndarray, "2 N 3"]:
    """Return the irradiance over pi at each vertex, outside and inside, under a panorama, shadows included.

    Args:
        mesh: all layers.
        config: quality.
        panorama: linear radiance (`smplxpp.core.light`).
        turn: rotation of the panorama about +Y in degrees.
    """
    # Directions and solid angles of the pixels.
    height, width = panorama.shape[:2]
    toward = panorama_directions(height, width, turn=turn).reshape(-1, 3)
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    solid = np.repeat(edges[:-1] - edges[1:], width)
    # Every pixel's light is assigned to the nearest direction, so that the total is kept.
    nearest = np.argmax(toward @ view_directions(config.directions).T, axis=1)
    total = np.zeros((config.directions, 3))
    np.add.at(total, nearest, solid[:, None] * panorama.reshape(-1, 3))
    share = np.bincount(nearest, solid, minlength=config.directions)
    # Mean radiance of each direction, weighted by its share of the sphere.
    mean = total / np.maximum(share, 1e-12)[:, None] * (share / share.mean())[:, None]
    brightness = {tuple(d): c for d, c in zip(view_directions(config.directions).tolist(), mean, strict=True)}
    return _gathered(mesh, config, lambda direction: brightness[tuple(direction.tolist())])


def _gathered(
    mesh: TriangleMesh,
    config: LightConfig,
    radiance: Callable[[Float64[np.ndarray, " 3"]], Float64[np.ndarray, " C"]],
) -> Float64[np.ndarray, "2 N C"]:
    """Return the light that reaches each vertex on both sides, a sum over directions of visible cosines."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    radius = 0.51 * float(np.linalg.norm(high - low))
    directions = view_directions(config.directions)
    normals = mesh.vertex_normals
    lifted = [mesh.vertices + side * config.lift * normals for side in (1.0, -1.0)]

    # One depth image a direction; visibility times cosine times radiance.
    def from_one(direction: Float64[np.ndarray, " 3"]) -> Float64[np.ndarray, "2 N C"]:
        camera = Camera.orthographic_view(
            center=0.5 * (low + high), direction=direction, half_extent=radius, size=config.resolution
        )
        depth = rasterize_mesh(mesh, camera, threads=1).depth
        brightness = radiance(direction)
        facing = normals @ direction
        out = np.zeros((2, mesh.vertex_count, len(brightness)))
        for k, cosine in enumerate((facing, -facing)):
            lit = np.flatnonzero(cosine > 0.0)
            visible = _visible(camera, depth, lifted[k][lit], config.slack)
            out[k, lit] = brightness * cosine[lit, None] * visible[:, None]
        return out

    with ThreadPoolExecutor(2) as pool:
        total = sum(pool.map(from_one, directions), np.zeros((2, mesh.vertex_count, 1)))
    return total * (4.0 / config.directions)


def bounced(light: Float[np.ndarray, " P"], albedo: Float[np.ndarray, "P 3"]) -> Float[np.ndarray, "P 3"]:
    """Return the linear colour of surfaces in a light, with interreflection.

    Occluded directions are taken to see surfaces of the same albedo in the same light: `E = a + (1 - a) albedo E`, so
    `E = a / (1 - (1 - a) albedo)`, with `a` the unoccluded share.
    """
    albedo = np.minimum(albedo, 0.9)
    share = np.minimum(light, 1.0)[:, None]
    return albedo * light[:, None] / (1.0 - (1.0 - share) * albedo)


def _visible(
    camera: Camera, depth: Float32[np.ndarray, "H W"], points: Float64[np.ndarray, "P 3"], slack: float
) -> Float64[np.ndarray, " P"]:
    """Return the share of the four pixels around each point, bilinear, whose depth does not hide it."""
    x, y, z = camera.screen_from_world(points).T[:3]
    x, y = x - 0.5, y - 0.5
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    fx, fy = x - column, y - row
    flat, width = depth.ravel(), camera.width
    index = row * width + column
    front = z - slack
    # Bilinear weights of four depth tests.
    upper = (1 - fx) * (flat.take(index) > front) + fx * (flat.take(index + 1) > front)
    lower = (1 - fx) * (flat.take(index + width) > front) + fx * (flat.take(index + width + 1) > front)
    return (1 - fy) * upper + fy * lower
