"""Find the outline of the clothes from the scan's shape alone, where it has no colours.

The rings of the column, from the soles up, are in the states shoe, skin, lower, skin and upper, of which each may be
left out: a hidden Markov model, whose cost of a sequence s, in nats, is

    sum_rings -log p(distance | cloth or skin)         skin lies where the body is, cloth above it
    + sum_borders -log p(steps there | kind of border)  a border is where the surface steps (`by_body_hems`)
    + sum_borders -log p(place of the border)           usual clothes
    - log p(arms | s)                                   a shirt has sleeves or not, a bare trunk has none

The forward algorithm gives the probability of every outfit (which states there are), Viterbi's the cheapest borders of
the likeliest, the forward-backward algorithm the probability of each label in each ring. The last term is what keeps a
shirt from a bare person: it needs cuffs, a hem at the waist, or both.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float64, Int64
from scipy.special import logsumexp

from smplxpp.core.labels import LABELS, LOWER, SHOE, SKIN, UPPER
from smplxpp.segment.by_body_chart import WRIST
from smplxpp.segment.by_body_hems import Hems
from smplxpp.segment.by_body_outfit import NAT, Outfit
from smplxpp.segment.by_body_rings import ARM_START, Rings, cloth_against_skin

_SHOE, _SHOD_LEGS, _LEGS, _LOWER, _MIDRIFF, _UPPER = range(6)
_LABELS = (SHOE, SKIN, SKIN, LOWER, SKIN, UPPER)
_BARE = (_SHOD_LEGS, _LEGS, _MIDRIFF)
_NONE = 1e-9  # probability of what does not happen; keeps logarithms finite
_NEXT = {
    (_SHOE, _SHOD_LEGS): 0.33,
    (_SHOE, _LOWER): 0.65,
    (_SHOE, _UPPER): 0.02,
    (_SHOD_LEGS, _LOWER): 0.43,
    (_SHOD_LEGS, _UPPER): 0.56,
    (_LEGS, _LOWER): 0.26,
    (_LEGS, _UPPER): 0.34,
    (_LOWER, _MIDRIFF): 0.07,
    (_LOWER, _UPPER): 0.93,
    (_MIDRIFF, _UPPER): 0.6,
}
"""P(next state | state). Without a hem at the waist, what goes round both legs is a dress: the odds are where dresses
and skirts of 14 procedural people and public scans part, with 0.1 nats between the nearest of them."""
_STARTS = (0.83, _NONE, 0.15, 0.02, _NONE, _NONE)
"""P(first state): most people wear shoes."""
_ENDS = (_NONE, 0.005, 0.4, 1e-4, 0.4, 1.0)
"""P(last state | it) where the scan reaches the chest. Who is scanned in shoes is dressed; barefoot, often not."""
# Shares of hems that step outwards and inwards by kind of border; the rest does not step at all. A shirt hangs over
# trousers, or is tucked in, or is as thin as they are.
_STEPS_OUT_IN = {
    (_SHOE, _SHOD_LEGS): (0.0, 0.8),
    (_SHOE, _LOWER): (0.4, 0.4),
    (_SHOE, _UPPER): (0.9, 0.0),
    (_SHOD_LEGS, _LOWER): (0.95, 0.0),
    (_SHOD_LEGS, _UPPER): (0.95, 0.0),
    (_LEGS, _LOWER): (0.95, 0.0),
    (_LEGS, _UPPER): (0.95, 0.0),
    (_LOWER, _MIDRIFF): (0.1, 0.6),
    (_MIDRIFF, _UPPER): (0.7, 0.1),
}
_TUCKED, _FLUSH = 0.25, 0.15
"""Shares of shirts tucked into trousers, and of borders without any step; the other shirts hang over trousers."""
_AT_WRIST = 1.5
"""Nats of a step at the wrist, at most."""
_DISTANCE, _ON_TRUNK = 0.035, 0.25
"""Weight of a ring's distance, because neighbouring rings err together, and its share on the trunk, where bodies that
are fitted within clothes keep a distance of 1 to 2 cm from bare skin, too."""
_ALONG_ARM = 0.06
"""The same weight along the arm. Of 0.035 to 0.13 each of 69 people and scans has it where the others' sleeves are
right most often: bare arms lie as near to the body as hands do."""
_MOST = 1.2
"""Nats of a ring that stands off the body, at most: a whole limb of another form than the model's does that, too."""
_ROUGH = ((0.98, 1.30, 0.23, 0.3), (0.52, 0.74, 0.16, 0.4))
"""Trunk and thighs, from and to which height, with the median roughness of bare skin, mm, and the standard deviation of
its logarithm. Of cloth it is 0.55 mm and 0.6."""
_NO_DRESS = 0.8
"""Nats of each ring of one garment over trunk and legs that goes round each leg."""
_BARE_PELVIS = 0.2
"""Nats of each ring of skin about the pelvis."""


