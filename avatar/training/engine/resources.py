"""Resources of a training: device and seed, memory and disk, and errors that explain when these run out."""

from __future__ import annotations

import ctypes
import errno
import logging
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

try:
    import resource
except ModuleNotFoundError:  # Windows
    resource = None  # type: ignore[assignment]

import torch
from torch import Tensor, nn

from avatar.models.networks.teacher import Teacher, TeacherConfig
from smplxpp.core.errors import InputError

NO_MEMORY = ("out of memory", "can't allocate memory", "not enough memory")
"""Texts in messages of CUDA's libraries and of CPU allocators, which have no exception class of their own."""
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# Options of glibc's malloc.h: sizes in bytes from which freed memory returns to the system, and one that none reaches.
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD, _NEVER = -1, -3, 1 << 30


def peak_memory(device: str = "cpu") -> dict[str, int]:
    """Return the peak memory of this process, bytes: of the machine (Windows does not tell), and of the GPU it uses."""
    unit = 1 if sys.platform == "darwin" else 1024
    found = {"host": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit} if resource else {}
    if device.startswith("cuda"):
        found["device"] = torch.cuda.max_memory_allocated(device)
    return found


def keep_freed_memory() -> bool:
    """Have the allocator keep freed memory for the next step; return whether it can (only glibc's does).

    Steps of a training allocate the same tens of megabytes repeatedly. If they return to the system each time, they
    come back as thousands of empty pages, which costs a tenth of a step of the compensation on two cores. The setting
    holds for the whole process.
    """
    if not sys.platform.startswith("linux"):
        return False
    # Only glibc has mallopt with these options.
    libc = ctypes.CDLL(None)
    if not hasattr(libc, "gnu_get_libc_version"):
        return False
    return all(libc.mallopt(option, _NEVER) == 1 for option in (_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD))


