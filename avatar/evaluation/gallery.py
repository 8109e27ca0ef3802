"""Keep pictures of an evaluation: some views of every set, spread evenly, and the worst one."""

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
        camera: name of the camera.
        frame: number of the frame.
        truth: the photograph, sRGB.
        rendered: pictures by model, sRGB.
        head: box of the head; None where it is not in the image.
        chosen: "evenly" among the views of its set, or "worst": the last model's PSNR of the person is the lowest of
            the set.
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
        set: "training" or "held_out".
        frame: number of the frame.
        truth: the true surface.
        posed: meshes by model, "skinning alone" first; models whose mesh only follows the joints are left out.
    """

    set: str
    frame: int
    truth: TriangleMesh
    posed: dict[str, TriangleMesh]


class Gallery:
    """A selection of views of a running evaluation, which holds no other pictures.

    Args:
        sets: all views of the evaluation.
        count: number of evenly spread views of each set; 0: none, and no worst one either.
    """

    def __init__(self, sets: Mapping[str, ViewSet], count: int) -> None:
        # The even choice is known beforehand, so that no other picture is held but the worst of each set so far.
        self._order = list(sets)
        self._evenly = {(name, *pair) for name, one in sets.items() for pair in one.spread(count)}
        self._with_worst = count > 0
        self._kept: list[ShownView] = []
        self._worst: dict[str, tuple[float, ShownView]] = {}

    def pass_by(self, view: ShownView, psnr: float) -> None:
        """Keep a view if it was chosen, or if its PSNR is the lowest of its set so far.

        Args:
            view: with its pictures.
            psnr: dB over the person, of the last model.
        """
        if (view.set, view.camera, view.frame) in self._evenly:
            self._kept.append(view)
        if self._with_worst and (view.set not in self._worst or psnr < self._worst[view.set][0]):
            self._worst[view.set] = psnr, replace(view, chosen="worst")

    def views(self) -> tuple[ShownView, ...]:
        """Return the kept views in the order of sets, each set's worst view last, even if it was also kept evenly."""
        # In the order of the sets, then by frame and camera.
        worst = [view for _, view in self._worst.values()]
        kept = [*self._kept, *worst]
        return tuple(
            sorted(kept, key=lambda one: (self._order.index(one.set), one.chosen == "worst", one.frame, one.camera))
        )
