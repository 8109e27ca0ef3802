from __future__ import annotations

import math

import pytest
import torch

from avatar.losses.image import d_ssim, l1, psnr
from avatar.losses.ssim import ssim
from smplxpp.core.errors import InputError


def test_values_by_hand():
    x, y = torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.1)
    assert float(l1(x, y)) == pytest.approx(0.1)
    assert float(psnr(x, y)) == pytest.approx(20.0, abs=1e-4)
    assert float(psnr(x, x)) == math.inf
    assert float(d_ssim(x, x)) == pytest.approx(0.0, abs=1e-6)


def test_masks_weigh_pixels():
    x = torch.zeros(2, 2, 3)
    y = x.clone()
    y[0, 0], y[0, 1] = 0.1, 0.5
    assert float(l1(x, y, mask=torch.tensor([[1.0, 0.0], [0.0, 0.0]]))) == pytest.approx(0.1)
    assert float(l1(x, y, mask=torch.tensor([[3.0, 1.0], [0.0, 0.0]]))) == pytest.approx(0.2)
    assert float(psnr(x, y, mask=torch.tensor([[True, False], [False, False]]))) == pytest.approx(20.0, abs=1e-4)
    batch = torch.stack([x, x]), torch.stack([y, x])
    assert float(l1(*batch, mask=torch.ones(2, 2))) == pytest.approx(float(l1(x, y)) / 2)
    one = torch.stack([torch.ones(2, 2), torch.zeros(2, 2)])
    assert float(l1(*batch, mask=one)) == pytest.approx(float(l1(x, y)))


def test_d_ssim_is_not_halved_and_has_gradients():
    x, y = torch.rand(20, 20, 3, requires_grad=True), torch.rand(20, 20, 3)
    loss = d_ssim(x, y)
    assert loss.item() == pytest.approx(1 - ssim(x, y).item())
    loss.backward()
    assert x.grad.abs().max() > 0


@pytest.mark.parametrize("loss", [l1, psnr, d_ssim])
def test_bad_input_is_refused(loss):
    with pytest.raises(InputError, match="one shape"):
        loss(torch.rand(4, 4, 3), torch.rand(4, 5, 3))
    with pytest.raises(InputError, match="mask"):
        loss(torch.rand(4, 4, 3), torch.rand(4, 4, 3), mask=torch.ones(5, 4))
    with pytest.raises(InputError, match="some weight"):
        loss(torch.rand(4, 4, 3), torch.rand(4, 4, 3), mask=torch.zeros(4, 4))
