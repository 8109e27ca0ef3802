"""Around the kernels: memory that goes back, threads, and what autograd may ask for."""

from __future__ import annotations

import gc
import threading

import pytest
import torch

from avatar.rendering import cpu, memory, rasterize
from avatar.rendering.cpu import rasterize_cpu
from avatar.rendering.settings import RasterSettings
from smplxpp.core.errors import InputError
from tests.rendering.scenes import Scene, random_scene

NAMES = ("means", "quats", "scales", "opacities", "features", "viewmats", "Ks", "background")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(11, count=200, width=50, height=40, channels=5, cameras=2).of("cpu")


def leaves_of(scene: Scene) -> Scene:
    leaves = scene.mapped(lambda tensor: tensor.clone().requires_grad_())
    return leaves.replace(Ks=scene.Ks)


def grads_of(leaves: Scene) -> list[torch.Tensor]:
    return [getattr(leaves, name).grad.clone() for name in NAMES if name != "Ks"]


def backward_of(scene: Scene, weights: torch.Tensor) -> list[torch.Tensor]:
    leaves = leaves_of(scene)
    image, alpha, _ = rasterize(**vars(leaves), camera_gradients=True)
    torch.autograd.backward([image, alpha], [weights, weights[..., :1]])
    return grads_of(leaves)


def test_the_same_twice_bit_for_bit(scene):
    weights = torch.randn(2, 40, 50, 5, generator=torch.Generator().manual_seed(0))
    first, second = backward_of(scene, weights), backward_of(scene, weights)
    assert all(map(torch.equal, first, second))


@pytest.mark.parametrize("threads", [1, 2, 3, 7])
def test_the_number_of_threads_changes_no_pixel_and_rounds_gradients(scene, threads):
    weights = torch.randn(2, 40, 50, 5, generator=torch.Generator().manual_seed(1))
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        image, expected = rasterize(**vars(scene))[0], backward_of(scene, weights)
        torch.set_num_threads(threads)
        assert torch.equal(rasterize(**vars(scene))[0], image)
        again, once_more = backward_of(scene, weights), backward_of(scene, weights)
    finally:
        torch.set_num_threads(before)
    assert all(map(torch.equal, again, once_more))
    for ours, theirs in zip(again, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=2e-6 * float(theirs.abs().max()))


def test_gradients_that_are_not_contiguous(scene):
    weights = torch.randn(5, 50, 40, 2, generator=torch.Generator().manual_seed(2)).permute(3, 2, 1, 0)
    assert not weights.is_contiguous()
    assert all(map(torch.equal, backward_of(scene, weights), backward_of(scene, weights.contiguous())))


@pytest.mark.parametrize("of", ["image", "alpha"])
def test_gradient_of_one_output_alone(scene, of):
    """Equal to that of both with zero for the other."""
    weights = torch.randn(2, 40, 50, 5, generator=torch.Generator().manual_seed(3))
    leaves, both = leaves_of(scene), leaves_of(scene)
    image, alpha, _ = rasterize(**vars(leaves), camera_gradients=True)
    (image * weights if of == "image" else alpha * weights[..., :1]).sum().backward()
    image, alpha, _ = rasterize(**vars(both), camera_gradients=True)
    (image * weights * (of == "image")).sum().add((alpha * weights[..., :1] * (of == "alpha")).sum()).backward()
    for name in NAMES:
        if name not in ("Ks", "background"):
            assert torch.equal(getattr(leaves, name).grad, getattr(both, name).grad), name


def test_zero_flows_as_zero(scene):
    assert not any(grad.any() for grad in backward_of(scene, torch.zeros(2, 40, 50, 5)))


def test_the_graph_can_be_walked_twice(scene):
    leaves = leaves_of(scene)
    loss = rasterize(**vars(leaves))[0].square().sum()
    loss.backward(retain_graph=True)
    once = leaves.means.grad.clone()
    loss.backward()
    torch.testing.assert_close(leaves.means.grad, 2 * once, rtol=0, atol=0)


def test_a_second_derivative_is_refused(scene):
    leaves = leaves_of(scene)
    (grad,) = torch.autograd.grad(rasterize(**vars(leaves))[0].square().sum(), leaves.means, create_graph=True)
    with pytest.raises(RuntimeError, match=r"once_differentiable|differentiate twice"):
        grad.sum().backward()


