"""Pushing an outer layer out of the inner ones: smoothly, and no further than needed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.sparse import coo_matrix, csr_matrix, diags

from smplxpp.assemble.layers import TOUCHING, Obstacle, face_centers
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.validation import require_at_least, require_between


@dataclass(frozen=True)
class PushConfig:
    """How `push_out` moves a layer.

    Attributes:
        clearance: metres that every vertex keeps from the body, and from a garment that it had come through. Cloth
            closer to a garment without cutting into it (two parts of one scan meet at their seam) keeps what it has.
        damping: share of a displacement lost at each ring of vertices around a push; the smaller, the wider and
            gentler the bulge.
        iterations: smoothing steps.
        max_depth: see `Obstacle`.
        reach: metres, the least and the most that a part's stand-off may let it be pushed.
    """

    clearance: float = 1e-3
    damping: float = 0.25
    iterations: int = 20
    max_depth: float = 0.015
    reach: tuple[float, float] = (0.010, 0.030)

    def __post_init__(self) -> None:
        require_at_least("push configuration: max_depth in metres", self.max_depth, 1e-4)
        require_between("push configuration: clearance in metres", self.clearance, 1e-4, self.max_depth)
        require_between("push configuration: damping", self.damping, 0.0, 1.0)
        require_at_least("push configuration: iterations", self.iterations, 0)
        require_between("push configuration: least reach in metres", self.reach[0], self.clearance, self.reach[1])


# Projections alone, after the smoothing, until nothing is left inside.
_FINAL_PROJECTIONS = 30
# Rounds of smoothing around faces that a push has turned over, and steps in each.
_UNFLIP_ROUNDS, _UNFLIP_STEPS = 8, 4
# A push must not lead to the far side of a limb: the way out and the vertex's own outside make less than this angle.
_FACING_COSINE = -0.2
# Centres of faces keep this share of the clearance: a chord runs below its arc.
_CENTER_SHARE = 0.5
# Of the distances of a part's vertices to the body: what it stands off.
STAND_OFF_PERCENTILE = 95.0
# Metres nearer than the clearance that need no push, if they do not lead inside.
_TOLERANCE = 1e-5


def push_out(
    mesh: TriangleMesh, obstacles: list[Obstacle], config: PushConfig | None = None, *, limit: float = np.inf
) -> Float64[np.ndarray, "N 3"]:
    """New vertex positions of an outer layer, out of all obstacles.

    Solves an obstacle problem by projected Jacobi steps: the displacement d of each vertex goes to
    (1 - damping) x the mean of its neighbours', then every vertex that is nearer to an obstacle than the clearance
    moves there along the gradient of the signed distance. So vertices away from any contact keep their place, and those
    around one follow it without a spike. Centres of faces must not be inside either; their push goes to the corners.

    Args:
        mesh: N vertices, metres.
        obstacles: the inner layers.
        config: clearance and smoothness.
        limit: metres that no vertex is moved beyond (see `stand_off`). One that would need more goes as far and stays
            inside, so that the surface has no cliff between it and its neighbours.

    Returns:
        (N, 3) float64; the input where nothing is too near.
    """
    config = config or PushConfig()
    walls = [_Wall(obstacle, mesh, config.clearance) for obstacle in obstacles]
    mean = _neighbour_mean(mesh)
    d = _project(mesh, np.zeros_like(mesh.vertices), walls, limit)
    for _ in range(config.iterations):
        d = _project(mesh, (1.0 - config.damping) * (mean @ d), walls, limit)
    d = _clear(mesh, d, walls, limit)
    return mesh.vertices + _turn_back(mesh, d, walls, mean, limit)


def stand_off(mesh: TriangleMesh, body: Obstacle, config: PushConfig | None = None) -> float:
    """How far a part stands off the body, metres: what a push of it may be, and not more.

    A vertex inside the body is off by what a fit is off there. A garment that hangs 15 mm off the body came to be
    inside it through an error of some 15 mm; where a repair would need three times that, the body is not where the scan
    shows it, and a push would shape the garment after a wrong body. The 95th percentile of the vertices' signed
    distances, within `config.reach`.
    """
    low, high = (config or PushConfig()).reach
    distance = body.distance(mesh.vertices, mesh.vertex_normals)[0]
    return float(np.clip(np.percentile(np.minimum(distance, high), STAND_OFF_PERCENTILE), low, high))


def _turn_back(mesh: TriangleMesh, d: np.ndarray, walls: list[_Wall], mean: csr_matrix, limit: float) -> np.ndarray:
    """Share the displacement in a growing neighbourhood of faces that turned over; the best of all rounds."""
    near = np.zeros(mesh.vertex_count, dtype=bool)
    turned = turned_faces(mesh, mesh.vertices + d)
    best, fewest = d, int(turned.sum())
    for _ in range(_UNFLIP_ROUNDS):
        if not fewest:
            break
        near[mesh.faces[turned]] = True
        near |= (mean @ near) > 0
        for _ in range(_UNFLIP_STEPS):
            d = np.where(near[:, None], mean @ d, d)
        d = _clear(mesh, d, walls, limit)
        turned = turned_faces(mesh, mesh.vertices + d)
        if turned.sum() < fewest:
            best, fewest = d, int(turned.sum())
    return _carry_whole(mesh, best, walls, limit) if fewest else best


def _carry_whole(mesh: TriangleMesh, d: np.ndarray, walls: list[_Wall], limit: float) -> np.ndarray:
    """Carry faces that are still turned over as a whole, by the longest way of their corners; the best of all rounds.

    A sliver turns when one of its corners goes further than it is high, however gently the others follow.
    """
    turned = turned_faces(mesh, mesh.vertices + d)
    best, fewest = d, int(turned.sum())
    for _ in range(_UNFLIP_ROUNDS):
        corners = mesh.faces[turned]
        longest = np.linalg.norm(d[corners], axis=-1).argmax(axis=1)
        d = d.copy()
        d[corners] = d[corners[np.arange(len(corners)), longest]][:, None]
        d = _clear(mesh, d, walls, limit)
        turned = turned_faces(mesh, mesh.vertices + d)
        if turned.sum() < fewest:
            best, fewest = d, int(turned.sum())
        if not fewest:
            break
    return best


def turned_faces(mesh: TriangleMesh, vertices: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " M"]:
    """The faces whose normal has turned by more than 90 degrees on the new vertices."""
    return np.einsum("ij,ij->i", mesh.face_cross, mesh.with_vertices(vertices).face_cross) < 0


class _Wall:
    """One obstacle as seen from one layer: signed distance where the layer began bounds it where it is now."""

    def __init__(self, obstacle: Obstacle, mesh: TriangleMesh, clearance: float) -> None:
        self._obstacle, self._mesh = obstacle, mesh
        self._centers = face_centers(mesh, mesh.vertices)
        self._vertex_start, self._center_start = (obstacle.lower_bound(x) for x in (mesh.vertices, self._centers))
        self._vertex_clearance = obstacle.clearance(mesh.vertices, mesh.vertex_normals, clearance)
        self._center_clearance = obstacle.clearance(self._centers, mesh.face_normals, _CENTER_SHARE * clearance)

    def vertex_push(self, d: np.ndarray, facing: TriangleMesh | None) -> tuple[np.ndarray, np.ndarray]:
        """(n,) vertices displaced by d (N, 3) that are too near, and (n, 3) what brings them to their clearance."""
        normals = (facing or self._mesh).vertex_normals
        start, clearance = self._vertex_start, self._vertex_clearance
        return self._push(self._mesh.vertices, d, normals, start, clearance, facing is None)

    def center_push(self, d: np.ndarray, facing: TriangleMesh | None) -> tuple[np.ndarray, np.ndarray]:
        """(m,) faces whose centres are too near, and (m, 3) what brings those clear."""
        normals, moved = (facing or self._mesh).face_normals, face_centers(self._mesh, d)
        return self._push(self._centers, moved, normals, self._center_start, self._center_clearance, facing is None)

    def _push(self, origin, moved, normals, start, clearance, facing_only):
        # A signed distance changes by no more than the way travelled: the rest need not be asked again.
        ask = np.flatnonzero(start - np.sqrt(np.einsum("ij,ij->i", moved, moved)) < clearance)
        distance, gradient = self._obstacle.distance(origin[ask] + moved[ask], normals[ask])
        missing = clearance[ask] - distance
        near = (missing > _TOLERANCE) | (distance < -TOUCHING)
        if facing_only:
            near &= np.einsum("ij,ij->i", gradient, normals[ask]) > _FACING_COSINE
        return ask[near], missing[near, None] * gradient[near]


def _project(
    mesh: TriangleMesh, d: np.ndarray, walls: list[_Wall], limit: float, *, facing: TriangleMesh | None = None
) -> np.ndarray:
    """One round of pushes up to `limit`; without `facing` only those that do not lead to the far side of a limb."""
    d = d.copy()
    for wall in walls:
        vertices, push = wall.vertex_push(d, facing)
        d[vertices] += push
        faces, push = wall.center_push(d, facing)
        corners = mesh.faces[faces].ravel()
        count = np.bincount(corners, minlength=len(d))
        for axis in range(3):
            total = np.bincount(corners, np.repeat(push[:, axis], 3), minlength=len(d))
            d[:, axis] += total / np.maximum(count, 1)
    way = np.sqrt(np.einsum("ij,ij->i", d, d))
    far = way > limit
    d[far] *= (limit / way[far])[:, None]
    return d


def _clear(mesh: TriangleMesh, d: np.ndarray, walls: list[_Wall], limit: float) -> np.ndarray:
    for _ in range(_FINAL_PROJECTIONS):
        # The normals decide what counts as behind a garment: take those of the surface as it lies now.
        moved = _project(mesh, d, walls, limit, facing=mesh.with_vertices(mesh.vertices + d))
        if np.array_equal(moved, d):
            break
        d = moved
    return d


def _neighbour_mean(mesh: TriangleMesh) -> csr_matrix:
    """(N, N) rows average a vertex's neighbours; zero rows where there are none."""
    edges = mesh.edges
    ones = np.ones(2 * len(edges))
    pairs = np.concatenate([edges, edges[:, ::-1]])
    adjacency = coo_matrix((ones, pairs.T), shape=(mesh.vertex_count,) * 2).tocsr()
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    return diags(1.0 / np.maximum(degree, 1)) @ adjacency
