"""What stages leave for each other, read back."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.runs.artefacts import load_stacked_params
from smplxpp.core.params import BodyParams


@pytest.mark.parametrize("frames", [1, 3])
def test_registered_parameters_without_offsets_are_read_whatever_their_number(tmp_path, frames):
    # A registration of a single frame asked for the offsets that its file does not have.
    params = BodyParams.concatenate([BodyParams.rest()] * frames)
    arrays = {name: array for name, array in params.as_dict().items() if name != "v_shape"}
    np.savez(tmp_path / "params.npz", **arrays)
    numbers, found = load_stacked_params(tmp_path / "params.npz")
    assert numbers == tuple(range(frames)) and len(found) == frames
