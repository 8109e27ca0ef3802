"""Film garments made by procedure while their wearers walk, turn about, stand still and sit down.

    python -m benchmarks cloth_film --out garments.mp4 [--garments "long skirt" hakama ...]

Garments, cuts and simulation are those of `cloth_stress`, in one motion that ends seated, long enough to settle. Under
each picture stands the longest edge of the simulated cloth over its length at rest, up to then; a line for each garment
tells the whole film's, which a tear, a caught hem or a simulation that began again would show. Nothing is stored.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from jaxtyping import UInt8

from benchmarks.accuracy.cloth_stress import (
    FPS,
    SEEN_FROM,
    START,
    SWING_AND_SIT,
    UNDER,
    drawn_surface,
    dressed,
    motion,
    wardrobe,
)
from smplxpp.body import load_body
from smplxpp.cloth import ClothDriver, cut_garment
from smplxpp.cloth.quality import LONGEST_EDGE
from smplxpp.core import BodyParams, GeometryWarning, InputError
from smplxpp.figures import fit_cameras
from smplxpp.figures.film import write_film
from smplxpp.figures.sheets import caption, contact_sheet
from smplxpp.people.garments.cut import Garment
from smplxpp.people.garments.mannequin import Mannequin
from smplxpp.raster import render_shaded

SIZE = (289, 224)  # height and width of a picture, pixels; with its caption even, as MP4 requires
# What the person reaches in the motion, metres: corners of a box that every picture shows.
_ROOM = np.array([[x, y, z] for x in (-0.6, 0.6) for y in (-0.88, 0.98) for z in (-0.3, 0.3)])


@dataclass(frozen=True)
class ClothFilm:
    """Simulate the garments side by side, draw them and write a film."""

    out: Path
    """The film: .mp4 (extra `[video]`), .gif, or a folder of pictures."""
    garments: tuple[str, ...] = (
        *("mini skirt", "knee skirt", "long skirt", "full circle skirt", "pleated skirt"),
        *("dress", "coat over long skirt", "cape", "wide trousers, hem 24 cm", "hakama"),
    )
    columns: int = 5

    def run(self) -> None:
        """Film, and print a line for each garment."""
        body = load_body()
        mannequin = Mannequin.of(body, np.zeros(body.num_betas))
        known = wardrobe(mannequin)
        unknown = [name for name in self.garments if name not in known]
        if unknown or not self.garments:
            raise InputError("garments", expected=", ".join(known), received=", ".join(unknown) or "none")
        params = motion(body, SWING_AND_SIT, mannequin.params.betas[0], SWING_AND_SIT[-1][0])
        worn = [[known[one] for one in (UNDER.get(name), name) if one] for name in self.garments]
        people = [Person(mannequin, garments) for garments in worn]
        pictures = _pictures(people, params, self.columns)
        first = next(pictures)
        write_film(self.out, itertools.chain([first], pictures), fps=FPS, size=(first.shape[1], first.shape[0]))
        for name, one in zip(self.garments, people, strict=True):
            print(f"{name}: longest edge {one.longest:.2f}, began again {one.resets} times")
        torn = [name for name, one in zip(self.garments, people, strict=True) if one.torn]
        print(f"{self.out}: {len(params)} frames, {len(people)} garments, torn: {', '.join(torn) or 'none'}")


class Person:
    """A wearer whose garments are simulated frame by frame.

    Attributes:
        longest: longest edge of any simulated garment over its length at rest, up to now.
        resets: how often a simulation began again on the body.
    """

    def __init__(self, mannequin: Mannequin, garments: Sequence[Garment]) -> None:
        self.name = garments[-1].name
        self.template = dressed(mannequin, *garments)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GeometryWarning)
            cuts = [cut_garment(self.template, one.label, mannequin.params) for one in garments]
        self.driver = ClothDriver(self.template, cuts, START)
        self.weights = self.template.weights.dense()
        self.longest, self.resets = 0.0, 0

    @property
    def torn(self) -> bool:
        """Whether an edge was too long, or a simulation began again."""
        return self.longest > LONGEST_EDGE.fail or self.resets > 0

    def picture(self, params: BodyParams) -> UInt8[np.ndarray, "H W 3"]:
        """Step to a pose and draw it, seen from the same place in every frame."""
        posed = self.template.posed_body(params)
        shape = self.driver.step(params, 1.0 / FPS, posed=posed)
        self.longest = max(one.longest for one in self.driver.quality)
        self.resets = sum(one.resets for one in self.driver.quality)
        mesh = self.template.mesh.with_vertices(drawn_surface(self.template, self.weights, posed, shape))
        height, width = SIZE
        (camera,) = fit_cameras(_ROOM, directions=[SEEN_FROM], height=height, width=width)
        image = render_shaded(mesh, camera, vertex_colors=self.template.vertex_colors)
        return caption(image, f"{self.name}  {self.longest:.2f}", size=10)


def _pictures(people: Sequence[Person], params: BodyParams, columns: int) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Yield the sheet of every frame."""
    for k in range(len(params)):
        yield contact_sheet([one.picture(params.frame(k)) for one in people], columns=columns, gap=2)


if __name__ == "__main__":
    tyro.cli(ClothFilm, prog="python -m benchmarks cloth_film").run()