@dataclass(frozen=True, eq=False)
class ShapeEvidence:
    """What the shape of a scan says about its clothes.

    Attributes:
        column: rings of feet, legs and trunk.
        arm: rings of both arms.
        column_hems: hems along the column.
        arm_hems: hems along the arms.
        shod: nats for shoes against bare feet.
        rough: roughness of trunk and thighs, metres.
        apart: by ring of the column, 1 where the surface goes round each leg, 0 where it goes round both.
        chest: whether the scan reaches the chest.
    """

    column: Rings
    arm: Rings
    column_hems: Hems
    arm_hems: Hems
    shod: float
    rough: tuple[float, float]
    apart: Float64[np.ndarray, " R"]
    chest: bool = True


def outfit_by_shape(seen: ShapeEvidence) -> Outfit:
    """Find the most likely outline of the clothes without colours."""
    # Costs of the arms with and without an upper garment end the column.
    sleeve, bare = _arm_costs(seen)
    with_upper = -float(logsumexp(-sleeve))
    chain = _chain(seen, with_upper, bare)
    states, place = _likeliest(chain), seen.column.places
    # Each border is where the states of higher number begin.
    shoe_top, lower_start, lower_end, upper_start = (float(place[int((states < k).sum())]) for k in _BORDERS)
    borders = (shoe_top, lower_start, lower_end, upper_start)
    shares, margins, worn = _posterior(chain, place, borders)
    sleeved = np.exp(-sleeve - logsumexp(-sleeve))
    reach = seen.arm.places
    dressed = bool(states[-1] == _UPPER)
    best = int(sleeve.argmin()) if dressed else 0
    # The odds of the sleeve's end, or of there being none where no upper garment is.
    near = worn * float(sleeved[np.abs(reach - reach[best]) <= _ELSEWHERE].sum())
    near = float(np.clip(near if dressed else near + 1.0 - worn, _NONE, 1.0 - _NONE))
    margins["cuff"] = NAT * float(np.log(near) - np.log1p(-near))
    sleeve_share = worn * (1.0 - np.cumsum(sleeved)[:-1])
    # A hem may lie up to two rings beside the border.
    waist, hems = int((states < _UPPER).sum()), seen.column_hems
    steps = np.maximum(hems.outwards, hems.inwards)[max(0, waist - 2) : waist + 3]
    return Outfit(
        *borders, float(reach[best]), margins, shares, sleeve_share, waist_step=float(steps.max(initial=-np.inf))
    )


_BORDER_NAMES = ("shoe_top", "lower_start", "lower_end", "upper_start")
_BORDERS = (_SHOD_LEGS, _LOWER, _MIDRIFF, _UPPER)
"""The states with which the borders top of the shoes, start and end of the lower garment, start of the upper begin."""
_ELSEWHERE = 0.06
"""Metres from a border from which another place of it is another outline."""


