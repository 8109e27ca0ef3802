"""Compute how skin lies bare where a player takes clothes off: places, colours and scales of its Gaussians."""

from __future__ import annotations

from collections.abc import Mapping

import igl
import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from avatar.export.bundle_numbers import Tensors
from avatar.gaussians.frames import triangle_frames
from smplxpp.core import HAIR, TriangleMesh, normalize_rows, row_lengths
from smplxpp.raster import hiding_parts
from smplxpp.template.mouth import inside_of_mouth
from smplxpp.template.template import Template


def bare_skin(template: Template, gaussians: Mapping[str, np.ndarray]) -> Tensors:
    """Return the tensors of a bundle that lay skin bare; none where no clothes hide skin that is seen elsewhere.

    Trained under clothes, Gaussians of skin fill the gaps between the clothes' own: they have their colours, and stand
    off the skin. Bare, they are opaque discs on the skin, spread evenly over it, each as wide as the skin that is
    nearest to it, with the colour of seen skin nearby.

    Args:
        template: the person at rest.
        gaussians: `face_index`, `barycentric`, `offset` (the one along the normal included), `log_scales`, `dc` and
            `opacities` of N Gaussians.

    Returns:
        `covered` (N,): the part that hides each, 0 for one that shows. `bare_offset` (N, 3), metres in the triangle's
        frame, `bare_quats` (N, 4), `bare_scale` (N,), mean edges of the triangle, and `bare_dc` (N, 3), sRGB: what
        they are when that part is taken off; of one that shows they mean nothing.
    """
    face, mesh = gaussians["face_index"], template.mesh
    corners = np.concatenate([gaussians["barycentric"], 1.0 - gaussians["barycentric"].sum(axis=1, keepdims=True)], 1)
    places = np.einsum("nk,nkc->nc", corners.astype(np.float64), mesh.triangles[face])
    skin, hidden, covered = _covered(template, gaussians)
    rows, shown = np.flatnonzero(covered), np.flatnonzero(skin[face] & (covered == 0))
    known = _usual(gaussians["dc"], shown[gaussians["opacities"][shown] > 0.5])
    if not len(rows) or not len(known):
        return {}
    # Spread the covered ones over all hidden faces, of which some have none.
    hidden[face[rows]] = True
    samples = _Samples.of(mesh, np.flatnonzero(hidden))
    laid, radius = _spread(places[rows], places[shown], samples)
    normals = samples.normals[samples.tree.query(laid)[1]]
    # In the frames of their triangles, a half turn of e_x onto the normal n: q ~ (1 + n_x, e_x x n).
    frames = triangle_frames(torch.tensor(mesh.vertices), torch.tensor(mesh.faces[face[rows]]))
    moved, n = (np.einsum("nij,ni->nj", frames.rotations.numpy(), one) for one in (laid - places[rows], normals))
    turn = np.stack([1.0 + n[:, 0], np.zeros(len(n)), -n[:, 2], n[:, 1]], axis=1)
    turn[row_lengths(turn) < 0.1] = (0.0, 0.0, 1.0, 0.0)  # a normal turned round
    out: Tensors = {"covered": covered, "bare_offset": np.zeros((len(face), 3)), "bare_dc": np.zeros((len(face), 3))}
    out |= {"bare_quats": np.eye(4)[np.zeros(len(face), dtype=np.int64)], "bare_scale": np.ones(len(face))}
    out["bare_offset"][rows], out["bare_quats"][rows] = moved, normalize_rows(turn)
    out["bare_scale"][rows] = radius / frames.lengths.numpy()
    out["bare_dc"][rows] = _colors_nearby(laid, places[known], gaussians["dc"][known].astype(np.float64))
    return out


def _covered(
    template: Template, gaussians: Mapping[str, np.ndarray]
) -> tuple[Bool[np.ndarray, " F"], Bool[np.ndarray, " F"], Int64[np.ndarray, " N"]]:
    """Return which faces are outer skin, which of the skin are hidden, and the part that hides each Gaussian, 0: none.

    A part hides skin that it lies before in most views. Skin close below clothes counts as hidden, too, because poses
    and hems are not exact, and so does a Gaussian near clothes that stands off its skin: it draws their hem.
    """
    near, around, off = 0.03, 0.15, 0.012  # metres below clothes; metres to a hem; metres off the skin
    faces, mesh, face = template.faces, template.mesh, gaussians["face_index"]
    part = template.vertex_part[faces[:, 0]].astype(np.int64)
    outer = template.vertex_part == 0
    outer[: template.body.vertex_count] &= template.body.outer_skin
    skin = outer[faces].all(axis=1) & ~inside_of_mouth(template)[faces].any(axis=1)
    hiding = hiding_parts(mesh, part)
    # Hair is left out of what is near: a face beside it keeps its own Gaussians where hair is taken off.
    hair = (template.labels.kind_ids(template.vertex_labels) == HAIR.id)[faces[:, 0]]
    worn = np.flatnonzero((part > 0) & ~hair)
    if not len(worn):
        return skin, hiding > 0, hiding[face]
    tree = igl.AABB()
    tree.init(mesh.vertices, faces[worn])
    squared, nearest, at = tree.squared_distance(mesh.vertices, faces[worn], mesh.face_centers)
    apart = np.sqrt(np.asarray(squared).reshape(-1))
    nearest = part[worn[np.asarray(nearest).reshape(-1)]]
    outwards = np.einsum("nc,nc->n", at - mesh.face_centers, mesh.face_normals) > 0.3 * apart
    below = skin & outwards & (apart < near)
    # The normal is the first axis of a triangle's frame: two standard deviations along it beside the centre's height.
    edges = row_lengths((mesh.triangles - np.roll(mesh.triangles, 1, axis=1)).reshape(-1, 3)).reshape(-1, 3).mean(1)
    wide = np.exp(gaussians["log_scales"]) * edges[face][:, None]
    w, x, y, z = (gaussians["quats"] / row_lengths(gaussians["quats"])[:, None]).T
    height = 2.0 * np.hypot(2.0 * (x * y - w * z) * wide[:, 0], 2.0 * (x * z + w * y) * wide[:, 1])
    hem = (skin & (apart < around))[face] & (np.abs(gaussians["offset"][:, 0]) + height > off)
    hiding = np.where(below & (hiding == 0), nearest, hiding)
    return skin, hiding > 0, np.where(hem & (hiding[face] == 0), nearest[face], hiding[face])


