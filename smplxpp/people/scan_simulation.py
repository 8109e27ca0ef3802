"""Simulate the scan of image-based reconstruction: one outer surface, noise, bridges where no camera sees a gap."""

from __future__ import annotations

from dataclasses import dataclass

import igl
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from smplxpp.core import Camera, TriangleMesh, concatenate_meshes
from smplxpp.core.signed_distance import SignedDistanceField, barycentric_coordinates
from smplxpp.core.topology import component_labels, face_components
from smplxpp.people.cloth_mesh import diffuse, smooth
from smplxpp.raster import rasterize_mesh, view_directions


@dataclass(frozen=True)
class ScanConfig:
    """Settings of a simulated scan; lengths in metres.

    Attributes:
        cell: cell size of the grid on which depth is fused.
        views: number of orthographic depth images around the person.
        resolution: pixels a side of a depth image.
        min_elevation: smallest y of the unit vector towards a camera; none looks from far below the horizon.
        free_margin: a cell is empty when a camera sees at least this far past it.
        sheet_thickness: thickness of open sheets (clothes), inwards, so that both their sides exist.
        faces: number of faces of the scan.
        detail_above: height over the lowest vertex above which the mesh is finer (the head).
        detail: ratio of the edges' lengths below and above, as in captures with cameras on the face.
        noise: standard deviation of the displacement along the normal.
        noise_radius: correlation length of the noise.
        seed: seed of the noise.
    """

    cell: float = 0.004
    views: int = 96
    resolution: int = 1024
    min_elevation: float = -0.12
    free_margin: float = 0.006
    sheet_thickness: float = 0.009
    faces: int = 80_000
    detail_above: float = 1.45
    detail: float = 1.7
    noise: float = 0.0007
    noise_radius: float = 0.006
    seed: int = 0


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """A closed mesh with the point of the scanned layers that each vertex shows.

    Attributes:
        mesh: the scan.
        face: face of the layers that each vertex shows.
        barycentric: barycentric coordinates of the point on that face.
    """

    mesh: TriangleMesh
    face: Int[np.ndarray, " N"]
    barycentric: Float[np.ndarray, "N 3"]

    def shown_on(self, layers: TriangleMesh) -> Float[np.ndarray, "N 3"]:
        """Return the points that the vertices show on the layers, whatever pose the layers are in."""
        return np.einsum("pk,pkx->px", self.barycentric, layers.triangles[self.face])


def simulate_scan(layers: TriangleMesh, sheets: list[Bool[np.ndarray, " M"]], config: ScanConfig) -> SimulatedScan:
    """Return the scan of layers that stand on the plane of their lowest vertex.

    Args:
        layers: closed parts and open sheets, oriented outwards.
        sheets: face mask of each open sheet.
        config: settings.
    """
    # Depth images of the layers, whose sheets get a thickness.
    solid = concatenate_meshes([layers, *(_inner_side(layers, mask, config.sheet_thickness) for mask in sheets)])
    cameras = _cameras(layers, config)
    depths, seen = _depth_images(solid, cameras)
    # Faces smaller than a pixel at grazing angles count as seen if one of their vertices is.
    seen_vertex = np.zeros(solid.vertex_count, dtype=bool)
    seen_vertex[solid.faces[seen]] = True
    seen = seen_vertex[solid.faces].any(axis=1)

    # Fuse them to a level set, extract its outer surface, smooth and simplify it.
    grid, size = _grid(solid, config.cell)
    level = _level_set(solid, seen, grid, (cameras, depths), config)
    vertices, faces, _ = igl.marching_cubes(level, grid, *size, 0.0)
    surface = _outer_component(TriangleMesh(vertices, faces))
    surface = surface.with_vertices(smooth(surface, surface.vertices, steps=1))
    surface = _simplified(surface, config)
    face, barycentric = _shown_points(layers, seen[: layers.face_count], surface.vertices)
    # Correlated noise along the normals.
    rng = np.random.default_rng(config.seed)
    bumps = diffuse(surface, rng.normal(size=(surface.vertex_count, 1)), radius=config.noise_radius)
    noisy = surface.vertices + config.noise * bumps / bumps.std() * surface.vertex_normals
    return SimulatedScan(surface.with_vertices(noisy), face, barycentric)


