"""The cast of procedural people: build, stance, clothes from the inside out, skin tone and colours of each."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from smplxpp.people.outside import Outside
from smplxpp.people.paint import Dye


@dataclass(frozen=True)
class Wear:
    """One layer of clothes of a person.

    Attributes:
        garment: name among `garments.wardrobe.all_garments`.
        dye: its colours.
        folds: height of its folds, metres.
    """

    garment: str
    dye: Dye
    folds: float


@dataclass(frozen=True)
class Member:
    """The description of one person of the cast.

    Attributes:
        build: name in `BUILDS`.
        stance: name in `STANCES`.
        wears: layers from the inside out, hair among them.
        tone: name in `SKIN_TONES`.
        facing: rotation about the vertical to her left, degrees.
        colored: whether the scan has colours.
        outside: how the person differs from every shape of the body model.
    """

    build: str
    stance: str
    wears: tuple[Wear, ...]
    tone: str
    facing: float
    colored: bool
    outside: Outside = field(default_factory=Outside)


def _member(build: str, stance: str, wears: str, tone: str, facing: float = 0.0, *, colored: bool = True) -> Member:
    return Member(build, stance, tuple(_wear(text) for text in wears.split(" | ")), tone, facing, colored)


def _wear(text: str) -> Wear:
    """Read "garment: colour [pattern [second colour]] [@folds in millimetres, else 1.5]"."""
    text, _, folds = text.partition(" @")
    garment, _, dye = text.partition(": ")
    return Wear(garment, Dye(*dye.split()), 1e-3 * float(folds or 1.5))


CAST: dict[str, Member] = {
    "woman T-shirt jeans bob, A": _member(
        "woman", "A", "tight trousers: denim | T-shirt: white | sneakers: red | bob on the shoulders: brown", "light"
    ),
    "man shirt trousers short hair, arms down": _member(
        "man",
        "arms down",
        "long-sleeved shirt: blue check | trousers: grey | low shoes: brown | short hair: black",
        "olive",
        40,
    ),
    "heavy man T-shirt shorts bald, T": _member(
        "heavy man", "T", "knee-length trousers: beige | wide T-shirt: red print @3 | sneakers: white", "light"
    ),
    "woman dress long hair barefoot, contrapposto": _member(
        "woman", "contrapposto", "dress: yellow dots red | long loose hair: blond", "pale", 200
    ),
    "thin woman crop top leggings ponytail, step": _member(
        "thin woman", "step", "leggings: black | crop top: pink | sneakers: grey | ponytail: red", "tan", -75
    ),
    "tall man open coat, wide A": _member(
        "tall man",
        "wide A",
        "tight trousers: black | long-sleeved shirt: white | ankle boots: brown | "
        "open coat: camel @3 | full short hair: blond",
        "pale",
    ),
    "small woman skirt blouse bun, hands on hips": _member(
        "small woman",
        "hands on hips",
        "long-sleeved shirt: green pinstripes | knee skirt: navy | low shoes: black | bun: black",
        "olive",
    ),
    "broad man overalls, arms forward": _member(
        "broad man",
        "arms forward",
        "T-shirt: grey stripes | overalls with straps: denim | ankle boots: camel | cropped hair: black",
        "brown",
        120,
    ),
    "woman sweater beige trousers, right arm raised": _member(
        "tall woman",
        "right arm raised",
        "wide trousers: beige @4 | sweater: wine | low shoes: beige | full short hair: grey",
        "light",
        -20,
    ),
    "dark man tight top joggers, knees bent": _member(
        "man", "knees bent", "tight top: teal | joggers: black @3 | sneakers: orange | cropped hair: black", "dark", 15
    ),
    "child-sized hoodie shorts, head turned": _member(
        "child-sized",
        "head turned",
        "shorts: navy | hood down: orange | sneakers: green | full short hair: brown",
        "tan",
        60,
    ),
    "heavy woman long skirt braid, A uncoloured": _member(
        "heavy woman",
        "A",
        "T-shirt: purple | long skirt: olive @3 | low shoes: black | braid over the chest: brown",
        "light",
        0,
        colored=False,
    ),
    "short heavy man vest shorts barefoot, waving": _member(
        "short heavy man", "waving", "shorts: olive | undershirt: white | cropped hair: grey", "tan", -35
    ),
    "man hood up joggers, A": _member(
        "man", "A", "joggers: grey @3 | sweatshirt: grey @3 | hood up: grey | sneakers: white", "light"
    ),
    "woman scarf sweater tight trousers, arms down": _member(
        "woman",
        "arms down",
        "tight trousers: black | sweater: olive | scarf: red check yellow | "
        "ankle boots: brown | full short hair: brown",
        "pale",
        160,
    ),
    "tall woman cape knee boots, step": _member(
        "tall woman",
        "step",
        "leggings: grey | long-sleeved shirt: black | knee boots: black | cape: wine | bun: red",
        "light",
        95,
    ),
    "woman kimono long skirt, T": _member(
        "small woman",
        "T",
        "long skirt: teal blotches pink | wide sleeves: teal blotches pink | low shoes: black | bun: black",
        "light",
    ),
    "thin man open jacket jeans, pointing": _member(
        "thin man",
        "pointing",
        "T-shirt: yellow | tight trousers: denim | open jacket: black | sneakers: white | short hair: brown",
        "olive",
        -130,
    ),
    "heavy woman wide trousers waistcoat bob, hands on hips": _member(
        "heavy woman",
        "hands on hips",
        "wide trousers: black @4 | long-sleeved shirt: pink | waistcoat: grey pinstripes | "
        "low shoes: black | bob on the shoulders: grey",
        "tan",
        25,
    ),
    "woman jumpsuit long gloves, arms up": _member(
        "woman", "arms up", "jumpsuit: purple | long gloves: white | ankle boots: black | ponytail: blond", "brown", -60
    ),
    "man closed jacket work trousers boots, left hand on hip": _member(
        "man",
        "left hand on hip",
        "trousers: olive | knee boots: black | closed jacket: orange | short hair: black",
        "brown",
    ),
    "dark woman mini skirt crop top long hair, contrapposto": _member(
        "woman",
        "contrapposto",
        "mini skirt: denim | crop top: white stripes red | sneakers: white | long loose hair: black",
        "dark",
        30,
    ),
    "child-sized dress braid, A": _member(
        "child-sized", "A", "dress: pink dots | low shoes: red | braid over the chest: blond", "pale"
    ),
    "broad man tight top shorts bald, elbows bent": _member(
        "broad man", "elbows bent", "shorts: black | tight top: black | sneakers: yellow", "dark", -15
    ),
    "tiny woman wide hair flared skirt, looking down": _member(
        "tiny woman",
        "looking down",
        "undershirt: black | flared skirt: red check black | low shoes: black | hair over chest and shoulders: red",
        "pale",
        10,
    ),
    "man all in beige, at attention": _member(
        "man",
        "at attention",
        "trousers: beige | long-sleeved shirt: beige | low shoes: camel | short hair: blond",
        "light",
        -100,
    ),
    "woman leggings tight top skin-coloured barefoot, A": _member(
        "thin woman", "A", "leggings: beige | tight top: beige | full short hair: brown", "light"
    ),
    "tall man T-shirt wide trousers, long step": _member(
        "tall man",
        "long step",
        "T-shirt: navy | wide trousers: camel @4 | sneakers: black | cropped hair: red",
        "pale",
        -90,
    ),
    "heavy man overalls bare arms, leaning": _member(
        "heavy man",
        "leaning",
        "undershirt: white | overalls with straps: brown | knee boots: olive | full short hair: white",
        "light",
        50,
    ),
    "woman full circle skirt bun, leg raised": _member(
        "woman", "leg raised", "tight top: black | full circle skirt: white | low shoes: pink | bun: brown", "tan"
    ),
    "man hot pants bald barefoot, twisted": _member("man", "twisted", "hot pants: blue", "olive", -45),
    "small woman sweatshirt hot pants knee boots, head turned": _member(
        "small woman",
        "head turned",
        "hot pants: black | sweatshirt: green print | knee boots: brown | ponytail: black",
        "light",
        180,
    ),
    "heavy woman dress to the ankles, right arm raised": _member(
        "heavy woman",
        "right arm raised",
        "dress labelled lower: navy blotches teal | ankle boots: black | short hair: grey",
        "brown",
    ),
    "short heavy man open coat scarf, arms down": _member(
        "short heavy man",
        "arms down",
        "trousers: black | long-sleeved shirt: white | open coat: grey @3 | scarf: wine | "
        "low shoes: brown | cropped hair: grey",
        "pale",
        75,
    ),
    "thin man wide T-shirt jeans uncoloured, step": _member(
        "thin man",
        "step",
        "tight trousers: denim | wide T-shirt: white @4 | sneakers: black | short hair: black",
        "light",
        -20,
        colored=False,
    ),
    "woman hood down leggings uncoloured, elbows bent": _member(
        "woman",
        "elbows bent",
        "leggings: black | hood down: grey | sneakers: white | ponytail: brown",
        "light",
        140,
        colored=False,
    ),
    "broad man open jacket trousers uncoloured, hands on hips": _member(
        "broad man",
        "hands on hips",
        "trousers: grey | T-shirt: white | open jacket: brown | ankle boots: black | cropped hair: black",
        "light",
        0,
        colored=False,
    ),
    "tall woman kimono barefoot uncoloured, arms forward": _member(
        "tall woman",
        "arms forward",
        "knee skirt: wine | wide sleeves: wine | long loose hair: black",
        "light",
        -160,
        colored=False,
    ),
    "man cape hood up, wide A": _member(
        "man",
        "wide A",
        "trousers: brown | long-sleeved shirt: olive | cape: green @3 | hood up: green | knee boots: brown",
        "tan",
    ),
    "mean body nearly naked bald, A": _member("mean", "A", "hot pants: white", "tan"),
}


def _outsider(member: Member, outside: Outside) -> Member:
    return replace(member, outside=outside)


OUTSIDERS: dict[str, Member] = {
    "man T-shirt shorts, calves 8 mm": _outsider(
        _member("man", "A", "shorts: navy | T-shirt: white | sneakers: red | short hair: brown", "light"),
        Outside(calves=0.008),
    ),
    "broad man shorts uncoloured, calves 10 mm, noise 4 mm": _outsider(
        _member("broad man", "wide A", "shorts: grey | T-shirt: teal | low shoes: black", "tan", colored=False),
        Outside(calves=0.010, noise=0.004),
    ),
    "woman T-shirt shorts barefoot, noise 8 mm": _outsider(
        _member("woman", "arms down", "shorts: beige | T-shirt: green | ponytail: black", "olive", 30),
        Outside(noise=0.008),
    ),
    "heavy man trousers sweater, noise 12 mm": _outsider(
        _member("heavy man", "A", "trousers: denim | sweater: wine | sneakers: white | short hair: grey", "pale"),
        Outside(noise=0.012),
    ),
    "woman skirt blouse, heels, noise 5 mm": _outsider(
        _member(
            "tall woman",
            "contrapposto",
            "knee skirt: black | long-sleeved shirt: white | low shoes: red | bun: brown",
            "light",
            -60,
        ),
        Outside(heels=0.07, noise=0.005),
    ),
    "thin man shirt trousers, limbs 8 % longer, fists": _outsider(
        _member(
            "thin man",
            "step",
            "trousers: olive | long-sleeved shirt: blue | ankle boots: brown | short hair: red",
            "tan",
        ),
        Outside(limbs=1.08, fists=True),
    ),
    "woman leggings top uncoloured, noise 8 mm": _outsider(
        _member("woman", "A", "leggings: black | crop top: pink | sneakers: grey", "light", colored=False),
        Outside(noise=0.008),
    ),
    "man nearly naked bald, noise 8 mm, fists": _outsider(
        _member("man", "A", "hot pants: white", "brown", 90), Outside(noise=0.008, fists=True)
    ),
}
"""People whose surface the body model cannot reach, so that a fit keeps the distances that it keeps to real people."""
