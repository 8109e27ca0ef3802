"""Operations on meshes with skinning weights: subdivide, clip along a level set, smooth, diffuse, push out."""

from __future__ import annotations

from dataclasses import dataclass, replace

import igl
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_matrix, csr_matrix, diags, identity
from scipy.sparse.linalg import splu

from smplxpp.body import BodyModel
from smplxpp.core.mesh import TriangleMesh, normalize_rows, row_lengths
from smplxpp.core.signed_distance import SignedDistanceField
from smplxpp.core.topology import border_loops


@dataclass(frozen=True, eq=False)
class ClothMesh:
    """A mesh whose vertices carry skinning weights.

    Attributes:
        vertices: metres.
        faces: indices of vertices.
        weights: weight of each joint.
    """

    vertices: Float[np.ndarray, "N 3"]
    faces: Int[np.ndarray, "M 3"]
    weights: Float[np.ndarray, "N J"]

    @property
    def mesh(self) -> TriangleMesh:
        """The geometry alone, without skinning weights."""
        return TriangleMesh(self.vertices, self.faces)

    def with_vertices(self, vertices: Float[np.ndarray, "N 3"]) -> ClothMesh:
        """Return the same faces and weights with other vertices."""
        return replace(self, vertices=vertices)


def outer_faces(body: BodyModel) -> Bool[np.ndarray, " M"]:
    """Return which faces of the body are outer skin, neither eyes nor mouth."""
    return (body.part_labels == body.part_label_names.index("body"))[body.faces].all(axis=1)


def submesh(cloth: ClothMesh, face_mask: Bool[np.ndarray, " M"]) -> ClothMesh:
    """Return the selected faces with the vertices that they use."""
    mesh, used = cloth.mesh.submesh(face_mask)
    return ClothMesh(mesh.vertices, mesh.faces, cloth.weights[used])


def loop_subdivide(cloth: ClothMesh, times: int = 1) -> ClothMesh:
    """Subdivide positions and weights alike (Loop 1987); borders follow their own curve."""
    # Weights are subdivided as further coordinates of the vertices.
    stacked = np.ascontiguousarray(np.hstack([cloth.vertices, cloth.weights]))
    values, faces = igl.loop(stacked, np.ascontiguousarray(cloth.faces, dtype=np.int64), times)
    return ClothMesh(values[:, :3], faces.astype(np.int64), values[:, 3:])


def clip(cloth: ClothMesh, level: Float[np.ndarray, " N"]) -> ClothMesh:
    """Return the part where the piecewise linear `level` is not negative, cut exactly along its zero line."""
    # Vertices very near the line move to the kept side, because they would make slivers.
    level = np.where(np.abs(level) < 1e-3 * np.abs(level).max(), 1e-12, level)
    keep = level >= 0
    faces = cloth.faces
    count = keep[faces].sum(axis=1)
    # Turn each cut face so that its odd corner (the only one kept, or the only one dropped) comes first.
    cut = faces[(count == 1) | (count == 2)]
    odd = np.where(keep[cut].sum(axis=1) == 1, np.argmax(keep[cut], axis=1), np.argmin(keep[cut], axis=1))
    cut = np.take_along_axis(cut, (odd[:, None] + np.arange(3)) % 3, axis=1)

    # One new vertex on each cut edge, by linear interpolation.
    ends = np.sort(np.concatenate([cut[:, [0, 1]], cut[:, [0, 2]]]), axis=1)
    edges, crossing = np.unique(ends, axis=0, return_inverse=True)
    crossing = crossing.reshape(2, -1) + len(level)
    t = (level[edges[:, 0]] / (level[edges[:, 0]] - level[edges[:, 1]]))[:, None]

    def extended(values: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "P D"]:
        return np.concatenate([values, (1 - t) * values[edges[:, 0]] + t * values[edges[:, 1]]])

    # A kept corner leaves one triangle, a dropped one leaves two.
    a, b, c, p, q = cut[:, 0], cut[:, 1], cut[:, 2], crossing[0], crossing[1]
    corner = keep[a]
    new_faces = np.concatenate(
        [
            faces[count == 3],
            np.stack([a, p, q], axis=1)[corner],
            np.stack([p, b, c], axis=1)[~corner],
            np.stack([p, c, q], axis=1)[~corner],
        ]
    )
    whole = ClothMesh(extended(cloth.vertices), new_faces, extended(cloth.weights))
    return submesh(whole, np.ones(len(new_faces), dtype=bool))