def _inner_side(layers: TriangleMesh, mask: Bool[np.ndarray, " M"], thickness: float) -> TriangleMesh:
    """Return the back of a sheet, moved inwards, and the rim that joins it to the front."""
    sheet = layers.submesh(mask)[0]
    n = sheet.vertex_count
    back = sheet.vertices - thickness * sheet.vertex_normals
    # Border edges in the direction of their faces.
    directed = np.concatenate([sheet.faces[:, [0, 1]], sheet.faces[:, [1, 2]], sheet.faces[:, [2, 0]]])
    border = directed[np.isin(np.sort(directed, axis=1) @ [n, 1], sheet.border_edges @ [n, 1])]
    # Two triangles for each border edge, wound as the sheet.
    a, b = border.T
    rim = np.concatenate([np.stack([b, a, a + n], axis=1), np.stack([b, a + n, b + n], axis=1)])
    return TriangleMesh(np.concatenate([sheet.vertices, back]), np.concatenate([sheet.faces[:, ::-1] + n, rim]))


def _cameras(mesh: TriangleMesh, config: ScanConfig) -> list[Camera]:
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    directions = view_directions(config.views)
    radius = 0.52 * float(np.linalg.norm(high - low))
    return [
        Camera.orthographic_view(center=0.5 * (low + high), direction=d, half_extent=radius, size=config.resolution)
        for d in directions[directions[:, 1] > config.min_elevation]
    ]


def _depth_images(
    mesh: TriangleMesh, cameras: list[Camera]
) -> tuple[list[Float32[np.ndarray, "H W"]], Bool[np.ndarray, " M"]]:
    """Return the depth image of every view, and which faces cover a pixel of any."""
    seen = np.zeros(mesh.face_count, dtype=bool)
    depths = []
    for camera in cameras:
        maps = rasterize_mesh(mesh, camera)
        seen[maps.face_id[maps.mask]] = True
        depths.append(maps.depth)
    return depths, seen


def _grid(mesh: TriangleMesh, cell: float) -> tuple[Float[np.ndarray, "G 3"], tuple[int, int, int]]:
    """Return grid points with x fastest, four cells larger than the mesh on each side, and counts along x, y, z."""
    low, high = mesh.vertices.min(axis=0) - 4 * cell, mesh.vertices.max(axis=0) + 4 * cell
    nx, ny, nz = (int(n) for n in np.ceil((high - low) / cell).astype(int) + 1)
    size = (nx, ny, nz)
    points = np.empty((nz, ny, nx, 3))
    for axis in range(3):
        shape = [1, 1, 1]
        shape[2 - axis] = size[axis]
        points[..., axis] = (low[axis] + cell * np.arange(size[axis])).reshape(shape)
    return points.reshape(-1, 3), size


def _level_set(
    mesh: TriangleMesh,
    seen: Bool[np.ndarray, " M"],
    grid: Float[np.ndarray, "G 3"],
    views: tuple[list[Camera], list[Float32[np.ndarray, "H W"]]],
    config: ScanConfig,
) -> Float[np.ndarray, " G"]:
    """Return the distance to the nearest surface, truncated to a band, negative where the cameras leave it solid.

    Near a seen surface its normal decides the side. Elsewhere a point is free if some camera sees clearly past it or if
    it is below the floor. Points that no camera sees stay solid, which makes the bridges.
    """
    # Carve away the points that a camera sees past.
    solid = grid[:, 1] >= mesh.vertices[:, 1].min()
    for camera, depth in zip(*views, strict=True):
        left = np.flatnonzero(solid)
        x, y, z = camera.screen_from_world(grid[left]).T[:3]
        column = np.clip(x.astype(int), 0, camera.width - 1)
        row = np.clip(y.astype(int), 0, camera.height - 1)
        solid[left[depth[row, column] > z + config.free_margin]] = False

    # Signed distances within two cells of the surface.
    band = 2 * config.cell
    level = np.where(solid, -band, band)
    near = np.flatnonzero(_near_vertices(mesh, grid, config.cell))
    where = SignedDistanceField(mesh, solid=True).query(grid[near], sided=solid[near])
    close = np.abs(where.distance) < band
    outside = ~solid[near] | ((where.distance > 0) & seen[where.face])
    level[near] = np.where(outside, 1.0, -1.0) * np.where(close, np.abs(where.distance), band)
    return level


def _near_vertices(mesh: TriangleMesh, grid: Float[np.ndarray, "G 3"], cell: float) -> Bool[np.ndarray, " G"]:
    """Return which grid points are within about three cells of a corner or centre of a face."""
    low = grid[0]
    size = np.round((grid[-1] - low) / cell).astype(int) + 1
    hit = np.zeros(size[::-1], dtype=bool)
    samples = np.concatenate([mesh.vertices, mesh.triangles.mean(axis=1)])
    index = np.round((samples - low) / cell).astype(int)
    # Mark the cells of the samples, then grow them by three cells along each axis.
    hit[index[:, 2], index[:, 1], index[:, 0]] = True
    for axis in range(3):
        grown = hit.copy()
        for step in (1, 2, 3):
            grown |= np.roll(hit, step, axis=axis) | np.roll(hit, -step, axis=axis)
        hit = grown
    return hit.ravel()


def _outer_component(mesh: TriangleMesh) -> TriangleMesh:
    """Return the connected component with the largest area, oriented outwards."""
    # Marching cubes extracts inner cavities too; the outer surface is the largest.
    component = face_components(mesh.faces)
    areas = np.bincount(component, mesh.face_areas)
    kept = mesh.submesh(component == np.argmax(areas))[0]
    volume = np.einsum("ij,ij->", kept.triangles.mean(axis=1) - kept.vertices.mean(axis=0), kept.face_cross)
    return kept if volume > 0 else TriangleMesh(kept.vertices, kept.faces[:, ::-1])


def _simplified(mesh: TriangleMesh, config: ScanConfig) -> TriangleMesh:
    """Return the mesh with `config.faces` faces of about equal size, smaller on the head."""
    floor = mesh.vertices[:, 1].min()
    # Shortest edges collapse first, so simplify in a space stretched above `detail_above`, then invert the stretch.
    height = np.linspace(-0.1, 2.5, 2601)
    scale = 1 + (config.detail - 1) * np.clip((height - config.detail_above) / 0.1 + 0.5, 0, 1)
    stretched = np.concatenate([[0.0], np.cumsum(0.5 * (scale[1:] + scale[:-1]) * np.diff(height))])

    y = mesh.vertices[:, 1] - floor
    wide = np.interp(y, height, scale)
    points = np.stack([mesh.vertices[:, 0] * wide, np.interp(y, height, stretched), mesh.vertices[:, 2] * wide], axis=1)
    points, faces = igl.decimate(points, mesh.faces, config.faces)[:2]
    y = np.interp(points[:, 1], stretched, height)
    wide = np.interp(y, height, scale)
    return TriangleMesh(np.stack([points[:, 0] / wide, y + floor, points[:, 2] / wide], axis=1), faces)


def _shown_points(
    layers: TriangleMesh, seen: Bool[np.ndarray, " M"], points: Float[np.ndarray, "N 3"]
) -> tuple[Int[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """Return the closest seen face of the layers and the barycentric coordinates of the closest point on it."""
    # Hidden layers are not shown, however near they are.
    candidates = np.flatnonzero(seen)
    _, face, closest = igl.point_mesh_squared_distance(points, layers.vertices, layers.faces[candidates])
    face = candidates[face]
    return face, barycentric_coordinates(closest, layers.triangles[face])


def merge_islands(mesh: TriangleMesh, part: UInt8[np.ndarray, " N"], *, smallest: int = 30) -> UInt8[np.ndarray, " N"]:
    """Return each vertex's part; connected components below `smallest` vertices take the part around them.

    Where layers touch, it is random which one is closest to a noisy vertex.
    """
    part, edges = part.copy(), mesh.edges
    piece = component_labels(edges[part[edges[:, 0]] == part[edges[:, 1]]], mesh.vertex_count)
    for small in np.flatnonzero(np.bincount(piece) < smallest):
        # Edges from the small component to its surroundings; the most frequent part there wins.
        inside = piece[edges] == small
        crossing = inside[:, 0] != inside[:, 1]
        around = part[edges[crossing][~inside[crossing]]]
        if len(around):
            part[piece == small] = np.argmax(np.bincount(around))
    return part