def test_no_graph_without_gradients(scene):
    with torch.no_grad():
        image = rasterize(**vars(leaves_of(scene)))[0]
    assert not image.requires_grad
    assert torch.equal(image, rasterize(**vars(scene))[0])


def test_a_changed_picture_does_not_change_gradients(scene):
    """The backward pass needs no output of the forward pass."""
    leaves, expected = leaves_of(scene), leaves_of(scene)
    rasterize(**vars(expected))[0].sum().backward()
    image = rasterize(**vars(leaves))[0]
    total = image.sum()
    with torch.no_grad():
        image.mul_(0)
    total.backward()
    assert torch.equal(leaves.means.grad, expected.means.grad)


def test_memory_goes_back_to_the_pool_and_is_used_again(scene):
    gc.collect()
    for _ in range(3):
        rasterize(**vars(leaves_of(scene)))[0].sum().backward()
        rasterize(**vars(leaves_of(scene)))  # never walked back
    before = len(cpu._POOL._idle)
    kept = [rasterize(**vars(leaves_of(scene)))[0] for _ in range(2)]
    assert len(cpu._POOL._idle) <= max(0, before - 2)
    del kept
    assert len(cpu._POOL._idle) >= before
    for _ in range(4):
        rasterize(**vars(leaves_of(scene)))[0].sum().backward()
    assert len(cpu._POOL._idle) <= max(before, 4)


def test_the_pool_frees_what_is_beyond_its_limit(scene, monkeypatch):
    monkeypatch.setattr(cpu, "IDLE_BYTES", 0)
    before = len(cpu._POOL._idle)
    rasterize(**vars(scene))
    assert len(cpu._POOL._idle) <= before


def test_memory_of_large_pictures_is_used_again_but_never_while_it_is_seen(monkeypatch):
    monkeypatch.setattr(memory, "POOLED_BYTES", 1024)
    monkeypatch.setattr(memory, "_idle", [])
    first = memory.pooled_empty(3, 50, 40)
    address, row = first.data_ptr(), first[1, 2]
    del first
    second = memory.pooled_empty(3, 50, 40)
    assert second.data_ptr() != address
    row.fill_(7.0)
    del row
    assert memory.pooled_empty(50, 3, 40).data_ptr() == address
    assert memory.pooled_empty(3, 50, 41).data_ptr() != address


def test_idle_memory_has_a_limit(monkeypatch):
    monkeypatch.setattr(memory, "POOLED_BYTES", 1024)
    monkeypatch.setattr(memory, "IDLE_BYTES", 100_000)
    monkeypatch.setattr(memory, "_idle", [])
    tensors = [memory.pooled_empty(10_000) for _ in range(5)]
    del tensors
    assert sum(array.nbytes for array in memory._idle) <= 100_000
    assert len(memory._idle) == 2


def test_two_threads_of_python_at_once(scene):
    weights = torch.randn(2, 40, 50, 5, generator=torch.Generator().manual_seed(4))
    other = scene.replace(means=scene.means + 0.1)
    expected = {id(s): backward_of(s, weights) for s in (scene, other)}
    wrong = []

    def work(s: Scene):
        for _ in range(5):
            if not all(map(torch.equal, backward_of(s, weights), expected[id(s)])):
                wrong.append(s)

    workers = [threading.Thread(target=work, args=(s,)) for s in (scene, other)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert not wrong


def test_double_precision_is_not_rounded_in_silence(scene):
    arguments = [getattr(scene, name).double() for name in NAMES]
    with pytest.raises(InputError, match="reference"):
        rasterize_cpu(*arguments, RasterSettings(50, 40))


def test_meta_carries_no_gradients(scene):
    meta = rasterize(**vars(leaves_of(scene)))[2]
    assert not any(tensor.requires_grad for tensor in (meta.means2d, meta.radii, meta.depths))


def test_one_camera_with_one_far_gaussian_in_many():
    """The tile lists of one huge Gaussian cover the picture; the others cover a pixel or two each."""
    scene = random_scene(13, count=50, width=120, height=90, sigma=0.002).of("cpu")
    scales = scene.scales.clone()
    scales[7] = 50.0
    image, alpha, meta = rasterize(**vars(scene.replace(scales=scales)))
    assert alpha.min() > 0.01
    assert torch.isfinite(image).all()
    assert meta.radii[0, 7].min() > 1000
