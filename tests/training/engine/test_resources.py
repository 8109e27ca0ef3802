"""What a training asks of the machine's memory."""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from avatar.data.views import View
from avatar.models.networks.teacher import Teacher
from avatar.models.tracked_surface import TrackedAvatar
from avatar.training.engine.resources import (
    StageMemory,
    _Compiled,
    check_memory,
    compile_networks,
    foretell_memory,
)
from avatar.training.recipe import TrainConfig
from avatar.training.refinement.config import RefineConfig
from avatar.training.refinement.photometric import PhotometricLoss
from avatar.training.tracking.config import Level
from avatar.training.tracking.track import TrackTask
from smplxpp.core.errors import InputError
from tests.dolls.dancing import cameras as cameras_of_dance
from tests.dolls.dancing import gaussians, sequence, write_dance
from tests.dolls.tiny import TINY_TEACHER
from tests.pretended_cuda import pretended_cuda

ROOT = Path(__file__).resolve().parents[3]
CHILD = """
import resource
import torch
from avatar.training.engine.resources import keep_freed_memory

def faults():
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

def use():  # beyond what malloc keeps by itself in any layout of the heap
    return torch.ones(1 << 24)

def of_five():
    for _ in range(20):  # small blocks in between have found their places after two to eight uses, by the heap's start
        use()
    before = faults()
    for _ in range(5):
        use()
    return faults() - before

before = of_five()
assert keep_freed_memory()
print(before, of_five())
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's allocator alone can be told")
@pytest.mark.long
def test_freed_memory_is_kept_for_the_next_step():
    done = subprocess.run([sys.executable, "-c", CHILD], capture_output=True, text=True, check=True, timeout=900)
    usual, kept = map(int, done.stdout.split())
    assert kept < 1000 < usual


def stored(name: str) -> dict:
    return json.loads((ROOT / "benchmarks" / "results" / f"{name}.json").read_text())["figures"]


@pytest.mark.long
def test_memory_is_foretold_within_a_third_of_what_was_measured():
    found = foretell_memory(TrainConfig().recipe("paper"), megapixels=3.0, images=4)
    measured = stored("gpu")["parts"]["paper_step"]["found"]["gpu_memory_gib"]
    assert max(one.device for one in found.values()) == pytest.approx(measured, rel=1 / 3)
    # On a CPU all of it is the machine's.
    sizes = {"training_woman_casual_cpu_tracked": ("cpu", 0.384 * 0.64, 48 * 12)}
    for name, (preset, megapixels, images) in sizes.items():
        found = foretell_memory(TrainConfig().recipe(preset), megapixels=megapixels, images=images)["compensate"]
        measured = stored(name)["stages"]["90_compensate"]["peak_memory_gib"]
        assert found.host + found.device == pytest.approx(measured, rel=1 / 3)


@pytest.mark.long
def test_more_gaussians_pixels_and_views_need_more_memory():
    def most(megapixels=1.0, **options):
        found = foretell_memory(TrainConfig(**options).recipe("gpu"), megapixels=megapixels, images=100)
        return {step: one.device for step, one in found.items()}

    usual = most()
    assert all(more > usual[step] for step, more in most(megapixels=4.0).items())
    assert all(more > usual[step] for step, more in most(gaussians=540_000).items())
    assert list(most(teacher=False)) == ["fit", "bake", "compensate"]


def allocated(work) -> int:
    """The most bytes of torch's tensors that some work had at a time, without copies that suit one kind of CPU."""
    # oneDNN pads channels to the width of the CPU's vectors: 8 or 16 in the place of 3. A GPU does not.
    before = torch._C._get_mkldnn_enabled()
    torch._C._set_mkldnn_enabled(False)
    try:
        with torch.profiler.profile(profile_memory=True) as profile:
            work()
    finally:
        torch._C._set_mkldnn_enabled(before)
    assert profile.profiler is not None and profile.profiler.kineto_results is not None
    events = [(e.start_ns(), e.nbytes()) for e in profile.profiler.kineto_results.events() if e.name() == "[memory]"]
    return max(itertools.accumulate(size for _, size in sorted(events)))


