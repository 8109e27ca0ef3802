"""Scans: bare skin attracts both ways, what covers it stays outside, as far from it as it always is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from smplxpp.core.labels import SKIN
from smplxpp.core.mesh import TriangleMesh
from smplxpp.core.signed_distance import SignedDistanceField, barycentric_coordinates
from smplxpp.register.config import RegisterConfig
from smplxpp.register.gaps import Gaps
from smplxpp.register.kinematics import BodyPoints, Kinematics, Posture
from smplxpp.register.normal_equations import NormalEquations
from smplxpp.register.observations import ScanObservation
from smplxpp.register.robust import geman_mcclure

# Labels in groups: skin, unknown, and each thing that is worn.
_UNKNOWN_GROUP, _GROUPS = 0, 16
_LARGEST_GAP = 0.15
_LEAST_SEEN = 20
# A scan's point and the body's must face the same way for one to be the other: cosine.
_FACING = 0.5


@dataclass(frozen=True, eq=False)
class ScanSample:
    """Points of one scan.

    Attributes:
        points, normals: world. labels: ids, negative where not known. skin: a tree of those that are skin.
    """

    points: Float64[np.ndarray, "N 3"]
    normals: Float64[np.ndarray, "N 3"]
    labels: Int64[np.ndarray, " N"]
    skin: cKDTree | None
    skin_index: Int64[np.ndarray, " S"]

    @staticmethod
    def of(scan: ScanObservation, samples: int, seed: int) -> ScanSample:
        """Vertices drawn by the area about them."""
        mesh = scan.mesh
        area = np.bincount(mesh.faces.ravel(), np.repeat(mesh.face_areas / 3, 3), minlength=mesh.vertex_count)
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
    """Signed distances between scans and the body, along normals, metres.

    For a scan's point p with the body's closest point c, normal n and distance d (negative inside): skin, and the
    body's bare vertices to their nearest skin of the scan: d = 0. All else: d >= 0, and d = gap of its label and limb,
    as far as that gap's spread allows.

    Args:
        body_points: all vertices of the body. bare: which of them are skin for sure.
        scans: by row of the registration.
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
        self.bare_index = np.sort(rng.permutation(index)[: config.scan_samples // 2])
        self.limb = np.argmax(self.body.weights, axis=1)
        self.gaps = Gaps.unknown(_GROUPS * self.body.joint_count)
        self.reach = self.first_reach = config.scan_reach_m
        self._seen: list[tuple[np.ndarray, np.ndarray]] = []

    def add(
        self, equations: NormalEquations, row: int, kinematics: Kinematics, posture: Posture, *, shape: bool
    ) -> None:
        """Add the scan of a frame, if it has one."""
        if row not in self.samples:
            return
        index, weight_of, direction, residual, weight = self._residuals(row, kinematics, posture)
        points = self.body_points.mixed(index, weight_of)
        jacobian = equations.columns.jacobian(kinematics.motion(points, posture))
        rows, root = np.einsum("nx,nxp->np", direction, jacobian, optimize=True), np.sqrt(weight)
        equations.add(row, rows * root[:, None], residual * root, shape=shape)

    def learn(self) -> None:
        """Take the gaps from what was seen since the last time."""
        if self._seen:
            place, distance = (np.concatenate(parts) for parts in zip(*self._seen, strict=True))
            self.gaps = Gaps.learned(
                place, distance, len(self.gaps.median), least=_LEAST_SEEN, tight=self.config.tight_m
            )
        self._seen = []

    def residual_mm(self, row: int, kinematics: Kinematics, posture: Posture) -> tuple[float, float]:
        """Mean distance of the scan's skin to the body, and mean depth of all else within it; NaN without a scan."""
        if row not in self.samples:
            return float("nan"), float("nan")
        sample = self.samples[row]
        field = self._field(kinematics, posture)
        found = field.query(sample.points)
        skin = sample.labels == SKIN.id
        close = float(1e3 * np.abs(found.distance[skin]).mean()) if skin.any() else float("nan")
        inside = float(1e3 * np.maximum(-found.distance[~skin], 0).mean()) if (~skin).any() else float("nan")
        return close, inside

    def _field(self, kinematics: Kinematics, posture: Posture) -> SignedDistanceField:
        mesh = TriangleMesh(kinematics.points(self.body_points, posture), self.body.faces)
        return SignedDistanceField(mesh, solid=True)

    def _residuals(self, row: int, kinematics: Kinematics, posture: Posture) -> tuple[np.ndarray, ...]:
        sample, config = self.samples[row], self.config
        vertices = kinematics.points(self.body_points, posture)
        mesh = TriangleMesh(vertices, self.body.faces)
        found = SignedDistanceField(mesh, solid=True).query(sample.points)
        corners = self.body.faces[found.face]
        bary = barycentric_coordinates(found.closest, mesh.vertices[corners])
        limb = self.limb[corners[np.arange(len(corners)), np.argmax(bary, axis=1)]]
        facing = np.einsum("nx,nx->n", found.normal, sample.normals) > _FACING
        skin = sample.labels == SKIN.id
        group = np.where(sample.labels < 0, _UNKNOWN_GROUP, np.minimum(sample.labels + 1, _GROUPS - 1))
        place = group * self.body.joint_count + limb
        d, gap, spread = found.distance, self.gaps.median[place], self.gaps.spread[place]
        # Moving the body's point outwards lowers the distance: d(d) = -n . dx.
        direction = -found.gradient
        sigma = config.scan_m
        of_skin = facing * geman_mcclure(d, self.reach) / sigma**2
        of_inside = geman_mcclure(d, 3 * self.reach) / sigma**2
        wide = np.hypot(spread, sigma)
        of_gap = np.where(np.isfinite(spread), config.cloth_share * geman_mcclure(d - gap, 2.5 * wide) / wide**2, 0.0)
        inside = ~skin & (d < 0)
        residual = np.where(skin | inside, d, d - gap)
        weight = np.where(skin, of_skin, np.where(inside, of_inside, facing * of_gap))
        learned = ~skin & facing & (d > -0.02) & (d < _LARGEST_GAP)
        self._seen.append((place[learned], d[learned]))
        rows: list[tuple[np.ndarray, ...]] = [(corners, bary, direction, residual, weight / self._crowding(sample))]
        if sample.skin is not None and len(self.bare_index):
            rows.append(self._from_body(sample, mesh))
        corners, bary, direction, residual, weight = (np.concatenate(parts) for parts in zip(*rows, strict=True))
        return corners, bary, direction, residual, weight

    def _crowding(self, sample: ScanSample) -> float:
        """Neighbours on a scan err together: so many of them count as one."""
        return max(1.0, len(sample.points) / 1000.0)

    def _from_body(self, sample: ScanSample, mesh: TriangleMesh) -> tuple[np.ndarray, ...]:
        """The body's bare vertices to the scan's nearest skin, along the scan's normal."""
        assert sample.skin is not None
        vertices, index = mesh.vertices[self.bare_index], self.bare_index
        distance, nearest = sample.skin.query(vertices, distance_upper_bound=self.reach)
        near = np.isfinite(distance)
        index, vertices, nearest = index[near], vertices[near], sample.skin_index[nearest[near]]
        normal = sample.normals[nearest]
        facing = np.einsum("nx,nx->n", mesh.vertex_normals[index], normal) > _FACING
        residual = np.einsum("nx,nx->n", vertices - sample.points[nearest], normal)
        weight = facing * geman_mcclure(residual, self.reach) / self.config.scan_m**2 / self._crowding(sample)
        corners = np.repeat(index[:, None], 3, axis=1)
        bary = np.tile([1.0, 0.0, 0.0], (len(index), 1))
        return corners, bary, normal, residual, weight
