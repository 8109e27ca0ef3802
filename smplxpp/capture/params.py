"""Where a capture's body parameters are, read when they are asked for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from smplxpp.body import BodyModel, load_params
from smplxpp.capture.files import FileSeries
from smplxpp.core.params import BodyParams


@dataclass(frozen=True, eq=False)
class StackedParams:
    """One file whose row is the frame's number.

    Attributes:
        path: the file. layout: as `load_params` takes it.
        body: gives the root joint where a layout needs it.
    """

    path: Path
    layout: str = "auto"
    body: BodyModel | None = None

    @cached_property
    def _all(self) -> BodyParams:
        return load_params(self.path, layout=self.layout, body=self.body)

    def frames(self) -> np.ndarray:
        """(F,) rows of the file."""
        return np.arange(len(self._all))

    def read(self, frame: int) -> BodyParams:
        """One row."""
        return self._all.frame(frame)


@dataclass(frozen=True, eq=False)
class ParamFiles:
    """One file a frame; see `StackedParams`."""

    files: FileSeries
    layout: str = "auto"
    body: BodyModel | None = None

    def frames(self) -> np.ndarray:
        """(F,) frames with a file."""
        return self.files.numbers

    def read(self, frame: int) -> BodyParams:
        """One file."""
        return load_params(self.files.path(frame), layout=self.layout, body=self.body)