def white_views(width: int, height: int) -> list[View]:
    """Photographs on the pretended device by the cameras of the dance, all of them person."""
    cameras = list(cameras_of_dance().values())[:4]
    zoom = np.diag([width / cameras[0].width, height / cameras[0].height, 1.0])
    sized = [replace(camera, width=width, height=height, K=zoom @ camera.K) for camera in cameras]
    white = torch.full((height, width, 4), 255, dtype=torch.uint8).to("cuda")
    return [View(camera, white[..., :3], white[..., 3]) for camera in sized]


@pytest.mark.long
def test_refinement_and_tracking_take_the_tensors_that_are_foretold(tmp_path, monkeypatch):
    width, height = 450, 600
    recipe = replace(TrainConfig(gaussians=2000).recipe("demo"), refine=RefineConfig())
    track = replace(recipe.preset.teacher.track, control_points=24, levels=(Level(0, 2, 1e-3),), simulate=False)
    preset = replace(recipe.preset, teacher=replace(recipe.preset.teacher, track=track))
    # The person is taken to fill two fifths of an image.
    images = {"megapixels": 2.5e-6 * width * height, "images": 16, "frames": 4}
    found = foretell_memory(replace(recipe, preset=preset), **images, steps=("refine", "teacher"))
    with pretended_cuda():
        frames, views = sequence(write_dance(tmp_path / "dance"), device="cuda"), white_views(width, height)
        # A frame of the refinement, of which there are as many at a time as threads.
        loss = PhotometricLoss(frames.rig.faces, frames.background, recipe.refine)
        bound, vertices = gaussians(recipe.refine.sampling.count).to(device="cuda"), frames.rig.skin(frames.pose(0))
        one = partial(loss.linearize, bound, vertices.detach(), views, halvings=0)
        assert found["refine"].device / torch.get_num_threads() == pytest.approx(allocated(one) / 2**30, rel=1 / 3)
        # A step of the tracking.
        avatar = TrackedAvatar(frames.rig, gaussians(2000).to(device="cuda"), track.control_points)
        task = TrackTask(frames, avatar, replace(track, views=len(views)))
        monkeypatch.setattr(task, "views", lambda item: views)
        task.step(0)
        assert found["track"].device == pytest.approx(allocated(partial(task.step, 1)) / 2**30, rel=1 / 3)


def test_a_refinement_that_does_not_fit_a_gpu_is_refused_before_work():
    recipe = replace(TrainConfig().recipe("gpu"), refine=RefineConfig())
    large = {"images": 16, "frames": 1, "steps": ("refine",)}
    with pretended_cuda():
        check_memory(foretell_memory(recipe, megapixels=3.0, **large), "cuda")
        with pytest.raises(InputError, match="for the stage refine"):
            check_memory(foretell_memory(recipe, megapixels=1e4, **large), "cuda")
        with pytest.raises(InputError, match="for the stage track"):
            check_memory(
                foretell_memory(recipe, megapixels=3.0, images=10**7, frames=10**6, steps=("teacher",)), "cuda"
            )


def test_a_gpu_with_too_little_memory_is_told_before_work(caplog):
    with pretended_cuda():
        check_memory({}, "cuda")  # a refinement of poses alone ended in a ValueError
        check_memory({"fit": StageMemory(1.0, 60.0)}, "cuda")
        assert not caplog.text
        check_memory({"fit": StageMemory(1.0, 2.0), "teacher": StageMemory(1.0, 75.0)}, "cuda")
        assert "stage teacher needs about 75.0 GiB of the GPU's 80.0" in caplog.text
        with pytest.raises(InputError, match=r"130.0 GiB for the stage bake, received 80.0 GiB.*--scale 0.5"):
            check_memory({"bake": StageMemory(1.0, 130.0)}, "cuda")
    check_memory({"bake": StageMemory(1.0, 1e6)}, "cpu")


class Doubled(nn.Module):
    """Two outputs of an input and a weight, one of them seen by an optional second input."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([2.0, 3.0]))

    def forward(self, x, y=None):
        return [x * self.weight, self.weight.square() if y is None else y * self.weight]


def graphed(module, samples, *, allow_unused_input, wrong=0.0):
    """What CUDA's graphs are to their users: outputs and gradients lie in memory that the next call overwrites."""
    assert allow_unused_input
    held = [one.clone() for one in samples]
    parameters = list(module.parameters())
    outputs = [one.detach().clone() for one in module(*held)]
    gradients = [torch.zeros_like(one) for one in parameters]

    class Graph(torch.autograd.Function):
        @staticmethod
        def forward(ctx, *inputs):
            with torch.enable_grad():
                ctx.made = module(*inputs[: len(held)])
            for kept, new in zip(outputs, ctx.made, strict=True):
                kept.copy_(new.detach() + wrong)
            return tuple(one.detach() for one in outputs)

        @staticmethod
        def backward(ctx, *incoming):
            for kept, new in zip(gradients, torch.autograd.grad(ctx.made, parameters, incoming), strict=True):
                kept.copy_(new)
            return (*[None] * len(held), *(one.detach() for one in gradients))

    return lambda *inputs: Graph.apply(*inputs, *parameters)


