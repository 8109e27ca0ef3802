"""What hangs or lies over other clothes: long hair, an open coat, the bib of overalls; told by colour and by place.

Each is found before the outline of the clothes, which it would disturb.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from smplxpp.core.topology import component_labels
from smplxpp.segment.by_body_chart import ARM, FOOT, HEAD, LEG, NECK, TRUNK, BodyChart
from smplxpp.segment.by_body_colors import Palette

_BALD = 2.0  # mean log ratio of the cap for skin
_LOWEST, _OUTMOST = 0.85, 0.2  # standard metres: how far down the trunk and along the arm hair may hang
_CLEAR = 0.7  # nats by which a layer explains a colour better than all else
_HANGS = 0.03  # metres from the legs
_RINGS = 6  # of faces over which colours are averaged where a layer grows
# Jensen-Shannon divergence of colours, nats (at most 0.69): two garments, or one.
_OTHER, _SAME = 0.3, 0.12
_TURNS = (0.0, -0.12, 0.12, -0.24, 0.24)  # radians
_CLOTHED = 0.3  # share of a part of the body that is not skin, from which its cloth has a say


@dataclass(frozen=True, eq=False)
class Layers:
    """Faces of what lies over the rest.

    Attributes:
        bald: whether the skull has the colour of skin. hair: hair below the head. coat: an open coat. bib: the front of
            the trunk has the colours of the lower garment and the sleeves have not.
    """

    bald: bool
    hair: Bool[np.ndarray, " M"]
    coat: Bool[np.ndarray, " M"]
    bib: bool

    @staticmethod
    def none(count: int) -> Layers:
        """Of a scan without colours."""
        nothing = np.zeros(count, dtype=bool)
        return Layers(False, nothing, nothing, False)


def find_layers(
    chart: BodyChart,
    palette: Palette,
    skin_ratio: Float64[np.ndarray, " M"],
    area: Float64[np.ndarray, " M"],
    pairs: Int64[np.ndarray, "P 2"],
) -> Layers:
    """Find hair that hangs, coats and bibs.

    Args:
        skin_ratio: log ratio of each face's colour for skin. pairs: faces that share an edge.
    """
    skin_like = 1.0 / (1.0 + np.exp(-(skin_ratio + 1.0)))
    cap = chart.skull_cap
    bald = bool(cap.any() and area[cap] @ skin_ratio[cap] > _BALD * area[cap].sum())
    nothing = np.zeros(len(area), dtype=bool)
    hair = nothing if bald else _hanging_hair(chart, palette, skin_like, area, pairs)
    parts = _ClothColors.of(chart, palette, area * (1.0 - skin_like) * ~hair, area)
    coat = _open_coat(chart, palette, parts, skin_like, area, pairs) & ~hair if parts.coat else nothing
    return Layers(bald, hair, coat, parts.bib)


def _hanging_hair(
    chart: BodyChart, palette: Palette, skin_like: np.ndarray, area: np.ndarray, pairs: np.ndarray
) -> Bool[np.ndarray, " M"]:
    """Faces below the head that hair of the cap's colour reaches, compared with the chest, the legs, and skin."""
    cap, trunk = chart.skull_cap, chart.region == TRUNK
    front = trunk & (np.abs(chart.azimuth) < 0.7) & (chart.height > 0.95) & (chart.height < 1.3)
    below = (chart.height < 0.85) & np.isin(chart.region, (TRUNK, LEG, FOOT))
    own = palette.histogram(area * cap * (1.0 - skin_like))
    others = [palette.histogram(area * x) for x in (front * (1 - skin_like), below * (1 - skin_like), skin_like)]
    may = (
        ((chart.region == HEAD) & ~chart.face_core)
        | (chart.region == NECK)
        | (trunk & (chart.height > _LOWEST))
        | ((chart.region == ARM) & (chart.reach < _OUTMOST))
    )
    ratio = np.log(own / np.max(others, axis=0))[palette.index]
    return _grown(ratio, may, cap, pairs) & (chart.region != HEAD)


