"""Bodies that several tests share."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import BodyModel, load_body
from smplxpp.core.params import POSE_BLOCKS, BodyParams


@pytest.fixture(scope="session")
def open_body() -> BodyModel:
    return load_body()


@pytest.fixture
def moving():
    """A factory of random parameters of the open body."""

    def make(frames: int = 2, *, seed: int = 0, betas: int = 20, expressions: int = 52, **changes) -> BodyParams:
        rng = np.random.default_rng(seed)
        pose = {name: rng.normal(size=(frames, 3 * joints)) * 0.3 for name, joints in POSE_BLOCKS}
        values = pose | {
            "betas": np.tile(rng.normal(size=betas), (frames, 1)),
            "expression": rng.random((frames, expressions)) * 0.3,
            "transl": rng.normal(size=(frames, 3)),
        }
        return BodyParams(**values | changes)

    return make
