"""Our conventions against those of gsplat, by the torch reference that its package carries: it runs without a GPU.

Its file is read alone. The package's `__init__` would look for a CUDA toolkit to compile kernels with.

Of gsplat's blending the part that is torch is run: pixel centres, the exponent, the clamp of alpha. Weights along a ray
come from `nerfacc` there, whose product along rays has a CUDA kernel alone; the six lines of `_weights` stand for it.
Which Gaussians a pixel sees (alpha of 1/255 or more, transmittance above 1e-4) is a CUDA kernel in gsplat too;
`_pairs` says the rule of its `RasterizeToIndices3DGS.cu`.
"""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from torch import Tensor

from avatar.export.posed import posed_splats
from avatar.gaussians.binding import world_from_frames
from avatar.gaussians.colors import view_colors
from avatar.gaussians.frames import triangle_frames
from avatar.rendering.gsplat_backend import SUPPORTED
from avatar.rendering.mesh_maps import MapFrame
from avatar.rendering.reference import _project, rasterize_reference
from avatar.rendering.settings import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN, RasterSettings
from smplxpp.core.camera import Camera
from smplxpp.core.spherical_harmonics import C0, coefficient_count, sh_basis
from tests.gaussians.bound_scenes import random_bound, sphere
from tests.rendering.scenes import Scene, draw, random_scene

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def gsplat() -> ModuleType:
    """gsplat's functions in torch."""
    found = importlib.util.find_spec("gsplat")
    if found is None or not found.submodule_search_locations:
        pytest.skip("gsplat is not installed: pip install --no-deps 'gsplat>=1.5.3,<1.6'")
    folder = Path(found.submodule_search_locations[0])
    version = _loaded("gsplat_version", folder / "version.py").__version__
    if not version.startswith(SUPPORTED):
        pytest.skip(f"gsplat {version} is installed, our conventions are those of {SUPPORTED}x")
    return _loaded("gsplat_torch_impl", folder / "cuda" / "_torch_impl.py")


