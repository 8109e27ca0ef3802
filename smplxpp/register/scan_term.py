"""Compare scans with the body: skin attracts in both directions, cloth stays outside at its estimated gap.

For a point p of a scan let d be its signed distance to the body (negative inside) along the body's normal. The
residuals and robust weights (GM is the weight of Geman and McClure, s the standard deviation of a scan) are

    skin of the scan         d            GM(d; reach) / s^2
    inside the body          d            GM(d; 3 reach) / s^2                    any label but skin
    cloth outside            d - gap      cloth_share GM(d - gap; 2.5 w) / w^2    w^2 = spread^2 + s^2
    bare vertex v of a body  n . (v - p)  GM(n . (v - p); reach) / s^2            p the nearest skin of the scan, normal
    n

The gap and its spread are estimated for every pair of label and limb (`Gaps`), after every step. Points count only
where scan and body face alike. The weights are divided so that a scan counts as at most 1000 independent points,
because the errors of its neighbouring points are correlated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.core import OBJECT, SKIN, TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField, barycentric_coordinates
from smplxpp.register.clothing import Gaps, in_order_of_frames
from smplxpp.register.kinematics import BodyPoints, Kinematics, Posture
from smplxpp.register.normal_equations import Equations, geman_mcclure
from smplxpp.register.observations import RegisterConfig, ScanObservation

# Labels are grouped for their gaps: 0 is unknown, label k is group k + 1, and the last group takes all further labels.
_GROUPS = 16
# Cosine of the angle between the normals of scan and body, from which a point of one can correspond to the other.
_FACING = 0.5


@dataclass(frozen=True, eq=False)
class ScanSample:
    """Points drawn from the surface of one scan.

    Attributes:
        points: in world coordinates, metres.
        normals: unit vectors.
        labels: ids, negative where unknown.
        skin: a search tree of the points that are skin; None if there are none.
        skin_index: indices of the points in that tree.
    """

    points: Float64[np.ndarray, "N 3"]
    normals: Float64[np.ndarray, "N 3"]
    labels: Int64[np.ndarray, " N"]
    skin: cKDTree | None
    skin_index: Int64[np.ndarray, " S"]

    @staticmethod
    def of(scan: ScanObservation, samples: int, seed: int) -> ScanSample:
        """Draw vertices of a scan with probabilities in proportion to their area, without replacement."""
        mesh = scan.mesh
        # A vertex stands for a third of the area of each of its faces, so that dense regions of a scan count no more
        # than coarse ones. Vertices without any area cannot be drawn.
        area = np.bincount(mesh.faces.ravel(), np.repeat(mesh.face_areas / 3, 3), minlength=mesh.vertex_count)
        # A thing in a hand says nothing about the body.
        if scan.labels is not None and (np.asarray(scan.labels) != OBJECT.id).any():
            area = np.where(np.asarray(scan.labels) == OBJECT.id, 0.0, area)
        rng = np.random.default_rng(seed)
        count = min(samples, int((area > 0).sum()))
        index = np.sort(rng.choice(mesh.vertex_count, count, replace=False, p=area / area.sum()))
        unknown = np.full(mesh.vertex_count, -1)
        labels = (unknown if scan.labels is None else np.asarray(scan.labels, dtype=np.int64))[index]
        skin = np.flatnonzero(labels == SKIN.id)
        points = mesh.vertices[index]
        tree = cKDTree(points[skin]) if len(skin) else None
        return ScanSample(points, mesh.vertex_normals[index], labels, tree, skin)


class ScanTerm:
    """Signed distances between scans and the body, metres; see the module's docstring.

    Args:
        kinematics: of the body.
        body_points: all vertices of the body.
        bare: vertices that are known to be bare skin.
        scans: by row of the registration.
        config: standard deviations and cutoffs.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        body_points: BodyPoints,
        bare: Bool[np.ndarray, " V"],
        scans: Mapping[int, ScanObservation],
        config: RegisterConfig,
    ) -> None:
        self.body, self.body_points, self.config = kinematics.body, body_points, config
        self.samples = {row: ScanSample.of(scan, config.scan_samples, config.seed) for row, scan in scans.items()}
        rng = np.random.default_rng(config.seed)
        index = np.flatnonzero(bare)
        # At most half as many points of the body as of the scan, drawn at random.
        self.bare_index = np.sort(rng.permutation(index)[: config.scan_samples // 2])
        # A vertex belongs to the limb of the joint with its largest skinning weight.
        self.limb = np.argmax(self.body.weights, axis=1)
        self.gaps = Gaps.unknown(_GROUPS * self.body.joint_count)
        self.reach = self.first_reach = config.scan_reach_m
        self._distances: list[tuple[int, np.ndarray, np.ndarray]] = []  # by row

    def add(self, equations: Equations, row: int, kinematics: Kinematics, posture: Posture, *, shape: bool) -> None:
        """Add the scan of one frame, if there is one, to the normal equations."""
        if row not in self.samples:
            return
        index, weight_of, direction, residual, weight = self._residuals(row, kinematics, posture)
        # The closest point is held at its place on its face while the body moves: dd = direction . J dx (point to
        # plane).
        points = self.body_points.mixed(index, weight_of)
        jacobian = equations.columns.jacobian(kinematics.motion(points, posture, equations.columns.joints))
        rows, root = np.einsum("nx,nxp->np", direction, jacobian, optimize=True), np.sqrt(weight)
        equations.add(row, rows * root[:, None], residual * root, shape=shape)

    def estimate_gaps(self) -> None:
        """Estimate the gaps from the distances of the last step; a place needs 20 of them."""
        if self._distances:
            place, distance = in_order_of_frames(self._distances)
            self.gaps = Gaps.estimated(place, distance, len(self.gaps.median), least=20, tight=self.config.tight_m)
        self._distances = []

    def residual_mm(self, row: int, kinematics: Kinematics, posture: Posture) -> tuple[float, float]:
        """Return mean distance of the scan's skin to the body and mean depth of the rest inside it; NaN for none."""
        if row not in self.samples:
            return float("nan"), float("nan")
        sample = self.samples[row]
        mesh = TriangleMesh(kinematics.points(self.body_points, posture), self.body.faces)
        # Skin is compared with the surface on both sides; all other labels only with its inside, where no cloth can be.
        found = SignedDistanceField(mesh, solid=True).query(sample.points)
        skin = sample.labels == SKIN.id
        close = float(1e3 * np.abs(found.distance[skin]).mean()) if skin.any() else float("nan")
        inside = float(1e3 * np.maximum(-found.distance[~skin], 0).mean()) if (~skin).any() else float("nan")
        return close, inside

    def _residuals(self, row: int, kinematics: Kinematics, posture: Posture) -> tuple[np.ndarray, ...]:
        """Return corners, barycentric weights, directions, residuals and weights of all point pairs of a frame."""
        sample, config = self.samples[row], self.config
        # Closest point of the body to every point of the scan, with the limb that it belongs to.
        mesh = TriangleMesh(kinematics.points(self.body_points, posture), self.body.faces)
        found = SignedDistanceField(mesh, solid=True).query(sample.points)
        corners = self.body.faces[found.face]
        bary = barycentric_coordinates(found.closest, mesh.vertices[corners])
        limb = self.limb[corners[np.arange(len(corners)), np.argmax(bary, axis=1)]]
        facing = np.einsum("nx,nx->n", found.normal, sample.normals) > _FACING
        skin = sample.labels == SKIN.id
        # The gap that was estimated for this label on this limb.
        group = np.where(sample.labels < 0, 0, np.minimum(sample.labels + 1, _GROUPS - 1))
        place = group * self.body.joint_count + limb
        d, gap, spread = found.distance, self.gaps.median[place], self.gaps.spread[place]
        # Moving the body's point outwards lowers the distance: dd = -n . dx.
        direction = -found.gradient
        # Robust weights of the three kinds; those of cloth vanish where no gap is known yet.
        sigma = config.scan_m
        of_skin = facing * geman_mcclure(d, self.reach) / sigma**2
        of_inside = geman_mcclure(d, 3 * self.reach) / sigma**2
        wide = np.hypot(spread, sigma)
        of_gap = np.where(np.isfinite(spread), config.cloth_share * geman_mcclure(d - gap, 2.5 * wide) / wide**2, 0.0)
        inside = ~skin & (d < 0)
        residual = np.where(skin | inside, d, d - gap)
        weight = np.where(skin, of_skin, np.where(inside, of_inside, facing * of_gap))
        # Distances from -2 cm to 15 cm enter the next estimate of the gaps; farther ones belong to other things.
        usable = ~skin & facing & (d > -0.02) & (d < 0.15)
        self._distances.append((row, place[usable], d[usable]))
        # The reverse direction: bare vertices of the body to the scan.
        rows: list[tuple[np.ndarray, ...]] = [(corners, bary, direction, residual, weight / self._crowding(sample))]
        if sample.skin is not None and len(self.bare_index):
            rows.append(self._from_body(sample, mesh))
        corners, bary, direction, residual, weight = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        return corners, bary, direction, residual, weight

    def _crowding(self, sample: ScanSample) -> float:
        """Return how many points of the sample count as one, because the errors of neighbours are correlated."""
        return max(1.0, len(sample.points) / 1000.0)

    def _from_body(self, sample: ScanSample, mesh: TriangleMesh) -> tuple[np.ndarray, ...]:
        """Return the same arrays for the body's bare vertices and the nearest skin of the scan, along its normal."""
        assert sample.skin is not None
        vertices, index = mesh.vertices[self.bare_index], self.bare_index
        distance, nearest = sample.skin.query(vertices, distance_upper_bound=self.reach)
        near = np.isfinite(distance)
        index, vertices, nearest = index[near], vertices[near], sample.skin_index[nearest[near]]
        normal = sample.normals[nearest]
        facing = np.einsum("nx,nx->n", mesh.vertex_normals[index], normal) > _FACING
        residual = np.einsum("nx,nx->n", vertices - sample.points[nearest], normal)
        weight = facing * geman_mcclure(residual, self.reach) / self.config.scan_m**2 / self._crowding(sample)
        # A vertex is written as a face with three equal corners, so that both directions have one format.
        corners = np.repeat(index[:, None], 3, axis=1)
        bary = np.tile([1.0, 0.0, 0.0], (len(index), 1))
        return corners, bary, normal, residual, weight
