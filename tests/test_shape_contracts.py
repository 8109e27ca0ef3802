"""The check of signatures itself: what it catches and what it lets pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from jaxtyping import Float, Int
from torch import Tensor

from smplxpp.core.mesh import TriangleMesh
from tests.shape_contracts import ContractError, _checked_dataclass, checked


def moved(points: Float[np.ndarray, "n 3"], by: Float[np.ndarray, "n 3"] | None = None) -> Float[np.ndarray, "n 3"]:
    return points if by is None else points + by


def lost(points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Int[Tensor, " n"]]:
    return points, torch.zeros(len(points) + 1, dtype=torch.int64)


def refusing(points: Float[np.ndarray, "n 3"]) -> None:
    raise ValueError("no")


def test_a_call_that_keeps_its_signature_passes():
    points = np.zeros((4, 3))
    assert checked(moved)(points, by=points).shape == (4, 3)
    assert checked(moved)(points) is points


@pytest.mark.parametrize("by", [np.zeros((1, 3)), np.zeros((4, 3), int)])
def test_other_shapes_and_dtypes_are_caught(by):
    with pytest.raises(ContractError, match="by should be"):
        checked(moved)(np.zeros((4, 3)), by)


def test_what_is_returned_is_checked():
    with pytest.raises(ContractError, match="return"):
        checked(lost)(torch.zeros(4, 3))


def test_a_refusal_of_the_function_comes_first():
    with pytest.raises(ValueError, match="no"):
        checked(refusing)(np.zeros(3))


def test_fields_of_a_dataclass():
    @dataclass
    class Pair:
        a: Float[np.ndarray, "n 3"]
        b: Float[np.ndarray, " n"]

    _checked_dataclass(Pair)
    Pair(np.zeros((2, 3)), np.zeros(2))
    with pytest.raises(ContractError, match="b should be"):
        Pair(np.zeros((2, 3)), np.zeros(3))


def test_modules_of_the_packages_are_checked():
    assert hasattr(TriangleMesh.with_vertices, "__wrapped__")