class _Samples:
    """Points on faces, metres, with the area that each stands for, its normal, and a tree of them."""

    steps = 4  # along an edge: three points for a Gaussian of usual students

    def __init__(self, points: np.ndarray, areas: np.ndarray, normals: np.ndarray) -> None:
        self.points, self.areas, self.normals, self.tree = points, areas, normals, cKDTree(points)
        self.apart = float(np.sqrt(areas.mean()))

    @staticmethod
    def of(mesh: TriangleMesh, faces: Int64[np.ndarray, " K"]) -> _Samples:
        n = _Samples.steps
        grid = np.array([(i, j, n - 1 - i - j) for i in range(n) for j in range(n - i)]) + 1.0 / 3.0
        corner = mesh.faces[faces]
        points, normals = (np.einsum("gk,fkc->fgc", grid / n, x[corner]) for x in (mesh.vertices, mesh.vertex_normals))
        areas = np.repeat(mesh.face_areas[faces] / len(grid), len(grid))
        return _Samples(points.reshape(-1, 3), areas, normalize_rows(normals.reshape(-1, 3)))


def _spread(
    own: Float64[np.ndarray, "B 3"], fixed: Float64[np.ndarray, "K 3"], samples: _Samples
) -> tuple[Float64[np.ndarray, "B 3"], Float64[np.ndarray, " B"]]:
    """Spread points evenly over a surface beside fixed ones (Lloyd's iteration), and return a width for each.

    A point stays within 3 cm of its own place, because it moves with its triangle. Its width is the distance of the
    farthest sample that is nearest to it, in standard deviations that leave no gaps between discs.
    """
    rounds, farthest, share = 12, 0.03, 0.85
    places, count = own.copy(), len(own)
    for step in range(rounds + 1):
        apart, nearest = cKDTree(np.concatenate([places, fixed])).query(samples.points)
        mine = nearest < count
        nearest, apart = nearest[mine], apart[mine]
        if step == rounds:
            break
        # To the middle of the samples that are nearest to it, and half as far again, which converges faster.
        areas = np.bincount(nearest, samples.areas[mine], count)
        sums = [np.bincount(nearest, samples.areas[mine] * x[mine], count) for x in samples.points.T]
        has = areas > 0
        places[has] += 1.5 * (np.stack(sums, axis=1)[has] / areas[has, None] - places[has])
        moved = places - own
        places = own + moved * np.minimum(1.0, farthest / np.maximum(row_lengths(moved), 1e-9))[:, None]
        places = samples.points[samples.tree.query(places)[1]]
    radius = np.zeros(count)
    np.maximum.at(radius, nearest, apart)
    return places, share * (radius + 0.5 * samples.apart)


def _usual(colors: np.ndarray, rows: Int64[np.ndarray, " K"]) -> Int64[np.ndarray, " R"]:
    """Return the rows whose colours are those of most: without lips, brows and stains of clothes."""
    most = 2.5  # of the median distance to the median colour
    apart = row_lengths(colors[rows].astype(np.float64) - np.median(colors[rows], axis=0)) if len(rows) else np.zeros(0)
    return rows[apart <= most * np.median(apart)] if len(rows) else rows


def _colors_nearby(
    places: Float64[np.ndarray, "B 3"], known: Float64[np.ndarray, "R 3"], colors: Float64[np.ndarray, "R 3"]
) -> Float64[np.ndarray, "B 3"]:
    """Return the mean of known colours about each place, weighted by distance ^ -3: so many show no borders."""
    blended = 256
    apart, nearest = cKDTree(known).query(places, k=range(1, min(blended, len(known)) + 1))
    weight = np.maximum(apart, 1e-4) ** -3.0
    return np.einsum("bk,bkc->bc", weight, colors[nearest]) / weight.sum(axis=1, keepdims=True)
