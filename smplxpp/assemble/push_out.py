"""Push an outer layer out of the inner ones with the smallest smooth displacement (an obstacle problem).

The displacement d of the vertices is sought that is smooth along the layer and satisfies the constraint

    signed distance(x + d) >= clearance        at vertices, and at half the clearance at points on faces

It is solved by projected Jacobi steps: one step of a damped Laplacian smoothing, then a projection of each vertex that
violates the constraint along the gradient of the signed distance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float64
from scipy.sparse import coo_matrix, csr_matrix, diags

from smplxpp.assemble.layers import TOUCHING, Obstacle, face_points
from smplxpp.core import TriangleMesh, require_at_least, require_between


@dataclass(frozen=True)
class PushConfig:
    """Options of pushing layers out with `push_out`.

    Attributes:
        clearance: distance, metres, that every vertex keeps from the body, and from a garment that it had penetrated.
            Cloth closer to a garment without penetrating it (two parts of one scan meet at their seam) keeps its
            distance.
        damping: share of a displacement lost at each ring of vertices around a push; the smaller, the wider and
            gentler the bulge.
        iterations: number of smoothing steps.
        max_depth: depth of penetration, metres, as `Obstacle` has it.
        spacing: longest edge, metres, of a face that keeps its distance at its centre alone (`face_points`).
        reach: bounds of a part's stand-off (`stand_off`), metres, which limits its push.
    """

    clearance: float = 1e-3
    damping: float = 0.25
    iterations: int = 20
    max_depth: float = 0.015
    spacing: float = 0.016
    reach: tuple[float, float] = (0.010, 0.030)

    def __post_init__(self) -> None:
        require_at_least("push configuration: max_depth in metres", self.max_depth, 1e-4)
        require_between("push configuration: clearance in metres", self.clearance, 1e-4, self.max_depth)
        require_between("push configuration: damping", self.damping, 0.0, 1.0)
        require_at_least("push configuration: iterations", self.iterations, 0)
        require_between("push configuration: least reach in metres", self.reach[0], self.clearance, self.reach[1])


# Rounds in which faces that a push has flipped are repaired; most need one or two.
_UNFLIP_ROUNDS = 8


def push_out(
    mesh: TriangleMesh, obstacles: list[Obstacle], config: PushConfig | None = None, *, limit: float = np.inf
) -> Float64[np.ndarray, "N 3"]:
    """Return the vertex positions of an outer layer, pushed out of all obstacles.

    The displacement of each vertex becomes (1 - damping) x the mean of its neighbours', then every vertex nearer to an
    obstacle than the clearance moves out along the gradient of the signed distance. Vertices away from any contact keep
    their place, and those around one follow it without a spike. A point on a face that is too near moves its corners.

    Args:
        mesh: N vertices, metres.
        obstacles: the inner layers.
        config: clearance and smoothness.
        limit: largest displacement, metres (`stand_off`). A vertex that would need more moves so far and stays inside,
            so that the surface has no step between it and its neighbours.

    Returns:
        (N, 3) float64; the input if nothing is too near.
    """
    config = config or PushConfig()
    out = _pushed(mesh, obstacles, config, limit)
    turned = int(flipped_faces(mesh, out).sum())
    if turned and np.isfinite(config.spacing):
        # Points between the corners may turn faces over that their centres alone do not.
        other = _pushed(mesh, obstacles, replace(config, spacing=np.inf), limit)
        out = other if flipped_faces(mesh, other).sum() < turned else out
    return out


def _pushed(
    mesh: TriangleMesh, obstacles: list[Obstacle], config: PushConfig, limit: float
) -> Float64[np.ndarray, "N 3"]:
    # Projected Jacobi steps, then projections alone, then repair of flipped faces.
    walls = [_Wall(obstacle, mesh, config) for obstacle in obstacles]
    mean = _neighbour_mean(mesh)
    d = _project(mesh, np.zeros_like(mesh.vertices), walls, limit)
    for _ in range(config.iterations):
        d = _project(mesh, (1.0 - config.damping) * (mean @ d), walls, limit)
    d = _clear(mesh, d, walls, limit)
    return mesh.vertices + _unflip_by_smoothing(mesh, d, walls, mean, limit)


def stand_off(mesh: TriangleMesh, body: Obstacle, config: PushConfig | None = None) -> float:
    """Return the distance of a part from the body, metres, which limits how far it may be pushed.

    A vertex is inside the body by the error of the fit there. A garment that hangs 15 mm off the body penetrates it
    through an error of some 15 mm; if a repair needs three times that, the body is not where the scan shows it, and a
    push would shape the garment after a wrong body. The result is the 95th percentile of the vertices' signed
    distances, clipped to `config.reach`.
    """
    # Distances are capped at the upper bound first, so that a far hem does not count more than that.
    low, high = (config or PushConfig()).reach
    distance = body.distance(mesh.vertices, mesh.vertex_normals)[0]
    return float(np.clip(np.percentile(np.minimum(distance, high), 95.0), low, high))


def _unflip_by_smoothing(
    mesh: TriangleMesh, d: np.ndarray, walls: list[_Wall], mean: csr_matrix, limit: float
) -> np.ndarray:
    """Smooth the displacement in a growing neighbourhood of flipped faces; return the best of all rounds."""
    near = np.zeros(mesh.vertex_count, dtype=bool)
    flipped = flipped_faces(mesh, mesh.vertices + d)
    best, fewest = d, int(flipped.sum())
    for _ in range(_UNFLIP_ROUNDS):
        if not fewest:
            break
        # One ring more in each round, smoothed four times, then projected again.
        near[mesh.faces[flipped]] = True
        near |= (mean @ near) > 0
        for _ in range(4):
            d = np.where(near[:, None], mean @ d, d)
        d = _clear(mesh, d, walls, limit)
        flipped = flipped_faces(mesh, mesh.vertices + d)
        if flipped.sum() < fewest:
            best, fewest = d, int(flipped.sum())
    return _unflip_rigidly(mesh, best, walls, limit) if fewest else best


def _unflip_rigidly(mesh: TriangleMesh, d: np.ndarray, walls: list[_Wall], limit: float) -> np.ndarray:
    """Translate flipped faces rigidly by the longest displacement of their corners; return the best of all rounds.

    A sliver flips if one of its corners moves farther than its height, however smooth the displacement is.
    """
    flipped = flipped_faces(mesh, mesh.vertices + d)
    best, fewest = d, int(flipped.sum())
    for _ in range(_UNFLIP_ROUNDS):
        # All corners of a flipped face take the displacement of the corner that moves farthest.
        corners = mesh.faces[flipped]
        longest = np.linalg.norm(d[corners], axis=-1).argmax(axis=1)
        d = d.copy()
        d[corners] = d[corners[np.arange(len(corners)), longest]][:, None]
        d = _clear(mesh, d, walls, limit)
        flipped = flipped_faces(mesh, mesh.vertices + d)
        if flipped.sum() < fewest:
            best, fewest = d, int(flipped.sum())
        if not fewest:
            break
    return best


def flipped_faces(mesh: TriangleMesh, vertices: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, " M"]:
    """Return the faces whose normal turns by more than 90 degrees on the new vertices."""
    return np.einsum("ij,ij->i", mesh.face_cross, mesh.with_vertices(vertices).face_cross) < 0


class _Wall:
    """The constraints of one obstacle on one layer.

    Signed distances at the start give lower bounds after a displacement, which save most queries.
    """

    def __init__(self, obstacle: Obstacle, mesh: TriangleMesh, config: PushConfig) -> None:
        self._mesh, self._solid, clearance = mesh, obstacle.solid, config.clearance
        self._points = face_points(mesh, spacing=config.spacing)
        self._between = self._points.of(mesh, mesh.vertices)
        # Points on faces keep half the clearance, because a chord runs below its arc.
        self._of_vertices = _Distances(obstacle, mesh.vertices, mesh.vertex_normals, clearance)
        self._of_faces = _Distances(obstacle, self._between, mesh.face_normals[self._points.face], 0.5 * clearance)

    def vertex_push(self, d: np.ndarray, facing: TriangleMesh | None) -> tuple[np.ndarray, np.ndarray]:
        """Return the vertices that are too near after a displacement d (N, 3), and their (n, 3) pushes."""
        normals = self._facing(facing).vertex_normals
        return self._push(self._mesh.vertices, d, normals, self._of_vertices, facing is None)

    def face_push(self, d: np.ndarray, facing: TriangleMesh | None) -> tuple[np.ndarray, np.ndarray]:
        """Return corners (c,) of faces with points that are too near after a displacement d (N, 3), and their pushes.

        The least displacement of the corners that moves a point by p is `p w_k / sum_j w_j^2`.
        """
        normals, moved = self._facing(facing).face_normals[self._points.face], self._points.of(self._mesh, d)
        near, push = self._push(self._between, moved, normals, self._of_faces, facing is None)
        weights = self._points.weights[near]
        share = weights / np.einsum("ij,ij->i", weights, weights)[:, None]
        corners = self._mesh.faces[self._points.face[near]]
        return corners.ravel(), (share[:, :, None] * push[:, None]).reshape(-1, 3)

    def _facing(self, displaced: TriangleMesh | None) -> TriangleMesh:
        """Return the layer whose normals decide; a solid asks for none of a displaced layer, and they take long."""
        return self._mesh if displaced is None or self._solid else displaced

    def _push(self, origin, moved, normals, distances, facing_only):
        # A signed distance changes by at most the length of the displacement, so that most points need no query.
        ask = np.flatnonzero(distances.start - np.sqrt(np.einsum("ij,ij->i", moved, moved)) < distances.clearance)
        distance, gradient = distances.after(ask, origin[ask] + moved[ask], normals[ask])
        missing = distances.clearance[ask] - distance
        # A point outside may miss 10 um of its clearance. A push must not lead to the far side of a limb: its direction
        # and the point's normal have a cosine above -0.2.
        near = (missing > 1e-5) | (distance < -TOUCHING)
        if facing_only:
            near &= np.einsum("ij,ij->i", gradient, normals[ask]) > -0.2
        return ask[near], missing[near, None] * gradient[near]


class _Distances:
    """Signed distances of the moving points of a layer, asked again only of points that have moved or turned.

    A projection moves few of the points that are near an obstacle, and there are hundreds of projections.

    Attributes:
        start: lower bounds of the distances at the start, metres.
        clearance: distances to keep, metres.
    """

    def __init__(self, obstacle: Obstacle, points: np.ndarray, normals: np.ndarray, clearance: float) -> None:
        self._obstacle = obstacle
        self.start, self.clearance = obstacle.lower_bound(points), obstacle.clearance(points, normals, clearance)
        # Place and normal of each point when it was last asked of, NaN before, which equals nothing.
        self._asked = np.full((len(points), 6), np.nan)
        self._distance, self._gradient = np.zeros(len(points)), np.zeros((len(points), 3))

    def after(self, rows: np.ndarray, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the distances (n,) and gradients (n, 3) of the points of some rows at new places."""
        # Only a garment asks which way a point faces.
        now = np.concatenate([points, np.zeros_like(normals) if self._obstacle.solid else normals], axis=1)
        changed = (self._asked[rows] != now).any(axis=1)
        new = rows[changed]
        self._distance[new], self._gradient[new] = self._obstacle.distance(points[changed], normals[changed])
        self._asked[new] = now[changed]
        return self._distance[rows], self._gradient[rows]


