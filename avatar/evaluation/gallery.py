"""The pictures that an evaluation keeps: some views of every set, evenly, and the worst one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from avatar.evaluation.protocol import ViewSet
from avatar.metrics.view_quality import Box
from smplxpp.core.mesh import TriangleMesh


@dataclass(frozen=True, eq=False)
class ShownView:
    """Pictures of one view on the capture's background.

    Attributes:
        set: of views, among `protocol.SETS`.
        truth: the photograph. rendered: by model. head: box of the head, None where it is not in the image.
        chosen: "evenly" among the views of its set, or "worst": no other view of the set has a lower PSNR of the
            person, as the last model draws it.
    """

    set: str
    camera: str
    frame: int
    truth: UInt8[np.ndarray, "H W 3"]
    rendered: dict[str, UInt8[np.ndarray, "H W 3"]]
    head: Box | None
    chosen: Literal["evenly", "worst"] = "evenly"


@dataclass(frozen=True, eq=False)
class ShownSurface:
    """Posed meshes of one frame for pictures.

    Attributes:
        set: "training" or "held_out". truth: the true surface.
        posed: by model, "skinning alone" first; without the models whose mesh follows its joints alone.
    """

    set: str
    frame: int
    truth: TriangleMesh
    posed: dict[str, TriangleMesh]


class Gallery:
    """Chooses among the views that an evaluation passes; holds no more pictures than it will give.

    Args:
        count: views of each set that are kept evenly; 0: none, and no worst one either.
    """

    def __init__(self, sets: Mapping[str, ViewSet], count: int) -> None:
        self._order = list(sets)
        self._evenly = {(name, *pair) for name, one in sets.items() for pair in one.spread(count)}
        self._with_worst = count > 0
        self._kept: list[ShownView] = []
        self._worst: dict[str, tuple[float, ShownView]] = {}

    def pass_by(self, view: ShownView, psnr: float) -> None:
        """Keep a view if it is one of those to show, or worse than all of its set before.

        Args:
            psnr: dB over the person, of the model that the worst view is the worst of.
        """
        if (view.set, view.camera, view.frame) in self._evenly:
            self._kept.append(view)
        if self._with_worst and (view.set not in self._worst or psnr < self._worst[view.set][0]):
            self._worst[view.set] = psnr, replace(view, chosen="worst")

    def views(self) -> tuple[ShownView, ...]:
        """Return what was kept in the order of sets, each set's worst view last, though it be kept evenly too."""
        worst = [view for _, view in self._worst.values()]
        kept = [*self._kept, *worst]
        return tuple(
            sorted(kept, key=lambda one: (self._order.index(one.set), one.chosen == "worst", one.frame, one.camera))
        )