def _loaded(name: str, path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def projected(gsplat: ModuleType, scene: Scene, eps2d: float) -> tuple[Tensor, ...]:
    """Radii, means2d, depths, conics by gsplat's reference."""
    covariances, _ = gsplat._quat_scale_to_covar_preci(scene.quats, scene.scales, compute_preci=False)
    size = (scene.width, scene.height)
    return gsplat._fully_fused_projection(scene.means, covariances, scene.viewmats, scene.Ks, *size, eps2d=eps2d)[:4]


SCENES = pytest.mark.parametrize(
    "scene",
    [random_scene(1), random_scene(2, cameras=2, sigma=0.15), random_scene(3, spread=1.2, sigma=0.03)],
    ids=["cloud", "two cameras, large", "wide, small"],
)
EPS2D = pytest.mark.parametrize("eps2d", [0.1, 0.3])


@SCENES
@EPS2D
def test_projection(gsplat, scene, eps2d):
    radii, means2d, depths, conics = projected(gsplat, scene, eps2d)
    settings = RasterSettings(scene.width, scene.height, eps2d=eps2d)
    meta = rasterize_reference(*_arguments(scene), settings)[2]
    assert meta.visible.any()
    # What we cull cannot reach 1/255; gsplat's reference knows no opacity, and keeps more.
    assert (radii.bool().all(-1) | ~meta.visible).all()
    seen = meta.visible
    differences = {
        "means2d": (means2d - meta.means2d)[seen].abs().max(),
        "depths": (depths - meta.depths).abs().max(),
        "conics": max(_conic_difference(scene, camera, settings, conics[camera]) for camera in range(len(depths))),
    }
    for name, difference in differences.items():
        assert difference < 1e-9, name
    fast = draw(scene, "cpu", eps2d=eps2d)[2]
    torch.testing.assert_close(fast.means2d.double()[seen], means2d[seen], atol=1e-3, rtol=1e-5)
    torch.testing.assert_close(fast.depths.double(), depths, atol=1e-5, rtol=1e-6)


@SCENES
@EPS2D
def test_blending(gsplat, scene, eps2d, monkeypatch):
    nerfacc = SimpleNamespace(render_weight_from_alpha=_weights, accumulate_along_rays=_accumulated)
    monkeypatch.setitem(sys.modules, "nerfacc", nerfacc)
    _, means2d, depths, conics = projected(gsplat, scene, eps2d)
    cameras, features = len(depths), scene.features
    opacities, features = scene.opacities.expand(cameras, -1), features.expand(cameras, *features.shape[-2:])
    pairs = _pairs(scene, means2d, depths, conics)
    image, alpha = gsplat.accumulate(means2d, conics, opacities, features, *pairs, scene.width, scene.height)
    image = image + (1 - alpha) * scene.background[:, None, None]
    for backend, tolerance in (("reference", 1e-9), ("cpu", 2e-5)):
        ours, our_alpha, _ = draw(scene, backend, eps2d=eps2d)
        torch.testing.assert_close(ours, image, atol=tolerance * float(image.abs().max()), rtol=0)
        torch.testing.assert_close(our_alpha, alpha, atol=tolerance, rtol=0)


def test_cameras_of_maps_and_captures(gsplat):
    points = torch.tensor(np.random.default_rng(0).normal(0, 0.5, (50, 3)))
    nothing = torch.zeros(50, 3, 3, dtype=torch.float64)
    frame = MapFrame.of(points.numpy(), half_extent=2.0)
    front, back = frame.cameras(256)
    pinhole = Camera.look_at(eye=np.array([1.0, 1.2, 3.0]), target=np.zeros(3), fov_y_deg=40.0, width=320, height=240)
    for camera, project in ((front, gsplat._ortho_proj), (back, gsplat._ortho_proj), (pinhole, gsplat._persp_proj)):
        pose, K = (torch.tensor(matrix)[None] for matrix in (camera.cam_from_world, camera.K))
        inside, covariances = gsplat._world_to_cam(points, nothing, pose)
        theirs = project(inside, covariances, K, camera.width, camera.height)[0][0].numpy()
        ours = camera.screen_from_world(points.numpy())
        np.testing.assert_allclose(ours[:, :2], theirs, atol=1e-9)
        np.testing.assert_allclose(ours[:, 2], inside[0, :, 2].numpy(), atol=1e-12)
        if camera is not pinhole:
            np.testing.assert_allclose(frame.pixels_from_canonical(points, 256).numpy(), theirs, atol=1e-9)


def test_spherical_harmonics(gsplat):
    directions = torch.nn.functional.normalize(torch.randn(500, 3, dtype=torch.float64), dim=-1)
    for degree in range(4):
        theirs = gsplat._eval_sh_bases_fast((degree + 1) ** 2, directions)[..., 1:]
        difference = (sh_basis(directions, degree) - theirs).abs()
        assert theirs.shape[-1] == coefficient_count(degree) and (difference < 1e-12).all()
    assert math.isclose(float(gsplat._eval_sh_bases_fast(1, directions[:1])), C0, rel_tol=1e-9)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_bound_gaussians_look_as_their_splats(gsplat, degree):
    vertices, faces = sphere()
    bound = random_bound(faces, degree=degree)
    frames = triangle_frames(vertices, faces)
    world = world_from_frames(bound, frames)
    eye = torch.tensor([[0.4, 1.5, 3.0]], dtype=torch.float64)
    ours = view_colors(bound, frames, world.means, eye)[0]
    # A file holds float32.
    splats = posed_splats(bound, vertices, faces)
    coefficients = torch.tensor(np.concatenate([splats.f_dc[:, None], splats.f_rest], axis=1)).double()
    theirs = (gsplat._spherical_harmonics(degree, world.means - eye, coefficients) + 0.5).clamp_min(0.0)
    torch.testing.assert_close(theirs, ours, atol=5e-6, rtol=0)
    quats, scales = torch.tensor(splats.quats).double(), torch.tensor(splats.log_scales).double().exp()
    by_file, _ = gsplat._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    by_pose, _ = gsplat._quat_scale_to_covar_preci(world.quats, world.scales, compute_preci=False)
    torch.testing.assert_close(by_file, by_pose, atol=1e-6 * float(by_pose.abs().max()), rtol=0)


def _arguments(scene: Scene) -> tuple[Tensor | None, ...]:
    names = ("means", "quats", "scales", "opacities", "features", "viewmats", "Ks", "background")
    return tuple(getattr(scene, name) for name in names)


def _conic_difference(scene: Scene, camera: int, settings: RasterSettings, conics: Tensor) -> Tensor:
    """Largest difference between our conics of the visible Gaussians and `conics`, as a share of the largest entry."""
    gaussians = (scene.means, scene.quats, scene.scales, scene.opacities)
    ours = _project(*gaussians, scene.viewmats[camera], scene.Ks[camera], settings)
    return ((ours.conics - conics[ours.index]).abs() / ours.conics.abs().amax(1, keepdim=True)).max()


def _pairs(scene: Scene, means2d: Tensor, depths: Tensor, conics: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Gaussians, pixels and images of every blended pair, pixel by pixel and nearest first."""
    rows, columns = torch.meshgrid(torch.arange(scene.height), torch.arange(scene.width), indexing="ij")
    centres = torch.stack([columns, rows], -1).reshape(-1, 1, 2) + 0.5
    found = []
    for image in range(len(depths)):
        usable = (depths[image] > 0.01).nonzero()[:, 0]
        order = usable[torch.argsort(depths[image, usable])]
        delta = centres - means2d[image, order]
        xx, xy, yy = conics[image, order].unbind(-1)
        sigma = 0.5 * (xx * delta[..., 0] ** 2 + yy * delta[..., 1] ** 2) + xy * delta[..., 0] * delta[..., 1]
        alpha = (scene.opacities[order] * torch.exp(-sigma)).clamp_max(ALPHA_MAX)
        seen = (alpha >= ALPHA_MIN) & (sigma >= 0)
        left = torch.cumprod(1 - torch.where(seen, alpha, 0.0), 1)
        pixels, nearness = (seen & (left > TRANSMITTANCE_MIN)).nonzero(as_tuple=True)
        found.append(torch.stack([order[nearness], pixels, torch.full_like(pixels, image)]))
    return tuple(torch.cat(found, 1))


def _weights(alphas: Tensor, *, ray_indices: Tensor, n_rays: int) -> tuple[Tensor, Tensor]:
    """Stands for nerfacc's function: `alpha_i prod_{j<i} (1 - alpha_j)` along each ray, and the product."""
    transmittance = torch.empty_like(alphas)
    for ray in ray_indices.unique().tolist():
        own = (ray_indices == ray).nonzero()[:, 0]
        transmittance[own] = torch.cumprod(torch.cat([alphas.new_ones(1), 1 - alphas[own[:-1]]]), 0)
    return alphas * transmittance, transmittance


def _accumulated(weights: Tensor, values: Tensor | None, *, ray_indices: Tensor, n_rays: int) -> Tensor:
    """Stands for nerfacc's function: the weighted sum along each ray."""
    values = torch.ones_like(weights)[:, None] if values is None else values
    return values.new_zeros(n_rays, values.shape[1]).index_add(0, ray_indices, weights[:, None] * values)