def _project(
    mesh: TriangleMesh, d: np.ndarray, walls: list[_Wall], limit: float, *, facing: TriangleMesh | None = None
) -> np.ndarray:
    """Project a displacement onto the constraints once, up to `limit`.

    Args:
        mesh: the layer at its start.
        d: displacement (N, 3).
        walls: the obstacles.
        limit: largest displacement, metres.
        facing: the displaced layer, whose normals decide; None uses the normals at the start, and leaves out pushes
            that lead to the far side of a limb.
    """
    # Vertices move by their own push, and the corners of faces by the mean of theirs.
    d = d.copy()
    for wall in walls:
        vertices, push = wall.vertex_push(d, facing)
        d[vertices] += push
        corners, push = wall.face_push(d, facing)
        count = np.bincount(corners, minlength=len(d))
        for axis in range(3):
            total = np.bincount(corners, push[:, axis], minlength=len(d))
            d[:, axis] += total / np.maximum(count, 1)
    length = np.sqrt(np.einsum("ij,ij->i", d, d))
    far = length > limit
    d[far] *= (limit / length[far])[:, None]
    return d


def _clear(mesh: TriangleMesh, d: np.ndarray, walls: list[_Wall], limit: float) -> np.ndarray:
    """Project until nothing moves, at most 30 times."""
    for _ in range(30):
        # Normals decide what is behind a garment, so that those of the displaced surface are taken.
        moved = _project(mesh, d, walls, limit, facing=mesh.with_vertices(mesh.vertices + d))
        if np.array_equal(moved, d):
            break
        d = moved
    return d


def _neighbour_mean(mesh: TriangleMesh) -> csr_matrix:
    """Return (N, N) rows that average a vertex's neighbours; zero rows where there are none."""
    # The symmetric adjacency matrix, divided by the number of neighbours.
    edges = mesh.edges
    ones = np.ones(2 * len(edges))
    pairs = np.concatenate([edges, edges[:, ::-1]])
    adjacency = coo_matrix((ones, pairs.T), shape=(mesh.vertex_count,) * 2).tocsr()
    degree = np.asarray(adjacency.sum(axis=1)).ravel()
    return diags(1.0 / np.maximum(degree, 1)) @ adjacency