def _mixture(out: np.ndarray, into: np.ndarray, kind: tuple[float, float]) -> np.ndarray:
    """Return the log ratio of what is seen at a border and elsewhere: a mixture of both kinds of steps and of none."""
    return np.asarray(np.log(kind[0] * np.exp(out) + kind[1] * np.exp(into) + 1.0 - sum(kind)))


def _usual(place: np.ndarray, parts: tuple[tuple[float, float, float], ...]) -> np.ndarray:
    """Return the log probability of each place, a mixture of normal distributions (share, mean, deviation)."""
    density = sum(share * np.exp(-0.5 * ((place - mean) / wide) ** 2) / wide for share, mean, wide in parts)
    return np.asarray(np.log(density / np.sum(density) + 1e-6))


def _nats_for_cloth(rough: float, usual: float, spread: float) -> float:
    """Return the log ratio of a roughness under cloth and on skin, both log-normal, -1.8 to 2; 0 if it is unknown."""
    if not np.isfinite(rough):
        return 0.0
    size = np.log(max(1e3 * rough, 0.05))
    skin = -0.5 * ((size - np.log(usual)) / spread) ** 2 - np.log(spread)
    cloth = -0.5 * ((size - np.log(0.55)) / 0.6) ** 2 - np.log(0.6)
    return float(np.clip(cloth - skin, -1.8, 2.0))


def _chain(seen: ShapeEvidence, with_upper: float, without: float) -> Chain:
    """Return the costs of all sequences of states; those of the arms, with and without an upper garment, at the end."""
    rings, place = seen.column, seen.column.places
    middle = 0.5 * (place[1:] + place[:-1])
    # Half of the log ratio of the distances counts for each side, so that their sum over states is nothing.
    ratio = _DISTANCE * np.minimum(cloth_against_skin(rings.distance, 0.05 * rings.spread), _MOST) * rings.weight
    ratio = np.where(middle > 0.78, _ON_TRUNK * ratio, ratio)
    # The feet are one observation.
    feet = middle < 0.08
    ratio[feet] = 0.0
    bare = np.isin(np.arange(len(_LABELS)), _BARE)
    stay = np.where(bare, 0.5, -0.5) * ratio[:, None]
    stay[np.ix_(feet, ~bare)] -= seen.shod / feet.sum()
    stay[(middle > 0.80) & (middle < 0.95)] += _BARE_PELVIS * bare
    # What goes round both legs is no skin, what goes round each of them hardly a dress.
    legs = ((middle > 0.2) & (middle < 0.72) & (rings.weight > 0)).astype(np.float64)
    stay += np.outer(legs * (1.0 - seen.apart), bare | (np.arange(len(_LABELS)) == _SHOE))
    stay[:, _UPPER] += _NO_DRESS * legs * seen.apart
    # Folds: one observation of the trunk, one of the thighs.
    for rough, (low, high, usual, spread) in zip(seen.rough, _ROUGH, strict=True):
        part = (middle > low) & (middle < high)
        stay[part] += np.where(bare, 0.5, -0.5) * _nats_for_cloth(rough, usual, spread) / part.sum()
    out, into = seen.column_hems.outwards, seen.column_hems.inwards
    places = {
        # Low shoes, ankle boots, boots.
        _SHOE: _usual(place, ((0.65, 0.09, 0.025), (0.2, 0.16, 0.04), (0.15, 0.35, 0.10))),
        # Shorts and skirts of all lengths.
        _LEGS: (legs_end := _usual(place, ((0.15, 0.16, 0.06), (0.45, 0.45, 0.12), (0.4, 0.66, 0.10)))),
        _SHOD_LEGS: legs_end,
        # Waists above which there is skin.
        _LOWER: _usual(place, ((1.0, 1.03, 0.06),)),
        _MIDRIFF: _usual(place, ((1.0, 1.12, 0.08),)),
    }
    change = {
        pair: -(np.log(share) + places[pair[0]] + _mixture(out, into, _STEPS_OUT_IN[pair]))
        for pair, share in _NEXT.items()
        if pair != (_LOWER, _UPPER)
    }
    # Shirts and jackets end over trousers where they please, and are tucked in at the waist.
    over = _usual(place, ((0.8, 0.89, 0.05), (0.2, 0.80, 0.05)))
    waist = _usual(place, ((1.0, 1.03, 0.06),))
    flush = np.logaddexp(over, waist) - np.log(2.0)
    # Into skirts they are tucked more often.
    thighs = (middle > 0.55) & (middle < 0.72)
    tucked = _TUCKED + _TUCKED * (1.0 - float(seen.apart[thighs].mean()))
    over_there, into_there = seen.column_hems.beside_rolls()
    steps = np.log(1.0 - tucked - _FLUSH) + over + over_there, np.log(tucked) + waist + into_there
    ways = np.stack([*steps, np.log(_FLUSH) + flush])
    change[_LOWER, _UPPER] = -np.log(_NEXT[_LOWER, _UPPER]) - logsumexp(ways, axis=0)
    ends = np.array(_ENDS)
    if not seen.chest:
        ends = np.array([_NONE, 0.05, 0.05, 1.0, 1.0, 0.05])  # one garment about the legs is the lower one
        with_upper = without = 0.0
    end = -np.log(ends) + np.where(np.arange(len(_LABELS)) == _UPPER, with_upper, without)
    return Chain(-np.log(np.array(_STARTS)), stay, change, end)


