"""Find layers over other clothes by colour and place: long hair, an open coat, the bib of overalls; a coat by shape.

They are found before the outline of the clothes, which they would disturb. A layer is a set of faces connected to its
root (the skull, the trunk's sides) on which the log ratio of its colour histogram to all others, averaged over six
rings of faces, exceeds 0.7 nats.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64, Int64

from smplxpp.core.topology import component_labels
from smplxpp.segment.by_body_chart import ARM, FOOT, HEAD, LEG, NECK, TRUNK, BodyChart
from smplxpp.segment.by_body_colors import ONE_CLOTH, Palette, divergence
from smplxpp.segment.by_body_hems import Hems
from smplxpp.segment.by_body_outfit import Outfit
from smplxpp.segment.by_body_rings import STEP, Rings

# Jensen-Shannon divergence of two histograms, nats (at most 0.69), from which they are two garments. Chosen on the
# procedural people of the benchmark `labels_by_body`, as `ONE_CLOTH`.
_OTHER = 0.3


@dataclass(frozen=True, eq=False)
class Layers:
    """Faces of layers over other clothes.

    Attributes:
        bald: whether the skull has the colour of skin.
        hair: hair below the head.
        coat: an open coat.
        bib: whether the front of the trunk has the colours of the lower garment, and the sleeves do not.
        vague: faces of which nothing tells whether they are the coat's; None: there are none.
        scalp: probability that the scalp is what it is taken for, hair or skin.
    """

    bald: bool
    hair: Bool[np.ndarray, " M"]
    coat: Bool[np.ndarray, " M"]
    bib: bool
    vague: Bool[np.ndarray, " M"] | None = None
    scalp: float = 1.0

    @staticmethod
    def none(count: int) -> Layers:
        """Return no layers, for a scan without colours."""
        nothing = np.zeros(count, dtype=bool)
        return Layers(False, nothing, nothing, False)


def find_layers(
    chart: BodyChart,
    palette: Palette,
    skin_ratio: Float64[np.ndarray, " M"],
    area: Float64[np.ndarray, " M"],
    pairs: Int64[np.ndarray, "P 2"],
) -> Layers:
    """Find hanging hair, open coats and bibs.

    Args:
        chart: places of the faces.
        palette: palette of the scan.
        skin_ratio: log ratio of each face's colour for skin.
        area: areas of the faces.
        pairs: faces that share an edge.
    """
    skin_like = 1.0 / (1.0 + np.exp(-(skin_ratio + 1.0)))
    cap = chart.skull_cap
    # Bald: the mean log ratio of the skull for skin exceeds 2 nats.
    bald = bool(cap.any() and area[cap] @ skin_ratio[cap] > 2.0 * area[cap].sum())
    nothing = np.zeros(len(area), dtype=bool)
    hair = nothing if bald else _hanging_hair(chart, palette, skin_like, area, pairs)
    parts = _ClothColors.of(chart, palette, area * (1.0 - skin_like) * ~hair, area)
    coat = _open_coat(chart, palette, parts, skin_like, area, pairs) & ~hair if parts.coat else nothing
    return Layers(bald, hair, coat, parts.bib)


def _hanging_hair(
    chart: BodyChart, palette: Palette, skin_like: np.ndarray, area: np.ndarray, pairs: np.ndarray
) -> Bool[np.ndarray, " M"]:
    """Return faces below the head with the skull's colour, compared with chest, legs and skin.

    Hair may hang down to 0.85 m of the standard trunk and 20 cm along the arm.
    """
    cap, trunk = chart.skull_cap, chart.region == TRUNK
    front = trunk & (np.abs(chart.azimuth) < 0.7) & (chart.height > 0.95) & (chart.height < 1.3)
    below = (chart.height < 0.85) & np.isin(chart.region, (TRUNK, LEG, FOOT))
    own = palette.histogram(area * cap * (1.0 - skin_like))
    others = [palette.histogram(area * x) for x in (front * (1 - skin_like), below * (1 - skin_like), skin_like)]
    may = (
        ((chart.region == HEAD) & ~chart.face_core)
        | (chart.region == NECK)
        | (trunk & (chart.height > 0.85))
        | ((chart.region == ARM) & (chart.reach < 0.2))
    )
    ratio = np.log(own / np.max(others, axis=0))[palette.index]
    return _grown(ratio, may, cap, pairs) & (chart.region != HEAD)


@dataclass(frozen=True, eq=False)
class _ClothColors:
    """Colour histograms of the trunk's front, sides and back, of sleeves and legs, and of the front at three heights.

    A histogram is None where less than 30 % of the part is cloth.
    """

    front: np.ndarray | None
    side: np.ndarray | None
    back: np.ndarray | None
    sleeve: np.ndarray | None
    legs: np.ndarray | None
    heights: tuple[np.ndarray | None, ...]

    @staticmethod
    def of(chart: BodyChart, palette: Palette, cloth: np.ndarray, area: np.ndarray) -> _ClothColors:
        """Measure the histograms; `cloth` is the area of each face times the probability that it is not skin."""
        turn, chest = np.abs(chart.azimuth), (chart.region == TRUNK) & (chart.height > 1.0) & (chart.height < 1.3)

        def part(mask: np.ndarray) -> np.ndarray | None:
            enough = cloth[mask].sum() > 0.3 * area[mask].sum() > 0
            return palette.histogram(cloth * mask) if enough else None

        side = part(chest & (turn > 0.7) & (turn < 1.9))
        # The opening of a coat is where the front differs most from the sides. It is searched within 0.24 radians,
        # because the fitted body may be turned by some degrees.
        turns = (0.0, -0.12, 0.12, -0.24, 0.24)
        strips = [chest & (np.abs(chart.azimuth - turned) < 0.2) for turned in turns]
        middle = max(strips, key=lambda strip: np.nan_to_num(divergence(part(strip), side)))
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
        """Return whether sides, back and sleeves are one cloth, and the whole height of the front's middle another."""
        over = divergence(self.side, self.back) < ONE_CLOTH and divergence(self.side, self.sleeve) < ONE_CLOTH
        known = [x for x in (divergence(part, self.side) for part in self.heights) if np.isfinite(x)]
        return over and not self.bib and len(known) > 1 and min(known) > _OTHER

    @property
    def bib(self) -> bool:
        """Return whether the front is of the legs' cloth and the sleeves are of another."""
        return divergence(self.front, self.legs) < ONE_CLOTH and divergence(self.sleeve, self.legs) > 2 * ONE_CLOTH


