"""Measure on a scan's surface what tells clothes without colours: hems, folds, shoes, what goes round both legs.

A hem is where cloth ends over skin or over other cloth: within a centimetre or two the surface comes nearer to the
body by the cloth's thickness and play, on all sides of the limb. Folds, pockets and muscles make such steps on one
side alone, and the misfit of the body changes slowly along a limb. So the step is measured in sectors about the limb,
above the slopes beside it, and the median over the sectors counts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import maximum_filter1d
from scipy.spatial import cKDTree

from smplxpp.body import BodyModel
from smplxpp.core import BodyParams, TriangleMesh
from smplxpp.core.mesh import cross_rows
from smplxpp.segment.by_body_chart import FOOT, HEAD, LEG, BodyChart, chart_of_body
from smplxpp.segment.by_body_rings import STEP

_UNEVEN = 1
"""Largest difference in rings between the heights of a hem in two sectors."""
_LEAST_ROUGHNESS = 0.0005
"""Metres: the least step that counts as usual, so that a scan without any noise does not have hems everywhere. Of 0.4
to 0.8 mm it leaves fewest outlines wrong on the people of the benchmark `labels_by_body`."""
# Log ratio of densities of a median step, in multiples of the scan's usual step, at a hem and elsewhere. From 200 hems
# and 12,000 other rings of the procedural people and public scans; the same curve does for all kinds of hems.
_STEPS = (0.0, 1.0, 1.75, 2.5, 3.5, 5.0, 7.5, 12.0, 25.0)
_NATS = (-3.0, -2.5, -1.3, -0.2, 1.0, 2.4, 3.6, 4.5, 7.0)


@dataclass(frozen=True, eq=False)
class Hems:
    """Evidence for hems at the starts of rings along a column or an arm, and at the end of the last ring.

    Attributes:
        outwards: nats for a hem of what comes after: there the surface steps away from the body.
        inwards: nats for a hem of what comes before: there the surface steps towards the body.
    """

    outwards: Float64[np.ndarray, " R1"]
    inwards: Float64[np.ndarray, " R1"]

    @staticmethod
    def of(
        place: Float64[np.ndarray, " n"],
        turn: Float64[np.ndarray, " n"],
        *,
        tubes: tuple[Bool[np.ndarray, " n"], ...],
        distance: Float64[np.ndarray, " n"],
        area: Float64[np.ndarray, " n"],
        start: float,
        count: int,
        strict: bool = True,
    ) -> Hems:
        """Measure hems from faces.

        Args:
            place: places of the faces along the column, standard metres.
            turn: angles about their own limb, radians.
            tubes: faces of each limb; limbs of a pair count together, because clothes are alike left and right.
            distance: signed distances to the body, metres.
            area: areas of the faces; 0 leaves a face out.
            start: place of the first ring.
            count: number of rings.
            strict: whether nothing counts that swells or thins over 10 cm, see `_steps`; not along arms, where cuffs
                of tight sleeves end over three rings and only steps of more than a millimetre are seen.
        """
        maps = [
            _steps(
                *_cells(place[tube], turn[tube], distance[tube], area[tube], start=start, count=count), strict=strict
            )
            for tube in tubes
        ]
        step = np.concatenate(maps, axis=1)
        # Sectors without faces are NaN and do not count; a ring with fewer than three sectors has no evidence.
        there = np.isfinite(step)
        known = there.sum(axis=1) >= 3
        median = np.zeros((2, count + 1))
        for row, sign in zip(median, (1.0, -1.0), strict=True):
            side = maximum_filter1d(np.where(there, np.maximum(sign * step, 0.0), 0.0), 2 * _UNEVEN + 1, axis=0)
            row[known] = np.nanmedian(np.where(there, side, np.nan)[known], axis=1)
        inner = known & (np.arange(count + 1) >= 2) & (np.arange(count + 1) <= count - 2)
        usual = max(
            float(np.median(median[:, inner])) if inner.any() else 0.0,
            _LEAST_ROUGHNESS if strict else 1.6 * _LEAST_ROUGHNESS,
        )
        nats = np.where(known, np.interp(median / usual, _STEPS, _NATS), 0.0)
        return Hems(nats[0], nats[1])

    def about_shoes(self, lax: Hems, place: Float64[np.ndarray, " R1"]) -> Hems:
        """Return these hems, which are strict, with those of feet and ankles from `lax` ones, which are not.

        Trousers that fall over a low shoe widen over three rings: such a step counts up to 13 cm. Above, up to 25 cm,
        legs of trousers lie in folds all round, so that what both call a hem counts, with at most 4 nats.
        """
        low, high, less, most = place < 0.13, place < 0.25, 0.5, 4.0

        def either(own: np.ndarray, other: np.ndarray) -> np.ndarray:
            both = np.where(high, np.minimum(np.minimum(own, other), most), own)
            return np.where(low, np.maximum(own, other - less), both)

        return Hems(either(self.outwards, lax.outwards), either(self.inwards, lax.inwards))

    def beside_rolls(self) -> tuple[Float64[np.ndarray, " R1"], Float64[np.ndarray, " R1"]]:
        """Return nats for hems outwards and inwards, less those of an opposite step within 4.5 cm across the cloth.

        A roll of cloth at the waist, or a belt, steps away from the body and back again, and is no end of a garment.
        """
        away, back, rings = np.maximum(self.outwards, 0.0), np.maximum(self.inwards, 0.0), 3
        above = sliding_window_view(np.pad(back, (0, rings)), rings + 1).max(axis=1)
        below = sliding_window_view(np.pad(away, (rings, 0)), rings + 1).max(axis=1)
        return self.outwards - above, self.inwards - below


def _cells(
    place: np.ndarray, turn: np.ndarray, distance: np.ndarray, area: np.ndarray, *, start: float, count: int
) -> tuple[Float64[np.ndarray, "R S"], Bool[np.ndarray, "R S"]]:
    """Return the mean distance in each ring and sector, between known rings interpolated, and where it is known."""
    ring = np.floor((place - start) / STEP).astype(np.int64)
    sectors = 12
    sector = np.floor((turn / (2.0 * np.pi) + 0.5) * sectors).astype(np.int64) % sectors
    inside = (ring >= 0) & (ring < count) & (area > 0)
    cell = ring[inside] * sectors + sector[inside]
    total = np.bincount(cell, area[inside], minlength=count * sectors)
    # Distances are bounded, because 6 cm off the body is a skirt however far it stands out.
    summed = np.bincount(cell, area[inside] * np.clip(distance[inside], -0.03, 0.06), minlength=count * sectors)
    mean = (summed / np.maximum(total, 1e-12)).reshape(count, sectors)
    known = (total > 0).reshape(count, sectors)
    for column, there in zip(mean.T, known.T, strict=True):
        at = np.flatnonzero(there)
        column[:] = np.interp(np.arange(count), at, column[at]) if len(at) else np.nan
    return mean, known


def _steps(mean: np.ndarray, known: np.ndarray, *, strict: bool) -> Float64[np.ndarray, "R1 S"]:
    """Return the steps between two rings on each side of each start of a ring, above the slopes before and after.

    What these slopes explain is no step, as where a skirt begins to flare: with `strict` the steepest within 3 cm, so
    that a trunk or leg of another form than the body's, whose distance rises and falls over 10 to 20 cm, has no hems;
    else the medians over 6 cm. NaN where no ring beside it has faces.
    """
    count = len(mean)
    out = np.full((count + 1, mean.shape[1]), np.nan)
    slope = 2.0 * np.diff(mean, axis=0)
    for k in range(2, count - 1):
        far = 2 if strict else 4
        before, after = slope[max(0, k - 2 - far) : max(1, k - 2)], slope[min(count - 2, k + 1) : k + 1 + far]
        if strict:
            beside = np.concatenate([before, after])
        else:
            beside = np.stack([np.median(before, axis=0), np.median(after, axis=0)])
        step = 0.5 * (mean[k] + mean[k + 1] - mean[k - 1] - mean[k - 2])
        out[k] = step - np.clip(step, beside.min(axis=0), beside.max(axis=0))
    near = maximum_filter1d(known.astype(np.int64), 3, axis=0) > 0
    out[:-1][~near] = np.nan
    return out


def roughness(mesh: TriangleMesh, faces: Bool[np.ndarray, " M"], *, most: int = 300) -> float:
    """Return how far a surface departs from smooth skin: the median residual of a quadric over 3 cm, metres.

    Folds of cloth leave half a millimetre to two, muscles and fat 0.1 to 0.3 mm; noise of the scan adds to both.

    Args:
        mesh: the scan.
        faces: the part of it that is measured.
        most: number of places, evenly over the faces, at which a quadric is fitted.

    Returns:
        NaN where too few faces lie around each place.
    """
    chosen = np.flatnonzero(faces)
    points, normals = mesh.face_centers, mesh.face_normals
    at = chosen[:: max(1, len(chosen) // most)]
    out = []
    for i, near in zip(at, cKDTree(points).query_ball_point(points[at], _PATCH), strict=True):
        # At most 60 neighbours that look the same way, so that the other side of a thin fold does not count.
        around = np.asarray(near)
        around = around[normals[around] @ normals[i] > 0.2]
        around = around[:: max(1, len(around) // 60)]
        if len(around) < 12:
            continue
        # Height over the tangent plane as a quadric of the two coordinates within it.
        across = cross_rows(normals[i : i + 1], np.eye(3)[np.abs(normals[i]).argmin()])[0]
        upward = cross_rows(normals[i : i + 1], across)[0]
        offset = points[around] - points[i]
        x, y, z = offset @ across, offset @ upward, offset @ normals[i]
        design = np.stack([np.ones(len(x)), x, y, x * x, x * y, y * y], axis=1)
        left = z - design @ np.linalg.lstsq(design, z, rcond=None)[0]
        out.append(np.sqrt(np.mean(left**2)))
    return float(np.median(out)) if out else float("nan")


_PATCH = 0.03
"""Radius of a patch, metres: folds are 2 to 8 cm apart, and a limb is a quadric over less than its own radius."""


def nats_for_hair(mesh: TriangleMesh, chart: BodyChart, area: Float64[np.ndarray, " M"]) -> float:
    """Return the log odds that a head without colours has hair, from the roughness of its sides; 0 if it is unknown.

    Hair ends in an edge about forehead, ears and nape, and lies in strands; a bare skull is as smooth as its ears leave
    it. Of 51 procedural heads the sides of five bare ones have 0.45 to 0.63 mm, of the others, cropped ones first, 0.71
    mm and more: 0.66 mm is between, for a tenth off which the odds are e.
    """
    between, spread = 0.00066, 0.1
    sides = (chart.region == HEAD) & ~chart.skull_cap & ~chart.face_core & (area > 0)
    rough = roughness(mesh, sides)
    return float(np.clip(np.log(rough / between) / spread, -4.0, 4.0)) if np.isfinite(rough) else 0.0


def nats_for_shoes(chart: BodyChart, area: Float64[np.ndarray, " M"]) -> float:
    """Return the log ratio of the feet's distances to the body under shoes and bare, -4 to 4.

    Bare feet lie on the body's, or within: -1.5 mm in the median, with a standard deviation of 2.5 mm; shoes stand 9 mm
    off, plus or minus 4 mm. A foot that the fit turned away lies within on one side and off on the other: its robust
    spread widens both.
    """
    nats = []
    for side in (-1, 1):
        # Soles are left out: bare or shod, they are on the floor.
        foot = (chart.region == FOOT) & (chart.side == side) & (chart.height > 0.02) & (area > 0)
        if foot.sum() < 20:
            continue
        distance = chart.distance[foot]
        middle = float(np.median(distance))
        turned = 0.3 * float(1.4826 * np.median(np.abs(distance - middle)))
        bare, shod = np.hypot(0.0025, turned), np.hypot(0.004, turned)
        nats.append(0.5 * ((middle + 0.0015) / bare) ** 2 - 0.5 * ((middle - 0.009) / shod) ** 2 + np.log(bare / shod))
    return float(np.clip(np.mean(nats), -4.0, 4.0)) if nats else 0.0


def on_heels(mesh: TriangleMesh, body: BodyModel, params: BodyParams) -> bool:
    """Return whether the scan reaches down to the floor under a raised heel of the body, as only a shoe does.

    Args:
        mesh: the scan, metres, +Y up.
        body: the body model.
        params: one frame, in the pose of the scan.
    """
    posed = body.forward(params)
    vertices, rest, chart = posed.vertices[0], posed.rest_vertices[0], chart_of_body(body, params)
    for side in (-1, 1):
        foot = np.flatnonzero((chart.region == FOOT) & (chart.side == side))
        # The hindmost twentieth of the foot is its heel; the foot stands on the lowest of it.
        heel = vertices[foot[np.argsort(rest[foot, 2])[: max(1, len(foot) // 20)]]]
        floor, above = vertices[foot, 1].min(), heel[:, 1].min()
        if above - floor < _RAISED:
            continue
        beside = np.linalg.norm(mesh.face_centers[:, [0, 2]] - heel.mean(axis=0)[[0, 2]], axis=1) < _UNDER_HEEL
        if (beside & (mesh.face_centers[:, 1] < floor + 0.3 * (above - floor))).any():
            return True
    return False


_RAISED, _UNDER_HEEL = 0.03, 0.04
"""Metres that a heel is raised by, and how far beside it the heel of its shoe may be: more than bent toes of flat shoes
and errors of a fit, less than the distance to the ball of the foot."""


def legs_apart(chart: BodyChart, area: Float64[np.ndarray, " M"], count: int) -> Float64[np.ndarray, " R"]:
    """Return, for `count` rings of the column, 1 where the surface goes round each leg and 0 where it goes round both.

    The quarter of the legs' surface that faces the other leg is a quarter of the area of trousers and of skin, and of a
    skirt nothing.
    """
    leg = (chart.region == LEG) & (area > 0)
    ring = np.clip(np.floor(chart.height / STEP).astype(np.int64), 0, count - 1)
    inner = leg & (np.abs(chart.turn + chart.side * (np.pi / 2)) < np.pi / 4) & (chart.distance < 0.04)
    # Summed over five rings, because a ring of a coarse mesh has few faces.
    own, whole = (
        np.convolve(np.bincount(ring[part], area[part], minlength=count), np.ones(5), mode="same")
        for part in (inner, leg)
    )
    return np.clip((own / np.maximum(whole, 1e-12) - 0.03) / 0.09, 0.0, 1.0)
