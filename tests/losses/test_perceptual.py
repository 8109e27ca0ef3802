"""Perceptual distances: structure with random weights, the authors' weights where their package is installed."""

from __future__ import annotations

import importlib.util
import pickle
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from avatar.losses.perceptual import BACKBONES, LPIPS, STORED_CONVS, ShiftTolerantLPIPS
from avatar.losses.perceptual_weights import (
    WEIGHT_FILE,
    load_lpips,
    load_metric,
    load_st_lpips,
    lpips_at_hand,
)
from smplxpp.core.errors import InputError, MissingExtraError
from tests.dolls.lpips import NETWORKS, lpips_weights


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
        load_lpips(backbone="squeeze")


def windows(x: np.ndarray, width: int, step: int) -> np.ndarray:
    """Windows of an image (C, H, W): (C, h, w, width, width)."""
    return np.lib.stride_tricks.sliding_window_view(x, (width, width), axis=(1, 2))[:, ::step, ::step]


def slow_lpips(backbone: str, weights: dict[str, torch.Tensor], images: list[np.ndarray]) -> float:
    """LPIPS of two images (H, W, 3) in [0, 1], in float64."""
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    features = []
    for image in images:
        x, found = ((2.0 * image - 1.0 - shift) / scale).transpose(2, 0, 1), []
        for layer in NETWORKS[backbone]:
            if layer == "out":
                found.append(x / np.sqrt((x**2).sum(axis=0)))
            elif layer[0] == "max":
                x = windows(x, layer[1], 2).max(axis=(3, 4))
            else:
                number, _, _, width, step, pad = layer
                kernel, bias = (weights[f"features.{number}.{name}"].double().numpy() for name in ("weight", "bias"))
                seen = windows(np.pad(x, ((0, 0), (pad, pad), (pad, pad))), width, step)
                x = np.maximum(np.tensordot(kernel, seen, ((1, 2, 3), (0, 3, 4))) + bias[:, None, None], 0.0)
        features.append(found)
    return sum(
        float((weights[f"lin{k}.model.1.weight"].double().numpy().reshape(-1, 1, 1) * (f - g) ** 2).sum(axis=0).mean())
        for k, (f, g) in enumerate(zip(*features, strict=True))
    )


@pytest.fixture(scope="module", params=["alex", "vgg"])
def lpips_case(request, tmp_path_factory):
    """A backbone, its weights in two files as they are published, two pairs of images, and their true distances."""
    folder = tmp_path_factory.mktemp(request.param)
    of_torchvision, own = lpips_weights(request.param)
    torch.save(of_torchvision, folder / BACKBONES[request.param].file)
    torch.save(own, folder / f"{request.param}.pth")
    pictures = np.random.default_rng(0).random((3, 40, 36, 3))
    stored = {**of_torchvision, **own}
    true = [slow_lpips(request.param, stored, [pictures[k], pictures[2]]) for k in (0, 1)]
    return SimpleNamespace(name=request.param, folder=folder, weights=stored, pictures=pictures, true=true)


def measured(metric: LPIPS, case: SimpleNamespace) -> torch.Tensor:
    images = torch.tensor(case.pictures, dtype=torch.float32)
    return metric(images[:2], images[2:].expand(2, -1, -1, -1))


def test_lpips_is_that_of_a_slow_reference(lpips_case):
    files = (lpips_case.folder / BACKBONES[lpips_case.name].file, lpips_case.folder / f"{lpips_case.name}.pth")
    metric = load_lpips(files)
    assert metric.name == f"LPIPS ({lpips_case.name})"
    found = measured(metric, lpips_case)
    np.testing.assert_allclose(found.numpy(), lpips_case.true, rtol=2e-5)
    image = torch.tensor(lpips_case.pictures[:1], dtype=torch.float32)
    assert metric(image, image).tolist() == [0.0]


def test_lpips_reads_a_state_of_the_package(lpips_case, tmp_path):
    state = {name: value for name, value in lpips_case.weights.items() if name.startswith("lin")}
    for layer, own in enumerate(BACKBONES[lpips_case.name].layers, start=1):
        for number in own:
            for kind in ("weight", "bias"):
                state[f"net.slice{layer}.{number}.{kind}"] = lpips_case.weights[f"features.{number}.{kind}"]
    save_file(state, tmp_path / "all.safetensors")
    np.testing.assert_allclose(
        measured(load_lpips([tmp_path / "all.safetensors"]), lpips_case).numpy(), lpips_case.true, rtol=2e-5
    )


def test_lpips_needs_no_torchvision_where_its_weights_lie(lpips_case, tmp_path, monkeypatch):
    """The package's own weights are read beside the backbone in torch's folder of downloads; neither's code runs."""
    package, cache = tmp_path / "lpips" / "weights" / "v0.1", tmp_path / "hub" / "checkpoints"
    package.mkdir(parents=True)
    cache.mkdir(parents=True)
    there = SimpleNamespace(submodule_search_locations=[str(tmp_path / "lpips")])
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: there if name == "lpips" else None)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    monkeypatch.setitem(__import__("sys").modules, "lpips", None)
    assert not lpips_at_hand(lpips_case.name)
    file = BACKBONES[lpips_case.name].file
    (cache / file).write_bytes((lpips_case.folder / file).read_bytes())
    (package / f"{lpips_case.name}.pth").write_bytes((lpips_case.folder / f"{lpips_case.name}.pth").read_bytes())
    assert lpips_at_hand(lpips_case.name)
    np.testing.assert_allclose(
        measured(load_lpips(backbone=lpips_case.name), lpips_case).numpy(), lpips_case.true, rtol=2e-5
    )


def test_files_of_other_weights_are_refused(lpips_case, tmp_path, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    backbone = lpips_case.folder / BACKBONES[lpips_case.name].file
    with pytest.raises(InputError, match=r"lin0\.model\.1\.weight.*received none"):
        load_lpips([backbone])
    other = tmp_path / "other.pth"
    torch.save({"lin0.model.1.weight": torch.rand(1, 7, 1, 1)}, other)
    with pytest.raises(InputError, match=r"shape \(7|shape \(1, 7"):
        load_metric("lpips", weights=(backbone, other))


class Calls:
    """Calls a function where it is unpickled."""

    def __reduce__(self):
        return (Path.touch, (Path("called"),))


def test_no_code_of_a_file_of_weights_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for write in (lambda file: torch.save({"features.0.weight": Calls()}, file), pickled):
        write(tmp_path / "evil.pth")
        with pytest.raises(InputError, match=r"evil\.pth"):
            load_lpips([tmp_path / "evil.pth"])
        assert not (tmp_path / "called").exists()


def pickled(path: Path) -> None:
    path.write_bytes(pickle.dumps(Calls()))


@pytest.mark.skipif(importlib.util.find_spec("lpips") is None, reason="lpips is not installed")
def test_the_packages_own_weights_fit(lpips_case, tmp_path):
    """Those of version 0.1 have the channels of our layers and are not negative, as their authors trained them."""
    metric = load_lpips([lpips_case.folder / BACKBONES[lpips_case.name].file])
    assert all((weights >= 0).all() and weights.any() for weights in metric.layer_weights)


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
