"""Who there is: each person's build, stance, clothes from the inside out, skin and colours."""

from __future__ import annotations

from dataclasses import dataclass

from benchmarks.people.paint import Dye


@dataclass(frozen=True)
class Wear:
    """Attributes: the name of a cut (`benchmarks.people.tailor.all_cuts`), how it is dyed, folds in metres."""

    cut: str
    dye: Dye
    folds: float = 0.0015


@dataclass(frozen=True)
class Member:
    """One person of the cast.

    Attributes:
        build, stance: of `BUILDS`, `STANCES`. wears: layers from the inside out, hair among them.
        tone: of `SKIN_TONES`. facing: degrees that she is turned by about the vertical, to her left.
        colored: whether the scan has colours.
    """

    build: str
    stance: str
    wears: tuple[Wear, ...]
    tone: str = "light"
    facing: float = 0.0
    colored: bool = True


def _w(cut: str, color: str, pattern: str = "plain", second: str = "white", *, folds: float = 0.0015) -> Wear:
    return Wear(cut, Dye(color, pattern, second), folds)


CAST: dict[str, Member] = {
    "woman T-shirt jeans bob, A": Member(
        "woman",
        "A",
        (
            _w("tight trousers", "denim"),
            _w("T-shirt", "white"),
            _w("sneakers", "red"),
            _w("bob on the shoulders", "brown"),
        ),
    ),
    "man shirt trousers short hair, arms down": Member(
        "man",
        "arms down",
        (
            _w("long-sleeved shirt", "blue", "check"),
            _w("trousers", "grey"),
            _w("low shoes", "brown"),
            _w("short hair", "black"),
        ),
        "olive",
        40.0,
    ),
    "heavy man T-shirt shorts bald, T": Member(
        "heavy man",
        "T",
        (_w("knee-length trousers", "beige"), _w("wide T-shirt", "red", "print", folds=0.003), _w("sneakers", "white")),
        "light",
    ),
    "woman dress long hair barefoot, contrapposto": Member(
        "woman", "contrapposto", (_w("dress", "yellow", "dots", "red"), _w("long loose hair", "blond")), "pale", 200.0
    ),
    "thin woman crop top leggings ponytail, step": Member(
        "thin woman",
        "step",
        (
            _w("leggings", "black"),
            _w("crop top", "pink"),
            _w("sneakers", "grey"),
            _w("ponytail", "red"),
        ),
        "tan",
        -75.0,
    ),
    "tall man open coat, wide A": Member(
        "tall man",
        "wide A",
        (
            _w("tight trousers", "black"),
            _w("long-sleeved shirt", "white"),
            _w("ankle boots", "brown"),
            _w("open coat", "camel", folds=0.003),
            _w("full short hair", "blond"),
        ),
        "pale",
    ),
    "small woman skirt blouse bun, hands on hips": Member(
        "small woman",
        "hands on hips",
        (
            _w("long-sleeved shirt", "green", "pinstripes"),
            _w("knee skirt", "navy"),
            _w("low shoes", "black"),
            _w("bun", "black"),
        ),
        "olive",
    ),
    "broad man overalls, arms forward": Member(
        "broad man",
        "arms forward",
        (
            _w("T-shirt", "grey", "stripes"),
            _w("overalls with straps", "denim"),
            _w("ankle boots", "camel"),
            _w("cropped hair", "black"),
        ),
        "brown",
        120.0,
    ),
    "woman sweater beige trousers, right arm raised": Member(
        "tall woman",
        "right arm raised",
        (
            _w("wide trousers", "beige", folds=0.004),
            _w("sweater", "wine"),
            _w("low shoes", "beige"),
            _w("full short hair", "grey"),
        ),
        "light",
        -20.0,
    ),
    "dark man tight top joggers, knees bent": Member(
        "man",
        "knees bent",
        (
            _w("tight top", "teal"),
            _w("joggers", "black", folds=0.003),
            _w("sneakers", "orange"),
            _w("cropped hair", "black"),
        ),
        "dark",
        15.0,
    ),
    "child-sized hoodie shorts, head turned": Member(
        "child-sized",
        "head turned",
        (_w("shorts", "navy"), _w("hood down", "orange"), _w("sneakers", "green"), _w("full short hair", "brown")),
        "tan",
        60.0,
    ),
    "heavy woman long skirt braid, A uncoloured": Member(
        "heavy woman",
        "A",
        (
            _w("T-shirt", "purple"),
            _w("long skirt", "olive", folds=0.003),
            _w("low shoes", "black"),
            _w("braid over the chest", "brown"),
        ),
        "light",
        0.0,
        False,
    ),
}