def _open_coat(
    chart: BodyChart,
    palette: Palette,
    parts: _ClothColors,
    skin_like: np.ndarray,
    area: np.ndarray,
    pairs: np.ndarray,
) -> Bool[np.ndarray, " M"]:
    """Return the faces that are nearer in colour to the trunk's sides than to its front, to skin, or to the shins."""
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
        # Cloth more than 3 cm from the legs is no trousers but the coat's shaded inner side.
        hem = np.percentile(chart.height[on_legs], 3)
        coat |= (chart.region == LEG) & (chart.distance > 0.03) & (chart.height > hem)
    return coat


def _grown(ratio: np.ndarray, may: np.ndarray, root: np.ndarray, pairs: np.ndarray) -> Bool[np.ndarray, " M"]:
    """Return faces whose averaged log ratio exceeds 0.7 nats and that are connected to such faces of `root`."""
    mean = ratio
    count = 1 + np.bincount(pairs.ravel(), minlength=len(ratio))
    for _ in range(6):
        mean = (mean + np.bincount(pairs.ravel(), mean[pairs[:, ::-1]].ravel(), minlength=len(mean))) / count
    grown = may & (mean > 0.7)
    component = component_labels(pairs[grown[pairs].all(axis=1)], len(mean))
    rooted = np.zeros(int(component.max(initial=0)) + 1, dtype=bool)
    rooted[component[root & grown]] = True
    return grown & rooted[component]


