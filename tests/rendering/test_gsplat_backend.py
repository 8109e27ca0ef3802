"""The CUDA backend: that gsplat is asked for the right thing, where it may be imported, and, on a GPU, what it draws.

Where there is no GPU a stand-in with gsplat 1.5's signature draws with the reference, so that the mapping of arguments
and results is put to the test. The comparisons with the reference on a GPU are those of test_rasterize_invariance.py.
"""

from __future__ import annotations

import subprocess
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch

from avatar.rendering import RasterSettings, rasterize
from avatar.rendering.gsplat_backend import rasterize_gsplat
from avatar.rendering.reference import rasterize_reference
from smplxpp.core.errors import InputError, MissingExtraError
from tests.rendering.scenes import Scene, random_scene

NAMES = ("means", "quats", "scales", "opacities", "features", "viewmats", "Ks", "background")


def stand_in(
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    near_plane=0.01,
    far_plane=1e10,
    radius_clip=0.0,
    eps2d=0.3,
    sh_degree=None,
    packed=True,
    tile_size=16,
    backgrounds=None,
    render_mode="RGB",
    sparse_grad=False,
    absgrad=False,
    rasterize_mode="classic",
    channel_chunk=32,
    distributed=False,
    camera_model="pinhole",
):
    """gsplat 1.5's `rasterization` for the options that have the semantics of the reference, and no others."""
    assert (radius_clip, sh_degree, packed, render_mode) == (0.0, None, False, "RGB")
    assert (rasterize_mode, camera_model, absgrad, distributed) == ("classic", "pinhole", False, False)
    assert backgrounds is None or backgrounds.shape == (len(viewmats), colors.shape[-1])
    settings = RasterSettings(width, height, near_plane, far_plane, eps2d)
    tensors = (means, quats, scales, opacities, colors, viewmats, Ks, backgrounds)
    image, alpha, meta = rasterize_reference(*tensors, settings)
    garbage = torch.where(meta.visible[..., None], meta.means2d, float("nan"))
    return image, alpha, {"radii": meta.radii.ceil().int(), "means2d": garbage + 0 * means.sum(), "depths": meta.depths}


@pytest.fixture
def fake_gsplat(monkeypatch) -> ModuleType:
    package, cuda, backend = (ModuleType(name) for name in ("gsplat", "gsplat.cuda", "gsplat.cuda._backend"))
    package.__version__, package.rasterization, package.cuda = "1.5.3", stand_in, cuda
    cuda._backend, backend._C = backend, SimpleNamespace()
    for module in (package, cuda, backend):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    return package


def arguments(scene: Scene) -> list[torch.Tensor]:
    return [getattr(scene, name) for name in NAMES]


@pytest.mark.parametrize("features_per_camera", [False, True])
@pytest.mark.parametrize("with_background", [False, True])
def test_arguments_and_results_are_mapped(fake_gsplat, features_per_camera, with_background):
    scene = random_scene(41, cameras=2, features_per_camera=features_per_camera)
    scene = scene if with_background else scene.replace(background=None)
    settings = RasterSettings(scene.width, scene.height, near=2.8, far=3.3, eps2d=0.7)
    image, alpha, meta = rasterize_gsplat(*arguments(scene), settings)
    expected, expected_alpha, expected_meta = rasterize_reference(*arguments(scene), settings)
    assert torch.equal(image, expected)
    assert torch.equal(alpha, expected_alpha)
    assert torch.equal(meta.means2d, expected_meta.means2d)
    assert torch.equal(meta.visible, expected_meta.visible)
    assert torch.equal(meta.depths, expected_meta.depths)
    assert not meta.visible.all()


def test_meta_carries_no_gradients(fake_gsplat):
    leaves = [tensor.clone().requires_grad_() for tensor in arguments(random_scene(42))]
    _, _, meta = rasterize_gsplat(*leaves, RasterSettings(45, 37))
    assert not any(tensor.requires_grad for tensor in (meta.means2d, meta.radii, meta.depths))


def test_another_version_is_refused(fake_gsplat):
    """Its clamp of alpha is another, and the images would differ without a word."""
    fake_gsplat.__version__ = "1.6.0"
    with pytest.raises(InputError, match=r"1\.5\.x.*received 1\.6\.0.*pip install"):
        rasterize_gsplat(*arguments(random_scene(43)), RasterSettings(45, 37))


def test_kernels_that_were_not_compiled(fake_gsplat):
    fake_gsplat.cuda._backend._C = None
    with pytest.raises(InputError, match="nvcc"):
        rasterize_gsplat(*arguments(random_scene(43)), RasterSettings(45, 37))


def test_missing_gsplat_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "gsplat", None)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    with pytest.raises(MissingExtraError, match=r"extra cuda"):
        rasterize_gsplat(*arguments(random_scene(43)), RasterSettings(45, 37))


def test_without_a_gpu_gsplat_is_not_touched(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(InputError, match="CUDA device"):
        rasterize_gsplat(*arguments(random_scene(43)), RasterSettings(45, 37))


def test_cpu_tensors_do_not_reach_gsplat():
    scene = random_scene(43).mapped(torch.Tensor.float)
    with pytest.raises(InputError, match="float32 on cuda"):
        rasterize(**vars(scene), backend="gsplat")


@pytest.mark.long
def test_importing_the_renderer_imports_no_backend():
    code = (
        "import sys, avatar.rendering, avatar.rendering.gsplat_backend;"
        "print([m for m in sys.modules if m.startswith(('gsplat', 'avatar.rendering.cpu'))])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=900, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat needs a CUDA device")
def test_cuda_tensors_go_to_gsplat():
    scene = random_scene(44, cameras=2)
    image, alpha, meta = rasterize(**vars(scene.of("gsplat")), depth="expected")
    expected, expected_alpha, expected_meta = rasterize(**vars(scene), backend="reference", depth="expected")
    assert image.is_cuda
    np.testing.assert_allclose(image.cpu(), expected, atol=1e-4)
    np.testing.assert_allclose(alpha.cpu(), expected_alpha, atol=2e-5)
    np.testing.assert_allclose(meta.depth.cpu(), expected_meta.depth, atol=1e-4)
