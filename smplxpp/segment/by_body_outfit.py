"""Find by colour where shoes, legs, trousers, shirt and sleeves begin and end along the body: the outline of clothes.

The column of feet, legs and trunk is cut into runs of shoe, skin, lower, skin and upper, the arm into sleeve and skin;
any run may be empty. The unknowns are the borders b_1..b_4 of the runs. The cost of an outline, in nats, is the sum
over runs r of

    sum_(rings in r) n KL(ring's colours | run's colours)        colours within a run belong together
    + likelihood ratios of skin by colour and by distance        skin in cloth, and other things in skin
    + priors on the places and lengths of r                      usual clothes, folds at hems

Dynamic programming over rings of 1.5 cm finds the exact minimum; the sum of exp(-cost / NAT) over all outlines gives
the probability of every label in every ring. Constants were chosen on the procedural people of the benchmark
`labels_by_body`, always without the person who is measured.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float64

from smplxpp.core.labels import LABELS, LOWER, SHOE, SKIN, UPPER
from smplxpp.segment.by_body_chart import HIP, KNEE, WRIST
from smplxpp.segment.by_body_colors import ONE_CLOTH, divergence
from smplxpp.segment.by_body_rings import ARM_START, COLUMN_END, STEP, Rings

# Height of the usual waist, standard metres.
_WAIST = 0.98
NAT = 8.0
"""Nats of an outline's cost for one nat of its probability, because rings are not independent and clothes vary (6 to 8
for 36 of 38 people)."""
RUNS = (SHOE, SKIN, LOWER, SKIN, UPPER)
_NO_SHOE = 200.0  # nats of no shoe under a heel, more than colours can bring


@dataclass(frozen=True)
class OutfitConfig:
    """Costs of an outline in `find_outfit`, in nats.

    Attributes:
        samples: number of independent samples of colour in a ring.
        skin_in_cloth: cost of a sample of cloth that looks like skin, a nat of log ratio; bounded by `skin_colored`.
        skin_colored: cost of a garment in the colour of skin.
        skin_colored_top: the same for an upper garment.
        skin_colored_shoe: the same for shoes.
        other_in_skin: cost of a sample of skin that does not look like it, a nat of log ratio.
        distance: cost of a ring's mean distance to the body, a nat of log ratio.
        bare_pelvis: cost of a ring of skin about the pelvis.
        split: cost of two garments instead of one, about legs that a skirt hides.
        split_at_legs: the same about visible legs, lower because a suit of one colour is more usual than a jumpsuit.
        midriff: cost of skin between two garments.
        crease: bonus of a border with a full step (10 mm) of the distance to the body.
    """

    samples: float = 8.0
    skin_in_cloth: float = 0.8
    skin_colored: float = 25.0
    skin_colored_top: float = 40.0
    skin_colored_shoe: float = 60.0
    other_in_skin: float = 1.0
    distance: float = 0.7
    bare_pelvis: float = 6.0
    split: float = 45.0
    split_at_legs: float = 6.0
    midriff: float = 12.0
    crease: float = 12.0


@dataclass(frozen=True, eq=False)
class Outfit:
    """Outline of the clothes, with borders in standard metres.

    Attributes:
        shoe_top: top of the shoes, 0 for bare feet.
        lower_start: lower hem of the lower garment.
        lower_end: its upper end; not above `lower_start` without a lower garment.
        upper_start: hem of the upper garment.
        cuff: end of the sleeve along the arm.
        margins: by border, the additional cost of the best outline whose border is more than 6 cm away, nats.
        column: P(label) in the column's rings, over all outlines.
        sleeve: P(sleeve) in the arm's rings.
        waist_step: nats of the surface's step at the border of lower and upper garment; inf where colours, or
            folds, show it.
        seamless: whether the surface has no seam at the waist: two garments may be one, and one garment is one.
    """

    shoe_top: float
    lower_start: float
    lower_end: float
    upper_start: float
    cuff: float
    margins: dict[str, float]
    column: Float64[np.ndarray, "R L"]
    sleeve: Float64[np.ndarray, " Q"]
    waist_step: float = np.inf
    seamless: bool = False

    def as_one_piece(self) -> Outfit:
        """Return the outline with upper and lower garment as one without a seam, which is `upper`."""
        column, start = self.column.copy(), self.lower_start if self.has_lower else self.upper_start
        column[:, UPPER.id] += column[:, LOWER.id]
        column[:, LOWER.id] = 0.0
        return replace(self, lower_end=self.lower_start, upper_start=start, column=column, seamless=True)

    def in_two(self) -> Outfit:
        """Return the outline of one garment over trunk and legs as two, which meet at the usual waist."""
        column, below = self.column.copy(), STEP * (np.arange(len(self.column)) + 0.5) < _WAIST
        column[below, LOWER.id] += column[below, UPPER.id]
        column[below, UPPER.id] = 0.0
        return replace(self, lower_start=self.upper_start, lower_end=_WAIST, upper_start=_WAIST, column=column)

    def alike(self, column: Rings) -> bool:
        """Return whether upper and lower garment have the same colours: a divergence of at most `ONE_CLOTH`."""
        middle, colors = column.places[:-1] + 0.5 * STEP, column.colors * column.weight[:, None]
        lower, upper = (
            np.maximum(colors[part].sum(axis=0), 1e-9)
            for part in ((middle > self.lower_start) & (middle < self.lower_end), middle > self.upper_start)
        )
        return divergence(lower / lower.sum(), upper / upper.sum()) < ONE_CLOTH

    @property
    def has_lower(self) -> bool:
        return self.lower_end > self.lower_start

    @property
    def unclothed(self) -> bool:
        """Return whether neither an upper nor a lower garment was found."""
        return not self.has_lower and self.upper_start >= COLUMN_END - 1e-9

    @property
    def one_piece(self) -> bool:
        """Return whether one garment covers trunk and thighs, such as a dress or a jumpsuit."""
        return not self.has_lower and self.upper_start < HIP - 0.1


def find_outfit(
    column: Rings,
    arm: Rings,
    config: OutfitConfig,
    *,
    misfit: float,
    chest: bool = True,
    heels: bool = False,
    shod: float = 0.0,
    apart: Float64[np.ndarray, " R"] | None = None,
) -> Outfit:
    """Find the cheapest borders of a column (from the soles up) and an arm (from the shoulder out).

    Args:
        column: rings of feet, legs and trunk.
        arm: rings of both arms.
        config: costs.
        misfit: typical distance between body and bare skin, metres.
        chest: whether the scan reaches the chest.
        heels: whether the feet stand on heels, so that there are shoes, even in the colour of skin.
        shod: `by_body_hems.nats_for_shoes`.
        apart: `by_body_hems.legs_apart` of the column's rings; None: the legs say nothing of long coats.
    """
    # Leather stands off the body's foot, which alone tells dusty boots from dark skin. Colours count once a sample.
    bare_feet = _NO_SHOE if heels else config.samples * max(shod, 0.0)
    order = _column_costs(column, config, misfit, chest=chest, bare_feet=bare_feet, heels=heels, apart=apart)
    borders, margins = _cut_column(column.places, order)
    shoe_top, lower_start, lower_end, upper_start = borders
    of_arm = _arm_costs(arm, config, misfit, skin_colored=column.looks_like_skin(upper_start, COLUMN_END))
    best = int(of_arm.argmin())
    cuff, margins["cuff"] = float(arm.places[best]), _margin(of_arm, arm.places, best)
    # Long trousers (hem below 13 cm) in the colour of skin hide the border of shoes in the same colour. Bare feet below
    # trousers are rare, so that a low shoe, 9 cm high, is assumed with no margin.
    if shoe_top == 0.0 and lower_start < 0.13 and column.looks_like_skin(lower_start, lower_end):
        borders, margins["shoe_top"] = (0.09, max(0.09, lower_start), *borders[2:]), 0.0
    ends = np.exp((of_arm.min() - of_arm) / NAT)
    return Outfit(*borders, cuff, margins, label_shares(order), 1.0 - np.cumsum(ends)[:-1] / ends.sum())


@dataclass(frozen=True, eq=False)
class _RunCosts:
    """Costs of runs, (R + 1, R + 1) each: at [i, j] those of rings i..j-1 as one kind of garment, inf for i > j."""

    shoe: np.ndarray
    top: np.ndarray
    cloth: np.ndarray
    skin: np.ndarray
    worn: np.ndarray
    """Cloth for certain, whatever its colour."""
    spread: np.ndarray
    """Of the colours alone."""

    @staticmethod
    def of(rings: Rings, config: OutfitConfig, misfit: float) -> _RunCosts:
        # A run costs the spread of its colours, plus likelihood ratios of skin by colour and distance. The cost of a
        # garment in the colour of skin is bounded, because such garments exist.
        n = rings.weight * config.samples
        cross = _cross_costs(rings, n)
        cloth_far, skin_far = _distance_costs(rings, config, misfit)
        like_skin = _between(config.skin_in_cloth * n * rings.skin[:, 0])
        cloth = cross + _between(cloth_far)
        # An eighth of a ring of skin may be in shadow, below hair or stained: such colours are no cloth's.
        stained = 0.15
        other = np.maximum(rings.skin[:, 1] - stained * rings.skin[:, 0], 0.0)
        skin = cross + _between(config.other_in_skin * n * other + skin_far)
        most = (config.skin_colored_shoe, config.skin_colored_top, config.skin_colored)
        runs = (*(cloth + np.minimum(like_skin, one) for one in most), skin, cloth, cross)
        there = np.triu(np.ones(cross.shape, dtype=bool))
        return _RunCosts(*(np.where(there, run, np.inf) for run in runs))


def _between(ring: np.ndarray) -> np.ndarray:
    """Return the sums over rings i..j-1 at [i, j]."""
    total = np.concatenate([[0.0], np.cumsum(ring)])
    return total[None, :] - total[:, None]


def _cross_costs(rings: Rings, n: np.ndarray) -> Float64[np.ndarray, "R1 R1"]:
    """Return, at [i, j], the sum over rings i..j-1 of n KL(ring's colours | colours of the run)."""
    count = len(rings)

    def plogp(p: np.ndarray) -> np.ndarray:
        return np.where(p > 0, p * np.log(np.where(p > 0, p, 1.0)), 0.0).sum(axis=-1)

    mass = np.concatenate([np.zeros((1, rings.colors.shape[1])), np.cumsum(rings.colors * n[:, None], axis=0)])
    total = np.concatenate([[0.0], np.cumsum(n * (rings.colors.sum(axis=1) > 0))])
    own = np.concatenate([[0.0], np.cumsum(n * plogp(rings.colors))])
    out = np.zeros((count + 1, count + 1))
    for i in range(count):
        run, size = mass[i + 1 :] - mass[i], total[i + 1 :] - total[i]
        # sum n h log h - sum m log (m / size)
        out[i, i + 1 :] = own[i + 1 :] - own[i] - plogp(run) + size * np.log(np.maximum(size, 1e-12))
    return np.maximum(out, 0.0)


def _distance_costs(rings: Rings, config: OutfitConfig, misfit: float) -> tuple[np.ndarray, np.ndarray]:
    """Return (R,) nats of each ring as cloth and as skin, because skin lies on the body and cloth above it."""
    spread = np.hypot(0.5 * misfit, 0.003)
    z = rings.distance / spread
    # A normal distribution for skin against an exponential one of mean 12 mm for cloth, bounded to [-0.7, 3] nats.
    ratio = np.clip(0.5 * z**2 - np.maximum(rings.distance, 0) / 0.012 - np.log(0.012 / spread), -0.7, 3.0)
    ratio = np.where(z < 0, -0.7, ratio) * config.distance * rings.weight
    # Bodies that are fitted within clothes keep a distance of 1 to 2 cm from a bare trunk, too.
    trunk, share = rings.places[:-1] > 0.78, 0.25
    skin = np.maximum(ratio, 0.0)
    return np.maximum(-ratio, 0.0), np.where(trunk, share * skin, skin)


def _column_costs(
    rings: Rings,
    config: OutfitConfig,
    misfit: float,
    *,
    chest: bool,
    bare_feet: float,
    heels: bool,
    apart: Float64[np.ndarray, " R"] | None,
) -> list[np.ndarray]:
    """Return the costs of each of the column's `RUNS`, (R + 1, R + 1): at [i, j] those of rings i..j-1."""
    place = rings.places
    runs = _RunCosts.of(rings, config, misfit)
    i, j = np.indices(runs.cloth.shape)
    empty, length = i == j, place[j] - place[i]
    # Hems show as steps of the distance to the body; a step of 10 mm gives the full bonus.
    mean = np.convolve(rings.distance, np.ones(2) / 2, mode="valid")
    jump = np.concatenate([[0.0, 0.0], np.abs(mean[2:] - mean[:-2]), [0.0, 0.0]])
    fold = config.crease * np.clip(jump / 0.010, 0.0, 1.0)
    middle = 0.5 * (place[1:] + place[:-1])
    on_foot = _between(8.0 * (middle < 0.045))  # nats of a ring of the foot in trousers or a dress
    skin = runs.skin + _between(config.bare_pelvis * ((middle > 0.80) & (middle < 0.95)))
    # Priors on the place and length of each run: linear penalties outside of the usual range, and a waist at its
    # height.
    shoe = (runs.worn if heels else runs.shoe) + _usual(place[j], 0.06, 0.30, 20.0) + np.where(empty, 2.0, 0.0)
    shoe += bare_feet * (empty if heels else np.clip(1.0 - place[j] / 0.06, 0.0, 1.0))
    # Light on one dye changes slowly along the leg, a boot's top at once.
    shoe += _hidden_top(runs, place)[j]
    usual = _usual(place[i], 0.02, KNEE + 0.32, 30.0) + np.where(length < 0.2, 10.0, 0.0)
    at_waist = 0.5 * np.minimum(((place[j] - _WAIST) / 0.06) ** 2, 16.0)
    usual_end = _usual(place[j], HIP - 0.12, 1.12, 30.0) + np.where(place[j] < 0.72, 30.0, 0.0)
    # Visible legs: cloth within 25 mm of the thighs on average, where a skirt hangs farther.
    legs_show = float(rings.distance[(middle > 0.5) & (middle < 0.75)].mean()) < 0.025
    split = usual_end + (at_waist + config.split_at_legs if legs_show else config.split)
    if apart is not None:
        # A coat hides the waist of the trousers, which end for the eye where it does.
        over = _hem_over_legs(apart, place) * np.clip(jump / 0.010, 0.0, 1.0)
        split = split + (config.split_at_legs - split) * over[j] * (length >= 0.2)
    # Where a scan ends below the chest, one garment about the legs is the lower one.
    first, second = (split, 0.0) if chest else (usual_end, np.where(_between(rings.weight) > 0, config.split, 0.0))
    lower = np.where(empty, 6.0, runs.cloth + first + usual + on_foot)
    midriff = skin + np.where(empty, 0.0, config.midriff)
    upper = runs.top + second + on_foot + _usual(place[i], -0.1, COLUMN_END, 60.0) - np.where(i > 0, fold[i], 0.0)
    return [shoe, skin, lower, midriff, upper]


def _hem_over_legs(apart: Float64[np.ndarray, " R"], place: np.ndarray) -> Float64[np.ndarray, " R1"]:
    """Return, for each border, how far the surface goes round each leg below it and round both above, 0 to 1.

    Borders from the crotch up do not count, because above it every surface goes round both legs.
    """
    # `apart` is a mean of five rings, so that the nearest that do not see across the border are three rings away.
    low, high = np.arange(len(place)) - 4, np.arange(len(place)) + 3
    within = (low >= 0) & (high < len(apart)) & (place < HIP - 0.12)
    return np.where(within, np.maximum(apart[low.clip(0)] - apart[high.clip(0, len(apart) - 1)], 0.0), 0.0)


def _hidden_top(runs: _RunCosts, place: np.ndarray) -> Float64[np.ndarray, " R1"]:
    """Return the cost of shoes that end at each border, nats: boots whose top no change of colours within 12 cm shows.

    The change is what two runs of four rings, below and above, cost less than one. At the tops of procedural knee boots
    it is 14 nats and more, 18 at the black shoes of a real man in dark trousers; light that fades along these gives 5
    at most, but over a leg 50 to 100 more than the shoes, which the cost exceeds.
    """
    beside, fading, least, cost, low_shoe = 4, 5.0, 8.0, 300.0, 0.12  # rings of 15 mm; three in nats; metres
    low, high = np.arange(len(place)) - beside, np.arange(len(place)) + beside
    low, high, border = np.maximum(low, 0), np.minimum(high, len(place) - 1), np.arange(len(place))
    change = runs.spread[low, high] - runs.spread[low, border] - runs.spread[border, high]
    return np.where(place > low_shoe, cost * np.clip((least - change) / (least - fading), 0.0, 1.0), 0.0)


def _cut_column(
    place: np.ndarray, order: list[np.ndarray]
) -> tuple[tuple[float, float, float, float], dict[str, float]]:
    """Return the cheapest borders between the runs, and their margins, by dynamic programming."""
    count = len(place) - 1
    # forward[k][j] is the least cost of the runs before k if they end at j, backward[k][i] that of the runs from k on
    # if they start at i. The borders are traced back from the end.
    forward = [np.where(np.arange(count + 1) == 0, 0.0, np.inf)]
    for cost in order:
        forward.append((forward[-1][:, None] + cost).min(axis=0))
    backward = [np.where(np.arange(count + 1) == count, 0.0, np.inf)]
    for cost in reversed(order):
        backward.append((cost + backward[-1][None, :]).min(axis=1))
    backward.reverse()
    cuts = [count]
    for k in range(len(order) - 1, -1, -1):
        cuts.append(int((forward[k] + order[k][:, cuts[-1]]).argmin()))
    cuts = cuts[::-1][1:-1]
    names = ("shoe_top", "lower_start", "lower_end", "upper_start")
    margins = {
        name: _margin(forward[k] + backward[k], place, cut)
        for k, (name, cut) in enumerate(zip(names, cuts, strict=True), start=1)
    }
    shoe_top, lower_start, lower_end, upper_start = (float(place[cut]) for cut in cuts)
    return (shoe_top, lower_start, lower_end, upper_start), margins


def label_shares(order: list[np.ndarray]) -> Float64[np.ndarray, "R L"]:
    """Return P(label) of every ring, the sum of exp(-cost / `NAT`) over all outlines (forward-backward)."""
    log = [-cost / NAT for cost in order]
    count = len(log[0]) - 1
    ends = np.arange(count + 1)
    # Log sums: before[k][j] over runs before k that end at j, after[k][i] over runs from k on that start at i.
    before, after = [np.where(ends == 0, 0.0, -np.inf)], [np.where(ends == count, 0.0, -np.inf)]
    for of_run in log:
        before.append(np.logaddexp.reduce(before[-1][:, None] + of_run, axis=0))
    for of_run in reversed(log):
        after.append(np.logaddexp.reduce(of_run + after[-1][None, :], axis=1))
    after.reverse()
    shares = np.zeros((count, len(LABELS)))
    for k, (label, of_run) in enumerate(zip(RUNS, log, strict=True)):
        # P(the run is i..j-1) is added at i and subtracted at j, so that the cumulative sum is P(ring in the run).
        cut = np.exp(before[k][:, None] + of_run + after[k + 1][None, :] - before[-1][-1])
        shares[:, label.id] += np.cumsum(cut.sum(axis=1) - cut.sum(axis=0))[:-1]
    return np.clip(shares, 0.0, 1.0)


def _arm_costs(rings: Rings, config: OutfitConfig, misfit: float, *, skin_colored: bool) -> Float64[np.ndarray, " R1"]:
    """Return the cost of a sleeve that ends at each start of a ring, or at the end of the last one."""
    runs = _RunCosts.of(rings, config, misfit)
    # A shirt in another colour than skin has no sleeves in the colour of skin, so that these cost as much as shoes do.
    sleeve = runs.cloth if skin_colored else runs.shoe
    return sleeve[0] + runs.skin[:, -1] + _usual(rings.places, ARM_START - 0.1, WRIST + 0.04, 40.0)


def _margin(cost: np.ndarray, place: np.ndarray, best: int) -> float:
    """Return the difference between the least cost more than 6 cm away and the best."""
    elsewhere = np.abs(place - place[best]) > 0.06
    return float(cost[elsewhere].min() - cost[best])


def _usual(place: np.ndarray, low: float, high: float, nats: float) -> np.ndarray:
    """Return a penalty of 0 within a range, which rises linearly to `nats` at 20 cm outside of it."""
    return nats * np.maximum(np.maximum(low - place, place - high), 0.0) / 0.2
