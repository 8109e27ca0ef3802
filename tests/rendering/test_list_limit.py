"""Scenes whose lists of Gaussians by tile would fill the memory are refused before they do."""

from __future__ import annotations

import pytest
import torch

from avatar.rendering import memory, rasterize
from smplxpp.core.errors import InputError


@pytest.fixture
def limit(monkeypatch):
    """Sets the limit in GiB."""

    def set_limit(value: str) -> None:
        monkeypatch.setenv(memory.VARIABLE, value)
        memory.list_bytes.cache_clear()

    yield set_limit
    monkeypatch.undo()
    memory.list_bytes.cache_clear()


def walls(count: int, size: int = 640) -> tuple[torch.Tensor, ...]:
    """Gaussians that each cover the whole picture, as arguments of `rasterize` without its size."""
    means = torch.rand(count, 3) * 0.1
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    pose, K = torch.eye(4), torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]])
    pose[2, 3] = 3.0
    return (
        means,
        quats,
        torch.full((count, 3), 9.0),
        torch.full((count,), 0.5),
        torch.rand(count, 3),
        pose[None],
        K[None],
    )


def test_too_many_large_gaussians_are_refused_with_their_number(limit):
    limit("0.005")
    with pytest.raises(InputError) as caught:
        rasterize(*walls(700), 640, 640)
    message = str(caught.value)
    assert "1,120,000 entries (0.025 GiB): 700 visible Gaussians that cover 1,600 tiles each of 640 x 640" in message
    assert "within 0.005 GiB" in message and f"{memory.VARIABLE}=GIB raises the limit" in message


def test_they_are_drawn_where_the_limit_allows(limit):
    limit("0.1")
    image, alpha, _ = rasterize(*walls(700), 640, 640)
    assert alpha.min() > 0.99 and image.isfinite().all()


def test_the_rasteriser_draws_on_after_a_refusal(limit):
    limit("0.005")
    with pytest.raises(InputError):
        rasterize(*walls(700), 640, 640)
    assert rasterize(*walls(5), 640, 640)[1].min() > 0.9


@pytest.mark.parametrize("value", ["", "much", "-1", "0", "nan", "inf"])
def test_a_limit_that_is_no_number_is_refused(limit, value):
    limit(value)
    with pytest.raises(InputError, match=memory.VARIABLE):
        rasterize(*walls(1), 16, 16)


def test_without_a_word_of_the_environment_it_is_half_a_gibibyte_or_more(limit, monkeypatch):
    monkeypatch.delenv(memory.VARIABLE, raising=False)
    for free, expected in ((0, 1 / 2), (8 << 30, 2), (1 << 40, 4)):
        memory.list_bytes.cache_clear()
        monkeypatch.setattr(memory, "_free_bytes", lambda free=free: free)
        assert memory.list_bytes() == expected * 2**30


def test_features_that_would_overflow_the_gradients_are_refused():
    *gaussians, features, pose, K = walls(3, 16)
    features[1, 2] = 1e38
    with pytest.raises(InputError, match=r"features: expected magnitudes up to 1e\+20"):
        rasterize(*gaussians, features, pose, K, 16, 16)
    features[1, 2] = -1e20
    features.requires_grad_()
    gaussians[2].requires_grad_()
    rasterize(*gaussians, features, pose, K, 16, 16, background=torch.full((3,), 1e20))[0].sum().backward()
    assert features.grad.isfinite().all() and gaussians[2].grad.isfinite().all()