def fairing_operator(mesh: TriangleMesh) -> csr_matrix:
    """Return the (N, N) mean over neighbours; of border vertices over border neighbours, so that hems stay smooth."""
    n = mesh.vertex_count
    border = np.zeros(n, dtype=bool)
    border[mesh.border_edges] = True
    edges = mesh.edges
    inner = edges[~border[edges].any(axis=1)]
    mixed = edges[border[edges].sum(axis=1) == 1]
    mixed = np.where(border[mixed[:, :1]], mixed[:, ::-1], mixed)  # interior end first
    rows = np.concatenate([inner[:, 0], inner[:, 1], mixed[:, 0], *mesh.border_edges.T])
    columns = np.concatenate([inner[:, 1], inner[:, 0], mixed[:, 1], *mesh.border_edges.T[::-1]])
    adjacency = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(n, n)).tocsr()
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    return diags(1.0 / np.maximum(degree, 1)) @ adjacency + diags((degree == 0).astype(float))


def smooth(mesh: TriangleMesh, values: Float[np.ndarray, "N D"], *, steps: int) -> Float[np.ndarray, "N D"]:
    """Return vertex values moved `steps` times halfway to the mean of their neighbours (Laplacian smoothing)."""
    operator = fairing_operator(mesh)
    for _ in range(steps):
        values = 0.5 * (values + operator @ values)
    return values


def diffuse(mesh: TriangleMesh, values: Float[np.ndarray, "N D"], *, radius: float) -> Float[np.ndarray, "N D"]:
    """Return vertex values diffused implicitly over about `radius` metres: `(M + radius^2 L) x = M x0`."""
    # One implicit Euler step of the heat equation, with the cotangent Laplacian.
    laplacian = -igl.cotmatrix(mesh.vertices, mesh.faces)
    mass = igl.massmatrix(mesh.vertices, mesh.faces, igl.MASSMATRIX_TYPE_BARYCENTRIC)
    mass = mass + 1e-12 * identity(mesh.vertex_count)
    return splu((mass + radius**2 * laplacian).tocsc()).solve(mass @ values)


def lift_outside(
    mesh: TriangleMesh, inner: TriangleMesh, *, clearance: float, solid: bool, reach: float = 0.04
) -> Float[np.ndarray, "N 3"]:
    """Return the vertices moved at least `clearance` metres outside `inner`, in rounds of less and less smoothed moves.

    Vertices deeper than `reach`, or whose closest point is on the border of a sheet, stay, because the sign of the
    distance is unreliable there.

    Args:
        mesh: the cloth.
        inner: a closed body or an open sheet.
        clearance: least distance, metres.
        solid: whether `inner` is closed.
        reach: largest depth of vertices that are moved, metres.
    """
    field = SignedDistanceField(inner, solid=solid)
    vertices = mesh.vertices
    # Early rounds move wide areas at once, the last one exactly the vertices that lack clearance.
    for smoothing in (4, 4, 4, 2, 1, 0):
        where = field.query(vertices)
        known = (solid | ~where.on_border) & (where.distance > -reach)
        missing = np.where(known, np.clip(clearance - where.distance, 0.0, None), 0.0)[:, None]
        if not missing.any():
            break
        # Each vertex moves at least as far as it has to, along a smoothed gradient of the distance.
        widened = np.maximum(smooth(mesh, missing, steps=smoothing), missing)
        vertices = vertices + widened * normalize_rows(smooth(mesh, where.gradient, steps=smoothing))
    return vertices


def lowest_loop(mesh: TriangleMesh) -> Int[np.ndarray, " L"]:
    """Return the border loop that hangs lowest: of a skirt its hem."""
    return min(border_loops(mesh.faces), key=lambda loop: float(mesh.vertices[loop, 1].mean()))


