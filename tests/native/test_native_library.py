"""What is handed to the native library, and what it hands back: threads, addresses, interfaces, forks."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from smplxpp import native
from smplxpp.core import Camera, InputError, TriangleMesh
from smplxpp.raster import rasterize_mesh, rasterize_triangles

ROOT = Path(__file__).parents[2]


@pytest.fixture
def triangle() -> TriangleMesh:
    return TriangleMesh(np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.0, 0.5, 0.0]]), np.array([[0, 1, 2]]))


@pytest.fixture
def camera() -> Camera:
    return Camera.orthographic_view(center=np.zeros(3), direction=np.array([0.0, 0.0, 1.0]), half_extent=1.0, size=40)


@pytest.mark.parametrize("asked", [0, -5, 2.0, True, "4"])
def test_a_number_of_threads_that_means_nothing_is_refused(triangle, camera, asked):
    with pytest.raises(InputError, match="threads: expected an integer of 1 or more"):
        rasterize_mesh(triangle, camera, threads=asked)


def test_any_number_of_threads_gives_the_same_picture(triangle, camera):
    pictures = [rasterize_mesh(triangle, camera, threads=asked).depth for asked in (1, 3, 2**40, np.int64(2), None)]
    assert np.isfinite(pictures[0]).any()
    for picture in pictures[1:]:
        np.testing.assert_array_equal(picture, pictures[0])
    assert native.thread_count(2**40) == native.MOST_THREADS


@pytest.mark.parametrize(("said", "threads"), [("1", 1), ("3,2", 3), ("64", 4), ("0", 4), ("many", 4), ("", 4)])
def test_a_process_that_has_few_threads_by_its_environment_does_not_take_one_a_cpu(monkeypatch, said, threads):
    monkeypatch.setattr(native.os, "cpu_count", lambda: 4)
    monkeypatch.setenv("OMP_NUM_THREADS", said)
    assert native.thread_count() == threads
    assert native.thread_count(4) == 4  # a caller that says how many


def test_arrays_that_a_kernel_would_misread_are_refused(triangle, camera):
    vertices, faces = triangle.vertices, triangle.faces
    for bad in ([[0, 1, 3]], [[-1, 1, 2]], [[0, 1, 2**32]], [[0, 1]], [[0.0, 1.0, 2.0]]):
        with pytest.raises(InputError, match="mesh faces"):
            rasterize_triangles(vertices, np.array(bad), camera)
    for bad in (vertices[:, :2], vertices.astype(object), vertices[0]):
        with pytest.raises(InputError, match="mesh vertices"):
            rasterize_triangles(bad, faces, camera)
    with pytest.raises(InputError, match="near"):
        rasterize_triangles(vertices, faces, camera, near=float("nan"))
    with pytest.raises(InputError, match="image size"):
        rasterize_triangles(vertices, faces, Camera(camera.K, camera.cam_from_world, 2**32 + 40, 1))


def test_an_address_is_of_the_right_numbers_in_order():
    ones = np.ones((4, 4), np.float32)
    assert native.address(ones).value == ones.ctypes.data
    assert native.address(None).value is None
    for bad in (ones.T[:2].T, ones.astype(np.float64), torch.ones(4, 4).t()[:2].t(), torch.ones(4).double()):
        with pytest.raises(TypeError, match="contiguous float32"):
            native.address(bad)


def test_an_address_keeps_its_array_alive():
    pointer = native.address(torch.arange(1000.0))
    assert pointer.array.sum() == 499500


def test_a_library_from_other_sources_is_not_called(monkeypatch):
    monkeypatch.setattr(native, "INTERFACE", native.INTERFACE + 1)
    with pytest.raises(ImportError, match="was built from other sources"):
        native.native_library.__wrapped__()


def test_a_status_is_an_exception():
    for status, error in ((1, MemoryError), (2, InputError), (3, native.OverLimitError), (4, RuntimeError)):
        with pytest.raises(error):
            native._check_status(status, native.native_library().smplxpp_interpolate, ())


def test_face_ids_beyond_the_faces_are_refused():
    from avatar.rendering.barycentrics import InterpolateFunction

    values, weights, faces = torch.rand(3, 2), torch.rand(2, 2, 3), torch.tensor([[0, 1, 2]], dtype=torch.int32)
    for ids, corners in ((1, faces), (2**30, faces), (0, faces + 1)):
        with pytest.raises(InputError, match="indices"):
            InterpolateFunction.apply(values, weights, corners, torch.full((2, 2), ids, dtype=torch.int32))
    with pytest.raises(TypeError, match="int32"):
        InterpolateFunction.apply(values, weights, faces.long(), torch.zeros(2, 2, dtype=torch.int32))


def run(program: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", program],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "2"},
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, f"{done.returncode}: {done.stdout}{done.stderr}"
    return done.stdout


WORK = """
import os, signal, sys
import torch
from avatar.losses.image_similarity import ssim
from tests.rendering.scenes import gradients, random_scene

def work():
    x = torch.linspace(0, 1, 3 * 300 * 300).view(300, 300, 3).requires_grad_()
    ssim(x, x.detach().flip(0)).backward()
    torch.ones(1_000_000).exp().sum()
    return [float(x.grad.abs().sum()), *(float(g.abs().sum()) for g in gradients(random_scene(3), "cpu").values())]
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork")
@pytest.mark.long
def test_a_fork_after_a_native_call_works_with_one_thread():
    program = WORK + (
        """
torch.set_num_threads(2)
truth = work()
child = os.fork()
if not child:
    signal.alarm(600)
    assert torch.get_num_threads() == 1
    assert all(abs(a - b) <= 1e-4 * abs(b) for a, b in zip(work(), truth, strict=True))
    os._exit(0)
print(os.waitpid(child, 0)[1])
"""
    )
    assert run(program) == "0\n"


@pytest.mark.long
def test_torch_may_ask_for_more_threads_than_any_machine_has():
    assert run(WORK + "torch.set_num_threads(1000)\nwork()\nprint('drawn')") == "drawn\n"