def compiled_on(made, monkeypatch) -> tuple[Doubled, list[str]]:
    """A network of a pretended GPU that is recorded as a graph by its first call with gradients."""
    calls = []
    plain = Doubled.forward
    monkeypatch.setattr(Doubled, "forward", lambda self, *inputs: calls.append("plain") or plain(self, *inputs))
    monkeypatch.setattr(torch.cuda, "make_graphed_callables", made)
    network = Doubled().to("cuda")
    compile_networks([network], "graphs")
    return network, calls


def test_gradients_of_graphs_add_up_over_micro_batches(monkeypatch):
    with pretended_cuda():
        network, _ = compiled_on(graphed, monkeypatch)
        for value in (1.0, 10.0):
            x = torch.full((2,), value, device="cuda")
            first, second = network(x)
            (first.sum() + second.sum()).backward()
        assert network.weight.grad.tolist() == [1.0 + 10.0 + 2 * 2 * 2.0, 1.0 + 10.0 + 2 * 2 * 3.0]


def test_other_shapes_and_calls_without_gradients_are_not_compiled(monkeypatch):
    with pretended_cuda():
        network, calls = compiled_on(graphed, monkeypatch)
        network(torch.ones(2, device="cuda"))
        calls.clear()
        network(torch.ones(2, device="cuda"))
        once = len(calls)
        one, two = network(torch.ones(2, device="cuda"), torch.ones(2, device="cuda"))
        assert len(calls) == once + 1 and one.tolist() == two.tolist() == [2.0, 3.0]
        assert network(torch.ones(3, 2, device="cuda"))[0].shape == (3, 2) and len(calls) == once + 2
        with torch.no_grad():
            network(torch.ones(2, device="cuda"))
        assert len(calls) == once + 3


def failing(module, samples, *, allow_unused_input):
    raise ValueError("no such graph\nand more")


@pytest.mark.parametrize(
    ("made", "why"), [(failing, "no such graph"), (partial(graphed, wrong=0.5), "its outputs differ by 0.5")]
)
def test_a_network_that_cannot_be_compiled_or_differs_computes_as_before(made, why, monkeypatch, caplog):
    with pretended_cuda():
        network, _ = compiled_on(made, monkeypatch)
        for _ in range(2):
            found = network(torch.ones(2, device="cuda"))[0]
            assert found.tolist() == [2.0, 3.0]
            found.sum().backward()
        assert network.weight.grad.tolist() == [2.0, 2.0]
    assert caplog.text.count("not compiled") == 1 and why in caplog.text and "and more" not in caplog.text


def test_networks_of_the_cpu_are_left_alone():
    network = Doubled()
    compile_networks([network], "graphs")
    assert "forward" not in vars(network)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # the compiler's own
def test_torchs_compiler_gives_a_network_of_convolutions_the_same_gradients(monkeypatch):
    compiler = torch.compile
    monkeypatch.setattr(torch, "compile", lambda module, **named: compiler(module, backend="aot_eager", **named))
    torch.manual_seed(0)
    (network,) = Teacher(replace(TINY_TEACHER, zero_output=False)).networks.values()
    x = torch.randn(1, network.config.in_channels, network.config.in_size, network.config.in_size)
    truth = network(x)[0]
    truth.square().sum().backward()
    own = {name: p.grad for name, p in network.named_parameters()}
    network.zero_grad()
    found = _Compiled(network, "inductor", 1e-4)
    out = found(x)[0]
    out.square().sum().backward()
    assert not found.failed and torch.allclose(out, truth, atol=1e-5)
    for name, parameter in network.named_parameters():
        one, other = (torch.zeros_like(parameter) if g is None else g for g in (parameter.grad, own[name]))
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-4)
