"""Perceptual distances: structure with random weights, the authors' weights where their package is installed."""

from __future__ import annotations

import importlib.util

import pytest
import torch
from torch import nn

from avatar.losses.perceptual import (
    STORED_CONVS,
    WEIGHT_FILE,
    PackagedLPIPS,
    ShiftTolerantLPIPS,
    load_lpips,
    load_st_lpips,
)
from smplxpp.core.errors import InputError, MissingExtraError


@pytest.fixture
def images():
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(2, 3, 8, 6, generator=generator)
    smooth = nn.functional.interpolate(coarse, size=(48, 40), mode="bilinear").permute(0, 2, 3, 1)
    return smooth.contiguous(), torch.randn(2, 48, 40, 3, generator=generator)


@pytest.fixture
def random_metric():
    torch.manual_seed(0)
    return ShiftTolerantLPIPS()


def stored_weights(metric: ShiftTolerantLPIPS) -> dict[str, torch.Tensor]:
    """Weights under the names and in the shapes of the authors' file."""
    stored = {"scaling_layer.shift": metric.shift[None].clone(), "scaling_layer.scale": metric.scale[None].clone()}
    for k, (name, conv) in enumerate(zip(STORED_CONVS, metric.convs, strict=True)):
        stored[f"{name}.weight"], stored[f"{name}.bias"] = conv.weight.clone(), conv.bias.clone()
        stored[f"lin{k}.model.1.weight"] = metric.layer_weights[k][None, :, None, None].clone()
    return stored


def test_distance_is_one(random_metric, images):
    image, noise = images
    other = (image + 0.1 * noise).clamp(0, 1)
    assert random_metric.name == "ST-LPIPS"
    assert torch.equal(random_metric(image, image), torch.zeros(2))
    torch.testing.assert_close(random_metric(image, other), random_metric(other, image))
    assert (random_metric(image, other) > 0).all()
    # Each pair of the batch is a distance of its own.
    torch.testing.assert_close(random_metric(image[1:], other[1:])[0], random_metric(image, other)[1])


def test_gradient_flows_to_the_image_alone(random_metric, images):
    image, noise = images
    image.requires_grad_()
    random_metric(image, (image + 0.1 * noise).detach()).mean().backward()
    assert torch.isfinite(image.grad).all() and image.grad.abs().sum() > 0
    assert all(p.grad is None and not p.requires_grad for p in random_metric.parameters())


def test_gradient_is_finite_on_black_images(random_metric):
    image = torch.zeros(1, 40, 40, 3, requires_grad=True)
    random_metric(image, torch.zeros(1, 40, 40, 3)).sum().backward()
    assert torch.isfinite(image.grad).all()


def test_weights_of_a_file(tmp_path, random_metric, images):
    path = tmp_path / "weights.pth"
    torch.save(stored_weights(random_metric), path)
    image, noise = images
    restored = load_st_lpips(path)
    torch.testing.assert_close(restored(image, image + noise), random_metric(image, image + noise))


def test_refused_files(tmp_path, random_metric):
    path = tmp_path / "weights.pth"
    path.write_bytes(b"not a file of torch")
    with pytest.raises(InputError, match=r"weights\.pth"):
        load_st_lpips(path)
    torch.save([1, 2], path)
    with pytest.raises(InputError, match="tensors by name"):
        load_st_lpips(path)
    stored = stored_weights(random_metric)
    del stored["net.slice3.9.bias"]
    torch.save(stored, path)
    with pytest.raises(InputError, match=r"convs\.2\.bias"):
        load_st_lpips(path)


def test_refused_images(random_metric):
    for a, b in (((1, 40, 40, 3), (1, 40, 41, 3)), ((1, 16, 40, 3), (1, 16, 40, 3)), ((40, 40, 3), (40, 40, 3))):
        with pytest.raises(InputError, match="images for ST-LPIPS"):
            random_metric(torch.zeros(a), torch.zeros(b))


def test_missing_packages_name_the_command(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(MissingExtraError, match="pip install --no-deps stlpips-pytorch"):
        load_st_lpips()
    monkeypatch.setitem(__import__("sys").modules, "lpips", None)
    with pytest.raises(MissingExtraError, match="pip install lpips"):
        load_lpips()
    with pytest.raises(InputError, match="backbone"):
        load_lpips("squeeze")


def test_packaged_lpips_gets_images_in_its_range(images):
    class Recorder(nn.Module):
        def forward(self, x, y):
            self.seen = x
            return (x - y).square().mean((1, 2, 3), keepdim=True)

    network = Recorder()
    metric = PackagedLPIPS(network, "vgg")
    image, noise = images
    assert metric.name == "LPIPS (vgg)"
    assert metric(image, image + noise).shape == (2,)
    torch.testing.assert_close(network.seen, 2 * image.permute(0, 3, 1, 2) - 1)


@pytest.mark.skipif(importlib.util.find_spec("stlpips_pytorch") is None, reason="stlpips-pytorch is not installed")
def test_authors_weights(images):
    metric = load_st_lpips()
    image, noise = images
    noisy = (image + 0.1 * noise).clamp(0, 1)
    shifted = image.roll(1, dims=2)
    shifted[:, :, 0] = image[:, :, 0]
    assert (metric(image, noisy) > 10 * metric(image, shifted)).all()
    folder = importlib.util.find_spec("stlpips_pytorch").submodule_search_locations[0]
    stored = torch.load(f"{folder}/{WEIGHT_FILE}", map_location="cpu", weights_only=True)
    # The file's own low-pass filters are the one that is written into the code.
    for name in ("net.slice1.1.filt", "net.slice2.4.filt", "net.slice3.8.filt"):
        torch.testing.assert_close(stored[name], metric.binomial.expand(len(stored[name]), -1, -1, -1))