def coat_by_shape(
    chart: BodyChart,
    area: Float64[np.ndarray, " M"],
    outfit: Outfit,
    column: Rings,
    apart: Float64[np.ndarray, " R"],
    *,
    pairs: Int64[np.ndarray, "P 2"],
    upper: Bool[np.ndarray, " M"],
    lips: bool,
) -> tuple[Bool[np.ndarray, " M"], Bool[np.ndarray, " M"] | None]:
    """Return the faces of a coat or cape that colours do not show, and those that may be its or not.

    Args:
        chart: places of the faces.
        area: areas of the faces; 0 leaves a face out.
        outfit: outline of the clothes.
        column: rings of feet, legs and trunk.
        apart: by ring of the column, 1 where the surface goes round each leg.
        pairs: faces that share an edge.
        upper: which faces of trunk and legs lie above the upper garment's hem.
        lips: whether the lips of an open front count where nothing hangs off the legs, as without colours.
    """
    coat, hanging = np.zeros(len(area), dtype=bool), hanging_layer(chart, area, column, apart, upper=upper)
    if lips or hanging is not None:
        coat = _open_coat_by_shape(chart, area, outfit, column, apart, upper=upper)
    if coat.any() or hanging is None:
        return coat, None
    # Where it touches a thigh it is cloth, too: pieces that lie within it alone are none of the trousers.
    coat, vague = hanging
    below = np.isin(chart.region, (TRUNK, LEG)) & ~upper
    piece = component_labels(pairs[~coat[pairs].any(axis=1)], len(area))
    hole = np.bincount(piece, ~below, minlength=int(piece.max()) + 1) == 0
    return (coat | (hole[piece] & below) if coat.any() else coat), vague


def _open_coat_by_shape(
    chart: BodyChart,
    area: Float64[np.ndarray, " M"],
    outfit: Outfit,
    column: Rings,
    apart: Float64[np.ndarray, " R"],
    *,
    upper: Bool[np.ndarray, " M"],
) -> Bool[np.ndarray, " M"]:
    """Return the faces of an open coat or jacket without the help of colours; none where the front is closed.

    An open front has two lips: round the trunk the surface steps towards the body at the one and away from it at the
    other, over the whole height of the chest, as it does round a limb at a hem.

    Arguments as of `coat_by_shape`.
    """
    nothing = np.zeros(len(area), dtype=bool)
    lips = _lips(chart, area)
    if lips is None or outfit.upper_start > 1.2:
        return nothing
    # Sleeves and trunk down to the hem, but for the strip between the lips, which goes on below them.
    strip = (chart.azimuth > lips[0]) & (chart.azimuth < lips[1])
    trunk = np.isin(chart.region, (TRUNK, LEG)) & upper & ~strip
    coat = trunk | ((chart.region == ARM) & (chart.reach < outfit.cuff))
    # Its tails hang off the thighs, between which the surface goes round each, as under no skirt, down to their hem.
    if not around_both(apart, column) and column.distance[_thighs(column)].mean() > 0.035:
        coat |= ~upper & _tails(chart, column, strip)
    return coat


def around_both(apart: Float64[np.ndarray, " R"], column: Rings) -> bool:
    """Return whether the surface goes round both thighs, as skirts do, and not round each of them."""
    return bool(apart[_thighs(column)].mean() < 0.6)


def _thighs(column: Rings) -> Bool[np.ndarray, " R"]:
    middle = column.places[:-1] + 0.5 * STEP
    return np.asarray((middle > 0.6) & (middle < 0.7))


def _tails(chart: BodyChart, column: Rings, strip: Bool[np.ndarray, " M"]) -> Bool[np.ndarray, " M"]:
    """Return the faces of trunk and legs that hang off them, down to the hem of what hangs."""
    middle = column.places[:-1] + 0.5 * STEP
    near = middle[(middle < 0.6) & (column.distance < 0.03)]
    hem = float(near.max()) if len(near) else 0.0
    off = (chart.distance > 0.02) | ((chart.height > 0.75) & ~strip)
    return np.isin(chart.region, (TRUNK, LEG)) & off & (chart.height > hem)