def _arm_costs(seen: ShapeEvidence) -> tuple[Float64[np.ndarray, " R1"], float]:
    """Return the costs of a sleeve that ends at each place, and of bare arms without an upper garment."""
    rings, place = seen.arm, seen.arm.places
    ratio = _ALONG_ARM * np.minimum(cloth_against_skin(rings.distance, 0.05 * rings.spread), _MOST) * rings.weight
    # Up to the place the rings are cloth, from there on skin.
    total = np.concatenate([[0.0], np.cumsum(ratio)])
    cost = 0.5 * (total[-1] - 2.0 * total)
    usual = _usual(place, ((0.5, 0.49, 0.03), (0.35, 0.15, 0.07), (0.1, ARM_START, 0.03), (0.05, 0.35, 0.1)))
    # At the wrist the surface steps, too, where the fit has the hand bent otherwise.
    steps = np.where(np.abs(place - WRIST) < 0.04, np.minimum(seen.arm_hems.inwards, _AT_WRIST), seen.arm_hems.inwards)
    cuff_steps = 0.93
    sleeve = cost - usual - _mixture(np.zeros(len(place)), steps, (0.0, cuff_steps))
    # Without sleeves there is no cuff.
    none = place < 0.0
    sleeve[none] = (cost - usual)[none]
    return sleeve, float(cost[0])