@contextmanager
def half_of_the_threads() -> Iterator[None]:
    """Compute with half of torch's threads in the block, because another process has the other cores."""
    threads = torch.get_num_threads()
    torch.set_num_threads(max(1, threads // 2))
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@contextmanager
def explain_resource_errors(folder: Path) -> Iterator[None]:
    """Turn errors of memory and disk within the block into an `InputError`; all others pass.

    Args:
        folder: where checkpoints and results go.
    """
    try:
        yield
    # Memory: exceptions of Python and torch, or messages of allocators.
    except (MemoryError, RuntimeError) as error:
        words = str(error)
        known = isinstance(error, MemoryError | torch.cuda.OutOfMemoryError)
        if not (known or any(part in words.lower() for part in NO_MEMORY)):
            raise
        raise InputError(
            "memory",
            expected="room for a step of the training",
            received=words.splitlines()[0] if words else type(error).__name__,
            remedy="end other programs and give the same command, which continues from the last checkpoint; or take a "
            "smaller preset, smaller images (--scale) or fewer Gaussians",
        ) from error
    # Disk: no space, quota, or file size.
    except OSError as error:
        if error.errno not in NO_SPACE:
            raise
        raise InputError(
            f"disk of {folder}",
            expected="room for checkpoints and results",
            received=error.strerror or str(error),
            remedy="free some space and give the same command, which continues from the last checkpoint",
        ) from error


@dataclass(frozen=True)
class StageMemory:
    """What a stage of a training needs at most, GiB, as it is foretold.

    Attributes:
        host: of the machine's memory.
        device: of what tensors of the step take, on a GPU or, without one, of the machine's memory.
    """

    host: float
    device: float


def foretell_memory(
    recipe: Any,
    *,
    megapixels: float,
    images: int,
    frames: int = 1,
    cache_gib: float = 1.0,
    steps: Collection[str] | None = None,
) -> dict[str, StageMemory]:
    """Return what the stages of a training need, by the name of their step; within a third of what was measured.

    The tracking, "track", is a part of the teacher's stage. What it and the refinement of poses need are the tensors
    that CUDA's operations were counted to hold; a CPU's losses hold fewer.

    Parameters take 16 bytes, with gradients and Adam's moments. What the teacher's networks keep for their backward
    pass is counted by passing shapes through them. A picture takes bytes a pixel of the person, who fills two fifths,
    and bytes a Gaussian; all views of a pose are kept until their backward pass.

    Args:
        recipe: a `Recipe`.
        megapixels: of an image.
        images: of all training frames.
        frames: number of these frames.
        cache_gib: bound of the photographs in memory.
        steps: names of the steps that are asked for; None: all.
    """
    preset, gib = recipe.preset, 2.0**30
    count = preset.fit.sampling.count
    # Bytes a pixel: of images, losses and SSIM, and of features of the perceptual networks at full size.
    a_pixel = 700.0 + {"st-lpips": 1200.0, "lpips": 250.0}.get(recipe.perceptual, 0.0)
    a_view = 0.4e6 * megapixels * a_pixel + 500.0 * count
    attributes = 16.0 * 25.0 * count
    learned, kept = _network_bytes(preset.networks.teacher, preset.teacher.views) if recipe.teacher else (0.0, 0.0)
    shapes = recipe.shapes
    basis = 2.0 * 3.0 * count * (shapes.head_shapes + shapes.body_shapes)
    # Known displacements of the frames; and gradients of activations beside them, measured 1.15 of what is kept.
    known = min(1.0 * gib, 16.0 * count * images)
    device = _bytes_before_networks(recipe, 0.4e6 * megapixels, images=images, frames=frames) | {
        "fit": attributes + a_view,
        "teacher": 16.0 * learned + 1.15 * kept + attributes + preset.teacher.views * a_view + known,
        "bake": 4.0 * learned + attributes + preset.bake.views * a_view + known,
        "compensate": 16.0 * basis + attributes + preset.compensate.views * a_view,
    }
    if preset.bake.images == "teacher":
        device["bake"] += 0.3 * kept + 2.0 * gib
    # Imports and template, photographs, poses; a checkpoint is copied, and put together as bytes.
    photographs = min(cache_gib * gib, 4e6 * megapixels * images)
    written = {"teacher": 24.0 * learned, "compensate": 24.0 * basis}
    host = {step: 1.3 * gib + photographs + written.get(step, 0.0) for step in device}
    return {
        step: StageMemory(host[step] / gib, own / gib)
        for step, own in device.items()
        if (step != "teacher" or recipe.teacher) and (steps is None or {"track": "teacher"}.get(step, step) in steps)
    }


def _bytes_before_networks(recipe: Any, pixels: float, *, images: int, frames: int) -> dict[str, float]:
    """Return the bytes of the tensors in the refinement of poses and in the tracking, where a recipe has them.

    Args:
        recipe: a `Recipe`.
        pixels: of the person in an image.
        images: of all training frames.
        frames: number of these frames.
    """
    # Bytes a pixel: of a view whose structure tensor is taken; of a view that waits for its backward pass; of the view
    # whose loss is computed, with SSIM; and of a photograph in 8 bits with its halved ones.
    of_structure, of_view, of_loss, of_photograph = 210.0, 190.0, 1060.0, 4.0 * 4.0 / 3.0
    found, a_gaussian = {}, 500.0
    if recipe.refine is not None:
        # One view of a frame at a time; as many frames at a time as torch has threads.
        of_frame = of_structure * pixels + a_gaussian * recipe.refine.sampling.count
        found["refine"] = torch.get_num_threads() * of_frame
    if recipe.follows:
        track, count = recipe.preset.teacher.track, recipe.preset.fit.sampling.count
        step = of_loss * pixels + track.views * (of_view * pixels + a_gaussian * count)
        # Displacements, structure tensors, the simulation's and the errors' covariances of all frames, in float32.
        kept = 4.0 * (3 + 9 + 3 + 2 * 9) * track.control_points * frames
        photographs = of_photograph * pixels * images / frames
        found["track"] = step + kept + photographs + 100.0 * count
        joint = recipe.preset.teacher.joint
        if joint is not None:
            # One view, the Gaussians' attributes, and every frame's displacements beside corrections that learn.
            learned = 16.0 * (25.0 * count + 3.0 * joint.control_points * frames)
            corrected = (of_loss + of_view) * pixels + a_gaussian * count + learned
            found["track"] = max(found["track"], corrected + 4.0 * 3.0 * joint.control_points * frames)
    return found


def _network_bytes(config: TeacherConfig, views: int) -> tuple[float, float]:
    """Return the number of parameters of a teacher, and the bytes that a pass of one pose keeps for its gradients."""
    kept: dict[int, int] = {}
    held: list[Tensor] = []

    def keep(tensor: Tensor) -> Tensor:
        held.append(tensor)  # so that no other takes its place
        storage = tensor.untyped_storage()
        kept[storage._cdata] = storage.nbytes()
        return tensor

    # Tensors without numbers: shapes alone.
    with torch.device("meta"), torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
        networks = Teacher(config)
        side = config.in_size
        maps = torch.zeros(1, 2, side, side, 3)
        networks(maps, maps, torch.zeros(views, 2, side, side) if config.sees_view else None)
    parameters = list(networks.parameters())
    own = {one.untyped_storage()._cdata for one in parameters}
    return sum(one.numel() for one in parameters), sum(size for place, size in kept.items() if place not in own)


def check_memory(foretold: Mapping[str, StageMemory], device: str) -> None:
    """Compare what the stages need with the memory of the GPU, before any work.

    Raises:
        InputError: a stage that needs half more than the GPU has. Less than that is a warning.
    """
    if not device.startswith("cuda") or not foretold:
        return
    step, need = max(((step, one.device) for step, one in foretold.items()), key=lambda pair: pair[1])
    there = torch.cuda.mem_get_info()[1] / 2**30
    remedy = "take smaller images (--scale 0.5 needs a quarter of a picture's), fewer --gaussians, or a smaller preset"
    if need > 1.5 * there:
        raise InputError(
            "memory of the GPU",
            expected=f"about {need:.1f} GiB for the stage {step}",
            received=f"{there:.1f} GiB",
            remedy=remedy,
        )
    if need > 0.9 * there:
        log.warning("the stage %s needs about %.1f GiB of the GPU's %.1f: if it ends, %s", step, need, there, remedy)


log = logging.getLogger(__name__)
Compiled = Literal["off", "graphs", "inductor"]


def allow_tf32(precision: str) -> None:
    """Let convolutions of a GPU round their inputs to 11 bits, as torch does by default; not for "float32".

    Products of matrices stay in float32 for all, because places in the world are among them.
    """
    torch.backends.cudnn.allow_tf32 = precision != "float32"


def compile_networks(networks: Iterable[nn.Module], how: Compiled, *, tolerance: float = 0.02) -> None:
    """Compile the forward passes of networks whose inputs keep their shapes, backward passes included.

    The first call with gradients compiles a network and compares outputs and gradients with those of the plain one; a
    network that fails, or differs, computes as before, and a warning says why. Calls without gradients, of other
    shapes or of another precision are computed as before.

    Args:
        networks: on a GPU; others stay as they are.
        how: "graphs": CUDA graphs, which take seconds and the memory of the activations once more; "inductor": torch's
            compiler, which takes minutes and needs a C++ compiler; "off": not at all.
        tolerance: largest difference that passes, as a share of the largest value: bfloat16 rounds to 1 / 256.
    """
    for network in networks:
        if how != "off" and next(network.parameters()).is_cuda:
            network.forward = _Compiled(network, how, tolerance)


class _Compiled:
    """The forward pass of a network, compiled for the inputs of its first call with gradients.

    Args:
        network: whose `forward` it takes the place of.
        how: see `compile_networks`.
        tolerance: see there.
    """

    def __init__(self, network: nn.Module, how: Compiled, tolerance: float) -> None:
        self.network, self.plain, self.how, self.tolerance = network, network.forward, how, tolerance
        self.compiled: Callable[..., Any] | None = None
        self.kind: tuple[Any, ...] | None = None
        self.failed = False

    def __call__(self, *inputs: Tensor | None) -> Any:
        """Return what the plain pass returns."""
        given = tuple(one for one in inputs if one is not None)
        kind = (
            torch.is_autocast_enabled("cuda"),
            *((None if one is None else (one.shape, one.dtype, one.requires_grad)) for one in inputs),
        )
        if self.failed or not torch.is_grad_enabled() or self.kind not in (None, kind):
            return self.plain(*inputs)
        if self.compiled is None:
            self.kind = kind
            places = [place for place, one in enumerate(inputs) if one is not None]
            try:
                self._compile(given, places, len(inputs))
            except Exception as error:  # noqa: BLE001  whatever a compiler raises, the network itself computes
                self.failed = True
                log.warning("a network is not compiled and computes as before: %s", str(error).split("\n")[0][:300])
                return self.plain(*inputs)
        assert self.compiled is not None
        return self.compiled(*given)

    def _compile(self, given: tuple[Tensor, ...], places: Sequence[int], count: int) -> None:
        """Compile the plain pass for some inputs, and compare it with itself."""

        def plain(*tensors: Tensor) -> tuple[Tensor, ...]:
            placed: list[Tensor | None] = [None] * count
            for place, tensor in zip(places, tensors, strict=True):
                placed[place] = tensor
            return tuple(self.plain(*placed))

        module = _Pass(self.network, plain)
        truth = self._gradients(plain, given)
        if self.how == "graphs":
            samples = tuple(one.detach().clone().requires_grad_(one.requires_grad) for one in given)
            made = torch.cuda.make_graphed_callables(module, samples, allow_unused_input=True)
            # Graphs write gradients to the same memory in each call, which the next micro-batch would overwrite.
            for parameter in self.network.parameters():
                parameter.register_hook(torch.clone)
        else:
            made = torch.compile(module, dynamic=False)
        for name, found, own in zip(("outputs", "gradients"), self._gradients(made, given), truth, strict=True):
            for one, other in zip(found, own, strict=True):
                apart = float((one - other).abs().max()) if one.numel() else 0.0
                if not apart <= self.tolerance * max(float(other.abs().max()), 1e-6):
                    raise RuntimeError(f"its {name} differ by {apart:.2g}")
        self.compiled = made

    def _gradients(self, run: Callable[..., Any], given: tuple[Tensor, ...]) -> tuple[list[Tensor], list[Tensor]]:
        """Return outputs, and the gradients of their mean square by the parameters, copied."""
        outputs = list(run(*(one.detach() for one in given)))
        loss = torch.stack([one.float().square().mean() for one in outputs]).sum()
        parameters = list(self.network.parameters())
        found = torch.autograd.grad(loss, parameters, allow_unused=True)
        gradients = [torch.zeros_like(p) if g is None else g.clone() for g, p in zip(found, parameters, strict=True)]
        return [one.detach().float().clone() for one in outputs], gradients


class _Pass(nn.Module):
    """A forward pass as a module, whose parameters are those of a network."""

    def __init__(self, network: nn.Module, run: Callable[..., Any]) -> None:
        super().__init__()
        self.network, self._run = network, run

    def forward(self, *inputs: Tensor) -> Any:
        """Return what the pass returns."""
        return self._run(*inputs)


def choose_device(name: str) -> str:
    """Return "cpu" or "cuda" for "auto", "cpu" or "cuda"; auto takes CUDA where a GPU and gsplat are available.

    Raises:
        InputError: CUDA where there is none.
    """
    if name == "auto":
        if not torch.cuda.is_available():
            return "cpu"
        if find_spec("gsplat") is None:
            log.warning(
                "there is a GPU, but gsplat is not installed: training on the CPU (install '.[cuda]' in the checkout)"
            )
            return "cpu"
        return "cuda"
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "option device",
            expected="a CUDA device that torch can use",
            received="none",
            remedy="leave it out to train on the CPU, or install torch's build for CUDA where there is a GPU",
        )
    return name


def count_gpus(device: str) -> int:
    """Return the number of GPUs that torch can use where the device is "cuda", else 0."""
    return torch.cuda.device_count() if device == "cuda" else 0


@contextmanager
def fixed_seed(seed: int) -> Iterator[None]:
    """Seed the CPU's random numbers within the block, and restore their state after it."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield
