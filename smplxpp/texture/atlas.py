"""Unwrap the parts of a template into charts, pack them, and find the surface behind every texel."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64

from smplxpp.core import Camera, TriangleMesh
from smplxpp.core.topology import component_labels
from smplxpp.raster import rasterize_triangles
from smplxpp.template.template import BODY_PART, Template

# Charts are packed on a grid of this many cells a side, whatever the pictures' size, and stand this many cells apart:
# two texels of the smallest picture, which bilinear filtering needs, and four and eight of the larger ones.
_GRID, _APART = 1024, 2
# How much finer than the whole body a part of it may lie in its file's own layout, as faces do.
_FINER = 2.0

BodyUV = tuple[Float64[np.ndarray, "U 2"], Int64[np.ndarray, "F 3"]]


def can_unwrap() -> bool:
    """Whether xatlas, which unwraps, is installed."""
    return importlib.util.find_spec("xatlas") is not None


@dataclass(frozen=True, eq=False)
class Atlas:
    """Where the faces of a template lie in its pictures.

    Attributes:
        uv: texture coordinates in [0, 1], v downwards.
        face_uv: row of `uv` of each corner of the faces.
        picture: number of the picture of each part.
    """

    uv: Float64[np.ndarray, "U 2"]
    face_uv: Int64[np.ndarray, "F 3"]
    picture: Int64[np.ndarray, " P"]


def unwrap(template: Template, body_uv: BodyUV | None, *, layout: str = "one") -> Atlas:
    """Unwrap a template.

    Parts are cut into charts and flattened by xatlas (Young 2018; charts grown by their normals, least squares
    conformal maps). The body keeps the charts of its own file. Every chart has the same number of texels a square
    metre, except for those that are finer in the body's file, such as the face, which stay up to twice as fine.

    Args:
        template: body and parts.
        body_uv: layout of the body's file, v upwards, a row a face of the body; None: it is unwrapped, too.
        layout: "one" picture for all parts, or one a "part"; then the body lies as in its file.

    Example:
        >>> atlas = unwrap(template, smplxpp.load_body().uv)  # doctest: +SKIP
    """
    charts = []
    for name in template.part_names:
        chosen = template.part_faces(name)
        mesh = TriangleMesh(template.vertices, template.faces[chosen])
        own = body_uv if name == BODY_PART and body_uv is not None and len(body_uv[1]) == mesh.face_count else None
        charts.append(_charts(mesh) if own is None else _file_charts(mesh, own))
    # Each picture is packed by itself; a part without faces has nothing in it.
    if layout == "one":
        packed, picture = _packed(charts), np.zeros(len(charts), np.int64)
    else:
        packed, picture = [_packed([chart])[0] for chart in charts], np.arange(len(charts))
        if body_uv is not None and len(body_uv[1]) == len(packed[0][1]):
            packed[0] = (body_uv[0] * [1, -1] + [0, 1], body_uv[1])
    starts = np.cumsum([0] + [len(uv) for uv, _ in packed])
    uv = np.concatenate([uv for uv, _ in packed])
    faces = np.concatenate([faces + start for (_, faces), start in zip(packed, starts[:-1], strict=True)])
    return Atlas(np.clip(uv, 0.0, 1.0), faces, picture)


def _charts(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    """Cut a mesh into charts: texture coordinates in metres, and their rows at the corners."""
    # Square metres. Larger charts have fewer seams and take longer: without a limit 20,000 faces of trousers
    # take 3.5 seconds and have 113 charts, with this one 1.0 and 139.
    largest_chart = 0.02
    import xatlas

    if not mesh.face_count:
        return np.zeros((0, 2)), np.zeros((0, 3), np.int64)
    used, corners = np.unique(mesh.faces, return_inverse=True)
    atlas, options, packing = xatlas.Atlas(), xatlas.ChartOptions(), xatlas.PackOptions()
    options.max_chart_area = largest_chart
    # A coarse packing, which no file holds: the charts are packed together with all others afterwards.
    packing.texels_per_unit = 200.0
    faces = corners.reshape(mesh.faces.shape)
    atlas.add_mesh(mesh.vertices[used].astype(np.float32), faces.astype(np.uint32))
    atlas.generate(options, packing)
    _, rows, uv = atlas.get_mesh(0)
    return uv * [atlas.width, atlas.height] / atlas.texels_per_unit, rows.astype(np.int64)


def _file_charts(mesh: TriangleMesh, uv: BodyUV) -> tuple[np.ndarray, np.ndarray]:
    """Scale the charts of the body's file to metres; charts that are finer than the body as a whole stay finer."""
    places, rows = uv
    corners = places[rows]
    flat = 0.5 * np.abs(_cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    chart = component_labels(np.concatenate([rows[:, :2], rows[:, 1:]]), len(places))
    count = int(chart.max(initial=-1)) + 1
    own = chart[rows[:, 0]]
    area = np.bincount(own, mesh.face_areas, count)
    density = np.sqrt(np.bincount(own, flat, count) / np.maximum(area, 1e-12))
    usual = np.sqrt(flat.sum() / max(float(area.sum()), 1e-12))
    finer = np.clip(density / max(usual, 1e-12), 1.0, _FINER)
    scale = np.divide(finer, density, out=np.ones(count), where=density > 0)
    return places * [1, -1] * scale[chart][:, None], rows


def _packed(charts: list[tuple[np.ndarray, np.ndarray]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Pack charts given in metres into the unit square; every face keeps its corners' order."""
    # Share of the picture that charts are packed to at first; more of it needed further attempts on three people
    # of four.
    first_share = 0.55
    import xatlas

    area = sum(0.5 * float(np.abs(_cross(*_edges(uv, rows))).sum()) for uv, rows in charts)
    if area <= 0:
        return [(np.full((max(len(uv), 1), 2), 0.5), np.zeros_like(rows)) for uv, rows in charts]
    # The packer takes a density and gives a size, so that the density is brought down until the size fits.
    density = _GRID * np.sqrt(first_share / area)
    while True:
        atlas, options = xatlas.Atlas(), xatlas.PackOptions()
        options.padding, options.texels_per_unit, options.bilinear = _APART, density, True
        filled = [k for k, (_, rows) in enumerate(charts) if len(rows)]
        for k in filled:
            uv, rows = charts[k]
            atlas.add_uv_mesh((uv - uv.min(axis=0)).astype(np.float32), rows.astype(np.uint32))
        atlas.generate(xatlas.ChartOptions(), options)
        side = max(atlas.width, atlas.height)
        if side <= _GRID:
            break
        density *= min(_GRID / side, 0.99)
    out: list[tuple[np.ndarray, np.ndarray]] = [(np.zeros((0, 2)), rows) for _, rows in charts]
    for place, k in enumerate(filled):
        _, found, uv = atlas.get_mesh(place)
        uv, rows = uv * ([atlas.width / _GRID, atlas.height / _GRID]), found.astype(np.int64)
        # Faces without an area stay where they were while their chart moves: they become a point.
        before, after = (_longest(*pair) for pair in (charts[k], (uv, rows)))
        torn = after > 1.5 * before * density / _GRID + 1e-6
        out[k] = (uv, np.where(torn[:, None], rows[:, :1], rows))
    return out


def _longest(uv: np.ndarray, rows: np.ndarray) -> np.ndarray:
    corners = uv[rows]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)


@dataclass(frozen=True, eq=False)
class Texels:
    """The texels of a tile whose centres lie in a face.

    Attributes:
        row: of the picture.
        column: of the picture.
        face: of the template.
        barycentric: weights of the face's corners.
    """

    row: Int64[np.ndarray, " T"]
    column: Int64[np.ndarray, " T"]
    face: Int64[np.ndarray, " T"]
    barycentric: Float64[np.ndarray, "T 3"]

    def interpolate(self, values: Float[np.ndarray, "F 3 D"]) -> Float64[np.ndarray, "T D"]:
        """Interpolate values at the corners of faces."""
        return np.einsum("tk,tkd->td", self.barycentric, values[self.face])

    def select(self, chosen: Bool[np.ndarray, " T"]) -> Texels:
        """Return some of the texels."""
        return Texels(self.row[chosen], self.column[chosen], self.face[chosen], self.barycentric[chosen])


def texels_of(atlas: Atlas, faces: Bool[np.ndarray, " F"], size: int) -> Iterator[Texels]:
    """Yield the texels of faces that share a picture, tile by tile; a face seen from its back has texels, too.

    Args:
        atlas: of the template.
        faces: which faces lie in the picture.
        size: texels a side.
    """
    chosen = np.flatnonzero(faces)
    places = np.pad(atlas.uv[atlas.face_uv[chosen]].reshape(-1, 2) * size, ((0, 0), (0, 1)), constant_values=1.0)
    corners = np.arange(len(places)).reshape(-1, 3)
    low = places[:, :2].reshape(-1, 3, 2).min(axis=1)
    high = places[:, :2].reshape(-1, 3, 2).max(axis=1)
    # Texels a side of the tiles in which pictures are made, which bounds the memory: 512 x 512 take 80 MB at most.
    tile = 512
    for top in range(0, size, tile):
        for left in range(0, size, tile):
            side = min(tile, size)
            # A parallel view whose pixels are the texels of the tile.
            K = np.array([[1.0, 0, -left], [0, 1.0, -top], [0, 0, 1]])
            camera = Camera(K, np.eye(4), side, side, orthographic=True)
            near = np.flatnonzero(((high > [left, top]) & (low < [left + side, top + side])).all(axis=1))
            maps = rasterize_triangles(places, corners[near], camera)
            row, column = np.nonzero(maps.mask)
            face = chosen[near[maps.face_id[row, column]]]
            yield Texels(row + top, column + left, face, maps.barycentric[row, column].astype(np.float64))


def texture_stretch(atlas: Atlas, mesh: TriangleMesh) -> tuple[float, float]:
    """Return the stretch of a parametrisation (Sander et al. 2001), L2 over the surface, and L-infinity.

    Each face's map from the picture to the surface has the singular values S >= s. L2 is the root of the mean of
    (S^2 + s^2) / 2 over the surface, L-infinity the largest S, both over the root of area by flat area, so that 1 is
    a map without stretch. Faces without an area in the picture are counted as lost elsewhere and left out here.

    Args:
        atlas: of the template.
        mesh: body and parts in the T-pose.
    """
    a, b = _edges(atlas.uv, atlas.face_uv)
    flat = _cross(a, b)
    solid = (np.abs(flat) > 1e-14) & (mesh.face_areas > 0)
    edges = mesh.triangles[solid][:, 1:] - mesh.triangles[solid][:, :1]
    # J = edges of the face times the inverse of its edges in the picture; S and s from the entries of J^T J.
    inverse = np.stack([b[:, 1], -a[:, 1], -b[:, 0], a[:, 0]], 1)[solid].reshape(-1, 2, 2) / flat[solid, None, None]
    ss, st = (np.einsum("fi,fid->fd", inverse[:, k], edges) for k in (0, 1))
    p, q, r = (np.einsum("fd,fd->f", x, y) for x, y in ((ss, ss), (ss, st), (st, st)))
    area, flat_area = mesh.face_areas[solid], 0.5 * np.abs(flat[solid])
    scale = np.sqrt(area.sum() / flat_area.sum())
    largest = np.sqrt(0.5 * (p + r + np.sqrt((p - r) ** 2 + 4 * q**2)))
    l2 = np.sqrt((0.5 * (p + r) * area).sum() / area.sum())
    return float(l2 / scale), float(largest.max(initial=0.0) / scale)


def _edges(uv: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    corners = uv[rows]
    return corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