@dataclass(frozen=True, eq=False)
class _ClothColors:
    """Histograms of the trunk's front, sides and back, of sleeves and of legs, and of the front at three heights; None
    where there is hardly any cloth."""

    front: np.ndarray | None
    side: np.ndarray | None
    back: np.ndarray | None
    sleeve: np.ndarray | None
    legs: np.ndarray | None
    heights: tuple[np.ndarray | None, ...]

    @staticmethod
    def of(chart: BodyChart, palette: Palette, cloth: np.ndarray, area: np.ndarray) -> _ClothColors:
        """Args: cloth: area of each face, as far as it is not skin."""
        turn, chest = np.abs(chart.azimuth), (chart.region == TRUNK) & (chart.height > 1.0) & (chart.height < 1.3)

        def part(mask: np.ndarray) -> np.ndarray | None:
            enough = cloth[mask].sum() > _CLOTHED * area[mask].sum() > 0
            return palette.histogram(cloth * mask) if enough else None

        side = part(chest & (turn > 0.7) & (turn < 1.9))
        # The opening is where the front differs most from the sides: the body may be turned by some degrees.
        strips = [chest & (np.abs(chart.azimuth - turned) < 0.2) for turned in _TURNS]
        middle = max(strips, key=lambda strip: np.nan_to_num(_differ(part(strip), side)))
        return _ClothColors(
            part(middle),
            side,
            part(chest & (turn > 2.2)),
            part((chart.region == ARM) & (chart.reach < 0.15)),
            part(((chart.region == LEG) & (chart.height > 0.6)) | ((chart.region == TRUNK) & (chart.height < 0.85))),
            tuple(part(middle & (chart.height > low) & (chart.height <= low + 0.1)) for low in (1.0, 1.1, 1.2)),
        )

    @property
    def coat(self) -> bool:
        """Sides, back and sleeves are one cloth, and the whole height of the front's middle is another."""
        over = _differ(self.side, self.back) < _SAME and _differ(self.side, self.sleeve) < _SAME
        known = [x for x in (_differ(part, self.side) for part in self.heights) if np.isfinite(x)]
        return over and not self.bib and len(known) > 1 and min(known) > _OTHER

    @property
    def bib(self) -> bool:
        """The front is of the legs' cloth and the sleeves are of another."""
        return _differ(self.front, self.legs) < _SAME and _differ(self.sleeve, self.legs) > 2 * _SAME


def _differ(p: np.ndarray | None, q: np.ndarray | None) -> float:
    """Jensen-Shannon divergence in nats; NaN, which is neither more nor less, where one is unknown."""
    if p is None or q is None:
        return float("nan")
    mean = 0.5 * (p + q)
    return float(0.5 * (p * np.log(p / mean)).sum() + 0.5 * (q * np.log(q / mean)).sum())


def _open_coat(
    chart: BodyChart,
    palette: Palette,
    parts: _ClothColors,
    skin_like: np.ndarray,
    area: np.ndarray,
    pairs: np.ndarray,
) -> Bool[np.ndarray, " M"]:
    """Faces of the coat: what is nearer in colour to the trunk's sides than to its front, to skin, or to the shins."""
    side, front = parts.side, parts.front
    assert side is not None and front is not None
    skin = palette.histogram(area * skin_like)
    shins = palette.histogram(area * (1 - skin_like) * ((chart.height > 0.15) & (chart.height < 0.3)))
    above = np.log(side / np.maximum(front, skin))[palette.index]
    below = np.log(side / np.max([front, skin, shins], axis=0))[palette.index]
    ratio = np.where((chart.region == LEG) | (chart.height < 0.85), below, above)
    turn = np.abs(chart.azimuth)
    root = (chart.region == TRUNK) & (turn > 0.7) & (chart.height > 1.0)
    may = np.isin(chart.region, (TRUNK, ARM, NECK)) | ((chart.region == LEG) & (chart.height > 0.12))
    coat = _grown(ratio, may, root, pairs)
    on_legs = coat & (chart.region == LEG)
    if on_legs.any():
        # What hangs far from the legs is no trousers but the coat's shaded inner side.
        hem = np.percentile(chart.height[on_legs], 3)
        coat |= (chart.region == LEG) & (chart.distance > _HANGS) & (chart.height > hem)
    return coat


def _grown(ratio: np.ndarray, may: np.ndarray, root: np.ndarray, pairs: np.ndarray) -> Bool[np.ndarray, " M"]:
    """Faces where the mean of `ratio` around is clear, and that are joined to such faces of `root`."""
    mean = ratio
    count = 1 + np.bincount(pairs.ravel(), minlength=len(ratio))
    for _ in range(_RINGS):
        mean = (mean + np.bincount(pairs.ravel(), mean[pairs[:, ::-1]].ravel(), minlength=len(mean))) / count
    grown = may & (mean > _CLEAR)
    component = component_labels(pairs[grown[pairs].all(axis=1)], len(mean))
    rooted = np.zeros(int(component.max(initial=0)) + 1, dtype=bool)
    rooted[component[root & grown]] = True
    return grown & rooted[component]