def lengthened(skirt: ClothMesh, hem: float, centre_z: float) -> ClothMesh:
    """Return a skirt in the T-pose that continues below its hem with the same flare, its folds opening further.

    Rows of new vertices lie as far apart as the old ones do, with the weights of the old hem above them.

    Args:
        skirt: its vertices and faces stay as they are.
        hem: height of the new hem, metres.
        centre_z: depth of the skirt's axis.
    """
    mesh, loop = skirt.mesh, lowest_loop(skirt.mesh)
    offsets = skirt.vertices - [0.0, 0.0, centre_z]
    angle, radius, y = np.arctan2(offsets[:, 0], offsets[:, 2]), np.hypot(offsets[:, 0], offsets[:, 2]), offsets[:, 1]
    # The flare by angle: the slope of a line through the 20 cm above the hem, near each vertex of it.
    low = y < y[loop].mean() + 0.2
    near = np.exp(-((_turned(angle[loop, None] - angle[low]) / 0.06) ** 2))
    near /= near.sum(axis=1, keepdims=True)
    middle = near @ y[low]
    away = y[low] - middle[:, None]
    flare = (near * away * radius[low]).sum(axis=1) / (near * away**2).sum(axis=1)

    edge = float(np.median(row_lengths(np.diff(skirt.vertices[mesh.edges], axis=1)[:, 0])))
    depth = float(y[loop].mean()) - hem
    rows = int(np.ceil(depth / (edge * np.sqrt(0.75))))
    steps = row_lengths(np.roll(offsets[loop], -1, axis=0) - offsets[loop])
    columns = int(np.ceil(steps.sum() / edge * (1.0 - depth * flare.mean() / radius[loop].mean())))
    # Rows are staggered, which makes even triangles; shares of the loop's length tell where their vertices are.
    above, share = loop, np.append(0.0, np.cumsum(steps))[:-1] / steps.sum()
    ends = np.append(share, 1.0)
    vertices, weights, faces, count = [skirt.vertices], [skirt.weights], [skirt.faces], len(skirt.vertices)

    def along(values: Float[np.ndarray, "L _"], at: Float[np.ndarray, " C"]) -> Float[np.ndarray, "C _"]:
        closed = np.concatenate([values, values[:1]])
        return np.stack([np.interp(at, ends, column) for column in closed.T], axis=1)

    for row in range(1, rows + 1):
        at = (np.arange(columns) + 0.5 * (row % 2)) / columns
        drop = depth * row / rows
        sideways = offsets[loop][:, [0, 2]]
        reach = 1.0 - (drop * flare / radius[loop])[:, None]
        x, z = along(sideways * reach, at).T
        height = along(offsets[loop, 1:2], at)[:, 0] - drop
        vertices.append(np.stack([x, height, z + centre_z], axis=1))
        weights.append(along(skirt.weights[loop], at))
        below = count + np.arange(columns)
        faces.append(_between(above, share, below, at))
        above, share, count = below, at, count + columns
    return ClothMesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(weights))


def _turned(angle: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N"]:
    """Return angles between -pi and pi."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def _between(
    above: Int[np.ndarray, " A"],
    at_above: Float[np.ndarray, " A"],
    below: Int[np.ndarray, " B"],
    at_below: Float[np.ndarray, " B"],
) -> Int[np.ndarray, "M 3"]:
    """Return the faces between two closed rows, whose vertices lie at shares of one turn, in one direction."""
    faces, i, j = [], 0, 0
    upper, lower = np.append(at_above, at_above[0] + 1.0), np.append(at_below, at_below[0] + 1.0)
    while i < len(above) or j < len(below):
        a, b = above[i % len(above)], below[j % len(below)]
        # Of the two next edges the one whose middle comes first.
        if j == len(below) or (i < len(above) and upper[i] + upper[i + 1] < lower[j] + lower[j + 1]):
            i += 1
            faces.append((above[i % len(above)], a, b))
        else:
            j += 1
            faces.append((a, b, below[j % len(below)]))
    return np.array(faces)