def hanging_layer(
    chart: BodyChart,
    area: Float64[np.ndarray, " M"],
    column: Rings,
    apart: Float64[np.ndarray, " R"],
    *,
    upper: Bool[np.ndarray, " M"],
) -> tuple[Bool[np.ndarray, " M"], Bool[np.ndarray, " M"]] | None:
    """Return the faces of a cape that hangs off the legs, and cloth that may be a layer's or not; None where none does.

    Thighs between which the surface goes round each of them wear trousers, or nothing. What hangs far off them all the
    same is a layer over these: a cape where it hangs behind alone. What hangs in front, too, is a coat, a skirt over
    trousers or wide trousers, which nothing tells apart. Arguments as of `coat_by_shape`.
    """
    # Of 47 people four in open coats and capes have cloth 5 cm off half of the thighs, the others off at most 0.02 of
    # such thighs; in front the coats have it off 0.4 to 0.6 of them, the capes off at most 0.2, at one side.
    far, least, in_front = 0.05, 0.25, 0.3
    if around_both(apart, column):
        return None
    thigh = (chart.region == LEG) & (chart.height > 0.5) & (chart.height < 0.74)
    behind = np.abs(chart.azimuth) > 0.5 * np.pi
    off, front = (
        float(area[part & (chart.distance > far)].sum() / max(area[part].sum(), 1e-12))
        for part in (thigh, thigh & ~behind)
    )
    # Large triangles lie across hems, where their places tell nothing.
    if off < least or thigh.sum() < 300:
        return None
    body, vague = np.isin(chart.region, (TRUNK, LEG)), np.isin(chart.region, (TRUNK, ARM))
    if front > in_front:
        return np.zeros(len(area), dtype=bool), vague | (body & (chart.distance > 0.02))
    return body & np.where(upper, behind, chart.distance > 0.03), vague


def _lips(chart: BodyChart, area: Float64[np.ndarray, " M"]) -> tuple[float, float] | None:
    """Return the azimuths of the two lips of an open front; None where it is closed.

    Rings of azimuth, 14 cm from the axis, take the place of a limb's and sectors of height that of its angles. The
    front's middle lies in an opening, which a fold beside it does not reach. Of 60 people and public scans, with two
    bodies each, five of six with open fronts have at least 7.9 nats and one 4.3; the others have at most 3.5.
    """
    low, high, radius, least, middle = 0.95, 1.3, 0.14, 6.0, 0.05
    chest = (chart.region == TRUNK) & (chart.height > low) & (chart.height < high)
    count = round(2.0 * np.pi * radius / STEP)
    strict, lax = (
        Hems.of(
            (chart.azimuth + np.pi) * radius,
            (2.0 * (chart.height - low) / (high - low) - 1.0) * np.pi * 0.999,
            tubes=(chest,),
            distance=chart.distance,
            area=area,
            start=0.0,
            count=count,
            strict=only,
        )
        for only in (True, False)
    )
    place = STEP * np.arange(count + 1) / radius - np.pi
    # Both lips count, the weaker one twice if it is doubtful; the opening is up to 17 cm wide.
    one, other = (strict.inwards + lax.inwards)[:, None], (strict.outwards + lax.outwards)[None, :]
    nats = one + other + np.minimum(np.minimum(one, other), 0.0)
    front = ((place > -0.75) & (place < -middle))[:, None] & ((place > middle) & (place < 0.75))[None, :]
    nats = np.where(front & (place[None, :] - place[:, None] < 1.2), nats, -np.inf)
    i, j = np.unravel_index(int(nats.argmax()), nats.shape)
    return (float(place[i]), float(place[j])) if nats[i, j] > least else None
