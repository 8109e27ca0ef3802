"""Loose clothes of a bundle, simulated as its player steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from avatar.runtime.bundle import AvatarBundle
from avatar.runtime.skeleton import clothed_template
from smplxpp.cloth.driver import ClothDriver, ClothShape, DriverConfig
from smplxpp.cloth.garment_file import garments_from_arrays
from smplxpp.core.params import BodyParams


class Clothes:
    """The driver of a bundle's garments, over the bundle's own vertices."""

    def __init__(self, bundle: AvatarBundle, config: DriverConfig | None = None) -> None:
        template, at = clothed_template(bundle)
        wide = {
            name: value.astype(np.float64) if value.dtype == np.float32 and _is_wide(name) else value
            for name, value in bundle.garments.items()
        }
        for name, value in wide.items():
            if name.split(".")[-1] in ("particles", "vertices", "collider_vertices"):
                inside = value.size == 0 or (value.dtype.kind in "iu" and 0 <= value.min() <= value.max() < len(at))
                wide[name] = at[value] if inside else np.full_like(value, -1)  # refused in the next line
        garments = garments_from_arrays(wide, bundle.garments_about, template, subject="garments of the avatar")
        self._driver = ClothDriver(template, garments, config)
        self._place = np.full(template.vertex_count, -1, dtype=np.int64)
        self._place[at] = np.arange(len(at))

    @property
    def notes(self) -> list[str]:
        """What went otherwise than asked for."""
        return self._driver.notes

    def step(self, params: BodyParams, seconds: float, way: Sequence[BodyParams] = ()) -> ClothShape:
        """Go on to a pose, along a way to it if there is one; see `ClothDriver.step` and `follow`."""
        driver = self._driver
        shape = driver.follow(way, seconds, params) if way else driver.step(params, seconds)
        return replace(shape, vertices=self._place[shape.vertices])

    @property
    def skinned(self) -> ClothShape:
        """The clothes where the joints alone have them."""
        garments = self._driver.garments
        vertices = self._place[np.concatenate([one.vertices for one in garments])]
        share = np.concatenate([one.share() for one in garments])
        return ClothShape(vertices, np.zeros((len(vertices), 3), np.float32), share)

    def restart(self) -> None:
        """Forget the state: the next step starts cold."""
        self._driver.restart()


def _is_wide(name: str) -> bool:
    """Whether an array of garments is kept in float64 elsewhere."""
    return ".params." in name or name.split(".")[-1] in ("rest_vertices", "lengths", "depth", "vertex_depth")
