"""Estimate labels from colours: a palette of the scan, a model of this person's skin, and the cost of every label.

The palette is k-means in OKLab; skin is a normal distribution fitted to face and hands; P(colour | label) comes from a
few rounds of expectation maximisation, in which faces with a certain label give histograms, which give new posteriors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from smplxpp.core.labels import HAIR, LABELS, SKIN
from smplxpp.segment.by_body_chart import ARM, FOOT, HAND, LEG, TRUNK, BodyChart
from smplxpp.segment.graph_cut import COLOR_STEP

# Spread of one dye's colour in OKLab under changing light, noise and blur: nearer colours count as one. Lightness
# varies most.
_BLUR = COLOR_STEP
# Range of human skin in OKLab under light without a strong tint: hue and its half width in degrees.
_SKIN_HUE, _SKIN_HUE_SPREAD = 50.0, 22.0
# Bounds of the spread of one person's skin in OKLab.
_LEAST_SPREAD = np.array([0.05, 0.012, 0.012])
_MOST_SPREAD = np.array([0.12, 0.03, 0.03])


def has_colors(lab: Float64[np.ndarray, "M 3"]) -> bool:
    """Return whether colours vary as in a photograph: the 90th percentile differs from the median by 0.012 in OKLab."""
    return bool(np.percentile(np.abs(lab - np.median(lab, axis=0)).max(axis=1), 90) > 0.012)


def without_one_sided_light(lab: Float64[np.ndarray, "M 3"], chart: BodyChart) -> Float64[np.ndarray, "M 3"]:
    """Return a scan's colours without the light that falls on one side of the body alone.

    Clothes are alike left and right; light is not. Light of strength k on a matt surface scales L, a and b of OKLab by
    k^(1/3) each, so that it keeps the chromaticity (a / L, b / L). Where a face and the faces at its mirrored place
    have the same chromaticity, half of the log ratio of their lightness is the light's. Its median over the nearest
    such faces, which keeps the edges of a shadow and no pattern, is taken from L, a and b.

    Args:
        lab: colours of the faces in OKLab.
        chart: places of the faces.
    """
    # Places in metres of which mirrored ones can be compared; limbs, and sides of paired ones, lie 10 m apart. What
    # hangs off the body is no neighbour of what lies on it.
    column, arms = np.isin(chart.region, (TRUNK, LEG, FOOT)), np.isin(chart.region, (ARM, HAND))
    paired = arms | np.isin(chart.region, (LEG, FOOT))
    turn = np.where(paired, chart.turn, chart.azimuth)
    limb, side = 10.0 * np.where(column, 0.0, np.where(arms, 1.0, 2.0)), np.where(paired, 10.0 * chart.side, 0.0)
    along, radius = np.where(arms, chart.reach, chart.height), 0.1 + np.clip(chart.distance, 0.0, 0.3)
    place = np.stack([limb, along, radius * np.cos(turn), radius * np.sin(turn), side], axis=1)
    # Of each of 20,000 faces: the mean of the eight nearest to its mirrored place, within 5 cm.
    chosen = np.random.default_rng(0).permutation(len(lab))[:20_000]
    own = np.maximum(lab[chosen], [1e-3, -1.0, -1.0])
    off, other = cKDTree(place[chosen]).query(place[chosen] * [1, 1, 1, -1, -1], k=8, distance_upper_bound=0.05)
    there = np.isfinite(off)
    mirrored = np.concatenate([own, np.zeros((1, 3))])[other].sum(axis=1) / np.maximum(there.sum(axis=1), 1)[:, None]
    shown = there.sum(axis=1) >= 4
    mirrored[~shown] = own[~shown]
    # Chromaticity is noise where it is dark, so that colours are compared at the lesser lightness. On each of ten
    # people half in shadow 0.01 leaves less of it than 0.02 and 0.04. No shadow is deeper than a tenth of the light.
    alike, deepest = 0.01, 0.38
    dark = np.minimum(own[:, :1], mirrored[:, :1])
    apart = np.linalg.norm(dark * (own[:, 1:] / own[:, :1] - mirrored[:, 1:] / mirrored[:, :1]), axis=1)
    half = 0.5 * np.log(own[:, 0] / mirrored[:, 0])
    like = shown & (apart < alike) & (np.abs(half) < deepest)
    around = 30
    if like.sum() < 2 * around:
        return lab
    near = cKDTree(place[chosen][like]).query(place, k=around)[1]
    shadow = np.median(half[like][near], axis=1)
    # Patterns and large triangles leave some hundredths here and there, a light of 35 % on one half 0.17 all over it.
    shadow = shadow * np.clip((np.abs(shadow) - 0.04) / 0.04, 0.0, 1.0)
    if np.mean(np.abs(shadow) > 0.06) < 0.1:
        return lab
    # Both sides come to their mean; the level of the lit side is kept.
    return np.asarray(lab * np.exp(np.median(np.abs(shadow)) - shadow)[:, None])


@dataclass(frozen=True, eq=False)
class Palette:
    """A scan's palette of K colours.

    Attributes:
        centers: OKLab.
        index: the colour of each face.
        near: smoothing matrix between colours; columns sum to 1.
    """

    centers: Float64[np.ndarray, "K 3"]
    index: Int64[np.ndarray, " M"]
    near: Float64[np.ndarray, "K K"]

    @staticmethod
    def of(lab: Float64[np.ndarray, "M 3"], *, seed: int = 0) -> Palette:
        """Cluster colours by k-means: 12 steps of Lloyd from k-means++ centres on 20,000 faces.

        There are at most 48 colours: more than the dyes and shades of an outfit, few enough for dense histograms.
        """
        rng = np.random.default_rng(seed)
        sample = lab[rng.permutation(len(lab))[:20_000]] / _BLUR
        centers = sample[:1]
        squared = ((sample - centers[0]) ** 2).sum(axis=1)
        while len(centers) < 48 and squared.max() > 1e-6:
            centers = np.concatenate([centers, sample[rng.choice(len(sample), 1, p=squared / squared.sum())]])
            squared = np.minimum(squared, ((sample - centers[-1]) ** 2).sum(axis=1))
        for _ in range(12):
            index = cKDTree(centers).query(sample)[1]
            count = np.bincount(index, minlength=len(centers))
            sums = np.stack([np.bincount(index, x, minlength=len(centers)) for x in sample.T], axis=1)
            centers = np.where(count[:, None] > 0, sums / np.maximum(count, 1)[:, None], centers)
        near = np.exp(-0.5 * ((centers[:, None] - centers[None]) ** 2).sum(axis=2))
        return Palette(centers * _BLUR, cKDTree(centers).query(lab / _BLUR)[1], near / near.sum(axis=0))

    @property
    def size(self) -> int:
        return len(self.centers)

    def histogram(self, weights: Float64[np.ndarray, " M"]) -> Float64[np.ndarray, " K"]:
        """Return the share of each colour among weighted faces, smoothed over near colours; it sums to 1.

        15 % are spread evenly over the palette, so that no colour is impossible.
        """
        counts = np.bincount(self.index, weights, minlength=self.size)
        spread = self.near @ counts
        total = spread.sum()
        even = np.full(self.size, 1.0 / self.size)
        return (1 - 0.15) * (spread / total if total > 0 else even) + 0.15 * even


ONE_CLOTH = 0.12
"""Divergence of two histograms, nats, up to which they are of one cloth."""


def divergence(p: np.ndarray | None, q: np.ndarray | None) -> float:
    """Return the Jensen-Shannon divergence in nats; NaN, which compares false, where a histogram is unknown."""
    if p is None or q is None:
        return float("nan")
    mean = 0.5 * (p + q)
    return float(0.5 * (p * np.log(p / mean)).sum() + 0.5 * (q * np.log(q / mean)).sum())


@dataclass(frozen=True, eq=False)
class SkinModel:
    """Normal distribution of one person's skin colour in OKLab.

    Attributes:
        center: mean colour.
        spread: standard deviations.
        found: whether the face or the hands gave it; otherwise it is the generic range of skin.
        hands: whether the hands have the same colour (False: gloves or a covered face); None without hands.
    """

    center: Float64[np.ndarray, " 3"]
    spread: Float64[np.ndarray, " 3"]
    found: bool
    hands: bool | None

    def log_ratio(self, lab: Float64[np.ndarray, "M 3"]) -> Float64[np.ndarray, " M"]:
        """Return log p(colour | skin) / p(colour | anything), bounded to [-4, 4].

        Other colours have the density 10, even over the colours that a screen can show.
        """
        z = ((lab - self.center) / self.spread) ** 2
        log_density = -0.5 * z.sum(axis=1) - np.log(self.spread).sum() - 1.5 * np.log(2 * np.pi)
        return np.clip(log_density - np.log(10.0), -4.0, 4.0)


def looks_like_skin(lab: Float64[np.ndarray, "M 3"]) -> Bool[np.ndarray, " M"]:
    """Return whether colours lie in the range of human skin; many other things do, too."""
    hue = np.degrees(np.arctan2(lab[:, 2], lab[:, 1]))
    chroma = np.hypot(lab[:, 1], lab[:, 2])
    light = (lab[:, 0] > 0.2) & (lab[:, 0] < 0.97)
    return light & (np.abs(hue - _SKIN_HUE) < 1.6 * _SKIN_HUE_SPREAD) & (chroma > 0.012) & (chroma < 0.16)


def fit_skin(
    lab: Float64[np.ndarray, "M 3"],
    face: Bool[np.ndarray, " M"],
    hands: tuple[Bool[np.ndarray, " M"], Bool[np.ndarray, " M"]],
    area: Float64[np.ndarray, " M"],
) -> SkinModel:
    """Fit the skin colour from the main colours of face and hands; hands that differ from the face wear gloves.

    Where the hands differ from each other, one holds something: the one that has more of the face's colour counts.

    Args:
        lab: colours in OKLab.
        face: faces well within the face.
        hands: faces well within the left and the right hand.
        area: areas of the faces; one without any, such as of a thing in the hand, shows no skin.
    """
    # A brown ball that a hand holds has as many faces as the hand, and its colour was the skin's.
    face = face & (area > 0.0)
    # Skin of one person differs by at most 0.2 in lightness and 0.04 in chroma.
    alike = np.array([0.2, 0.04, 0.04])

    def like(color: tuple[np.ndarray, np.ndarray]) -> Bool[np.ndarray, " M"]:
        return (np.abs(lab - color[0]) < alike).all(axis=1)

    each = [
        (own, color) for own in (one & (area > 0.0) for one in hands) if (color := _main_color(lab[own], area[own]))
    ]
    bare = (hands[0] | hands[1]) & (area > 0.0)
    if len(each) == 2 and (np.abs(each[0][1][0] - each[1][1][0]) > alike).any():
        bare = max(each, key=lambda one: area[face & like(one[1])].sum())[0]
    of_face, of_hands = _main_color(lab[face], area[face]), _main_color(lab[bare], area[bare])
    agree = False
    if of_face is not None and of_hands is not None:
        # Hair over the face, or a body turned by some degrees, leaves the hands' colour to part of the face: a quarter
        # is enough.
        like_hands = like(of_hands)
        agree = bool(area[face & like_hands].sum() > 0.25 * area[face].sum())
        face = face & like_hands if agree else face
    chosen = (face | bare) if agree else face if of_face is not None else bare
    main = _main_color(lab[chosen], area[chosen]) or of_face or of_hands
    if main is None:
        hue = np.radians(_SKIN_HUE)
        center = np.array([0.65, 0.06 * np.cos(hue), 0.06 * np.sin(hue)])
        return SkinModel(center, np.array([0.2, 0.03, 0.03]), False, None)
    return SkinModel(
        main[0],
        np.clip(main[1], _LEAST_SPREAD, _MOST_SPREAD),
        True,
        None if not bare.any() else agree or of_face is None,
    )


def _main_color(lab: np.ndarray, area: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Return centre and spread of the main skin-like colour; None if less than a third of the area looks like skin."""
    skin = looks_like_skin(lab)
    if len(lab) < 10 or area[skin].sum() < 0.33 * area.sum():
        return None
    lab = lab[skin]
    # Start at the densest place, then iterate the mean of the colours within 2.5 robust standard deviations.
    sample = lab[:: max(1, len(lab) // 500)] / COLOR_STEP
    near = cKDTree(sample).query_ball_point(sample, 1.5, return_length=True)
    center = sample[int(near.argmax())] * COLOR_STEP
    for _ in range(5):
        spread = np.clip(1.4826 * np.median(np.abs(lab - center), axis=0), _LEAST_SPREAD, _MOST_SPREAD)
        near = (np.abs(lab - center) < 2.5 * spread).all(axis=1)
        if not near.any():
            break
        center = lab[near].mean(axis=0)
    return center, 1.15 * lab[near].std(axis=0) if near.any() else spread


@dataclass(frozen=True, eq=False)
class Blend:
    """Average over neighbouring faces that stops at edges of colour.

    Attributes:
        matrix: (M, M), rows sum to 1.
        steps: how often it is applied.
    """

    matrix: csr_matrix
    steps: int

    @staticmethod
    def of(pairs: Int64[np.ndarray, "P 2"], alike: Float64[np.ndarray, " P"], count: int, *, steps: int) -> Blend:
        """Build the averaging matrix of a mesh's faces.

        Args:
            pairs: faces that share an edge.
            alike: weight of each pair, 0 to 1.
            count: number of faces.
            steps: how often the matrix is applied.
        """
        here, there = np.concatenate([pairs, pairs[:, ::-1]]).T
        own = np.arange(count)
        values = np.concatenate([np.tile(alike, 2), np.full(count, 0.2)])
        matrix = csr_matrix((values, (np.concatenate([here, own]), np.concatenate([there, own]))), shape=(count, count))
        share = 1.0 / np.asarray(matrix.sum(axis=1)).ravel()
        matrix.data *= np.repeat(share, np.diff(matrix.indptr))
        return Blend(matrix, steps)

    def __call__(self, values: Float64[np.ndarray, "M L"]) -> Float64[np.ndarray, "M L"]:
        for _ in range(self.steps):
            values = self.matrix @ values
        return values


def label_costs(
    prior: Float64[np.ndarray, "M L"],
    palette: Palette | None,
    skin_like: Float64[np.ndarray, " M"],
    *,
    area: Float64[np.ndarray, " M"],
    far: Float64[np.ndarray, " M"],
    blend: Blend,
    bald: bool,
    rounds: int,
    cap: float,
) -> Float64[np.ndarray, "M L"]:
    """Return -log P(label | place, colours around, distance) up to a constant a face, in nats.

    Args:
        prior: P(label | place).
        palette: palette of the scan; None without colours.
        skin_like: probability that a face's colour is skin.
        area: areas of the faces.
        far: log ratio of the distance to the body for cloth or hair against skin.
        blend: average over neighbours.
        bald: whether the skull has the colour of skin.
        rounds: rounds of expectation maximisation.
        cap: upper bound of the cost of colour.
    """
    base = -np.log(prior)
    base[:, SKIN.id] += far
    if palette is None:
        return blend(base)
    posterior = prior.copy()
    posterior[:, SKIN.id] *= skin_like
    discount = np.ones((palette.size, len(LABELS)))
    cost = base
    for _ in range(rounds):
        # M step: histograms of colour from faces with a certain label. Skin counts by its own model, and skin-like
        # colours hardly count for hair.
        certain = posterior * np.maximum(posterior - 0.5, 0.0) * discount[palette.index] * area[:, None]
        certain[:, SKIN.id] *= skin_like
        if not bald:
            certain[:, HAIR.id] *= 1.0 - 0.9 * skin_like
        table = _color_shares(palette, certain, area)
        # Colours that are more typical of another label count less for this one: a braid is no part of the shirt.
        discount = table / table.max(axis=1, keepdims=True)
        # E step: posteriors from the capped cost of colour, averaged over neighbours, and the other terms.
        of_color = -np.log(table)
        of_color = np.minimum(of_color - of_color.min(axis=1, keepdims=True), cap)
        cost = blend(of_color[palette.index]) + base
        posterior = np.exp(cost.min(axis=1, keepdims=True) - cost)
        posterior /= posterior.sum(axis=1, keepdims=True)
    return cost


def _color_shares(palette: Palette, certain: np.ndarray, area: np.ndarray) -> Float64[np.ndarray, "K L"]:
    """Return P(colour | label), tiny for labels that no face certainly has."""
    worn = certain.sum(axis=0) > 1e-4 * area.sum()
    shares = [
        palette.histogram(certain[:, k]) if worn[k] else np.full(palette.size, 1e-3 / palette.size)
        for k in range(len(LABELS))
    ]
    return np.stack(shares, axis=1)