@dataclass(frozen=True, eq=False)
class Chain:
    """Costs, in nats, of a sequence of states: of the first, of each ring in each state, of changes, of the last."""

    start: Float64[np.ndarray, " S"]
    stay: Float64[np.ndarray, "R S"]
    change: dict[tuple[int, int], np.ndarray]
    end: Float64[np.ndarray, " S"]

    def changes(self, r: int) -> Float64[np.ndarray, "S S"]:
        """Return the costs of changes between rings r - 1 and r; 0 for none, inf for those that do not happen."""
        out = np.full((len(self.start), len(self.start)), np.inf)
        np.fill_diagonal(out, 0.0)
        for (a, b), cost in self.change.items():
            out[a, b] = cost[r]
        return out

    def only(self, states: tuple[int, ...]) -> Chain:
        """Return the chain of the sequences that go through these states, all of them, and no others."""
        start, end = (np.full(len(self.start), np.inf) for _ in range(2))
        start[states[0]], end[states[-1]] = self.start[states[0]], self.end[states[-1]]
        return Chain(start, self.stay, {pair: self.change[pair] for pair in pairwise(states)}, end)

    def log_sums(self) -> tuple[Float64[np.ndarray, "R S"], Float64[np.ndarray, "R S"]]:
        """Return the log sums of exp(-cost) up to each ring in each state, and from there on without its own."""
        forward, backward = np.empty(self.stay.shape), np.empty(self.stay.shape)
        forward[0], backward[-1] = -self.start - self.stay[0], -self.end
        for r in range(1, len(self.stay)):
            forward[r] = np.logaddexp.reduce(forward[r - 1][:, None] - self.changes(r), axis=0) - self.stay[r]
        for r in range(len(self.stay) - 2, -1, -1):
            after = (backward[r + 1] - self.stay[r + 1])[None]
            backward[r] = np.logaddexp.reduce(after - self.changes(r + 1), axis=1)
        return forward, backward

    def cheapest(self) -> Int64[np.ndarray, " R"]:
        """Return the cheapest sequence of states, by Viterbi's algorithm."""
        count = len(self.stay)
        cost, came = self.start + self.stay[0], np.zeros(self.stay.shape, dtype=np.int64)
        for r in range(1, count):
            paths = cost[:, None] + self.changes(r)
            came[r] = paths.argmin(axis=0)
            cost = paths.min(axis=0) + self.stay[r]
        states = np.empty(count, dtype=np.int64)
        states[-1] = int((cost + self.end).argmin())
        for r in range(count - 1, 0, -1):
            states[r - 1] = came[r][states[r]]
        return states


def _outfits() -> list[tuple[int, ...]]:
    """Return the states of every outfit, such as shoe, lower, upper: all ways through `_NEXT`."""
    found: list[tuple[int, ...]] = []
    open_: list[tuple[int, ...]] = [(_SHOE,), (_LEGS,), (_LOWER,)]
    while open_:
        states = open_.pop()
        found.append(states)
        open_ += [(*states, b) for a, b in _NEXT if a == states[-1]]
    return found


def _likeliest(chain: Chain) -> Int64[np.ndarray, " R"]:
    """Return the cheapest sequence of the most probable outfit.

    Probabilities sum over the places of its borders, so that an outfit does not lose because one of them is not known.
    """
    best, most = chain, -np.inf
    for states in _outfits():
        own = chain.only(states)
        total = float(logsumexp(own.log_sums()[0][-1] - own.end))
        if total > most:
            best, most = own, total
    return best.cheapest()


def _posterior(
    chain: Chain, place: np.ndarray, borders: tuple[float, ...]
) -> tuple[Float64[np.ndarray, "R L"], dict[str, float], float]:
    """Return P(label) in each ring over all sequences, the margins of borders, and P(an upper garment).

    A margin is `NAT` times the log odds that the border lies within 6 cm.
    """
    forward, backward = chain.log_sums()
    total = logsumexp(forward[-1] + backward[-1])
    state = np.exp(forward + backward - total)
    out = np.zeros((len(state), len(LABELS)))
    for k, label in enumerate(_LABELS):
        out[:, label.id] += state[:, k]
    margins = {}
    for name, low, own in zip(_BORDER_NAMES, _BORDERS, borders, strict=True):
        # P(the states change there from below the border to above it), at the ends that they never are the other.
        at = np.zeros(len(place))
        for r in range(1, len(state)):
            log = forward[r - 1][:, None] - chain.changes(r) + (backward[r] - chain.stay[r])[None]
            at[r] = np.exp(logsumexp(log[:low, low:]) - total)
        at[0], at[-1] = state[0, low:].sum(), state[-1, :low].sum()
        near = float(np.clip(at[np.abs(place - own) <= _ELSEWHERE].sum(), _NONE, 1.0 - _NONE))
        margins[name] = NAT * float(np.log(near) - np.log1p(-near))
    return out, margins, float(state[-1, _UPPER])
