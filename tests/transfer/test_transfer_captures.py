"""Weights against authored ones, where captures with a known truth lie beside the checkout."""

from __future__ import annotations

import warnings

import pytest

from benchmarks.accuracy.driving import judge
from benchmarks.support.people import read_capture_truth
from smplxpp.core.errors import GeometryWarning
from smplxpp.transfer import TransferConfig, transfer_weights


@pytest.mark.slow
def test_a_driven_skirt_is_nearer_to_the_authored_one_than_by_the_published_method(captures):
    truth = read_capture_truth(captures / "woman_casual")
    part = truth.parts["lower"]
    source = truth.body.mesh(truth.body.forward(truth.exact).vertices[0])
    errors = {}
    for name, config in (("paper", TransferConfig.paper()), ("ours", TransferConfig.for_label("lower"))):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", GeometryWarning)
            dense = transfer_weights(source, truth.body.weights, part.mesh, config=config).dense()
        errors[name] = judge(truth, part, dense, truth.exact, 2)
    for pose, mean in (("high_step", 19.0), ("squat", 12.5)):
        assert errors["ours"][pose]["mean"] < min(mean, 0.85 * errors["paper"][pose]["mean"])
        assert errors["ours"][pose]["p95"] < 0.75 * errors["paper"][pose]["p95"]
    assert errors["ours"]["high_step"]["stretch_p999"] < 6
