"""Bad input to `rasterize`: always an InputError that names the argument, never a crash or a silent image."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from avatar.rendering import rasterize
from smplxpp.core.errors import InputError
from tests.rendering.scenes import Scene, facing_scene, random_scene

TENSORS = ("means", "quats", "scales", "opacities", "features", "viewmats", "Ks", "background")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return random_scene(31, count=20, width=8, height=6, cameras=2)


def refused(scene: Scene, **options) -> InputError:
    with pytest.raises(InputError) as caught:
        rasterize(**vars(scene), **{"backend": "reference", **options})
    return caught.value


def with_entry(tensor: torch.Tensor, position: int, value: float) -> torch.Tensor:
    changed = tensor.clone()
    changed.view(-1)[position % tensor.numel()] = value
    return changed


@given(
    name=st.sampled_from(TENSORS),
    value=st.sampled_from([float("nan"), float("inf"), -float("inf")]),
    position=st.integers(0, 10_000),
)
@settings(max_examples=60, deadline=None)
def test_one_number_that_is_not_finite(scene, name, value, position):
    error = refused(scene.replace(**{name: with_entry(getattr(scene, name), position, value)}))
    assert error.subject == name
    assert error.expected == "finite numbers"
    assert error.received.startswith("1 of ")


@given(
    case=st.sampled_from(
        [("scales", 0.0), ("scales", -0.1), ("opacities", -1e-6), ("opacities", 1.001), ("Ks", -3.0), ("Ks", 0.0)]
    ),
    row=st.integers(0, 1),
)
@settings(max_examples=20, deadline=None)
def test_one_number_out_of_range(scene, case, row):
    name, value = case
    tensor = getattr(scene, name)
    error = refused(scene.replace(**{name: with_entry(tensor, row * (tensor.numel() // len(tensor)), value)}))
    assert error.subject == name


@given(name=st.sampled_from(TENSORS), change=st.sampled_from(["rank", "last", "first"]))
@settings(max_examples=40, deadline=None)
def test_wrong_shapes(scene, name, change):
    tensor = getattr(scene, name)
    wrong = {
        "rank": tensor[None, None],
        "last": tensor[..., :-1],
        "first": tensor[:-1] if name != "background" else tensor[[0, 0, 0]],
    }[change]
    error = refused(scene.replace(**{name: wrong}))
    # Fewer means or cameras make the first argument that still has the old number the odd one out.
    culprits = {("means", "first"): {"quats"}, ("viewmats", "first"): {"Ks"}, ("features", "last"): {"background"}}
    assert error.subject in culprits.get((name, change), {name})
    assert "shape" in error.expected
    assert "shape" in error.received


@pytest.mark.parametrize("name", TENSORS)
@pytest.mark.parametrize("wrong", ["numpy", "half", "integer", "mixed", "device"])
def test_wrong_kinds(scene, name, wrong):
    tensor = getattr(scene, name)
    changed = {
        "numpy": tensor.numpy,
        "half": tensor.half,
        "integer": tensor.long,
        "mixed": tensor.float,
        "device": lambda: tensor.to("meta"),
    }[wrong]()
    if name == "means" and wrong in ("mixed", "device"):
        scene = scene.mapped(lambda other: other if other is tensor else other.clone())
    error = refused(scene.replace(**{name: changed}))
    assert error.subject in ({name, "quats"} if name == "means" else {name})


@pytest.mark.parametrize("length", [0.0, 1e-20])
def test_quaternions_without_a_direction(scene, length):
    quats = scene.quats.clone()
    quats[3] = torch.tensor([0, 0, length, 0])
    error = refused(scene.replace(quats=quats))
    assert error.subject == "quats"
    assert "number 3" in error.received


def test_a_half_turn_is_a_fine_quaternion(scene):
    quats = scene.quats.clone()
    quats[0] = torch.tensor([0, 1.0, 0, 0])
    rasterize(**vars(scene.replace(quats=quats)), backend="reference")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda m: m * torch.tensor([2.0, 2, 2, 1])[:, None], "rigid transforms"),
        (lambda m: torch.tensor([-1.0, 1, 1, 1])[:, None] * m, "mirror"),
        (lambda m: m.mT.clone(), "last row"),
    ],
)
def test_cameras_that_are_not_rigid(scene, change, words):
    error = refused(scene.replace(viewmats=torch.stack([scene.viewmats[0], change(scene.viewmats[1]).double()])))
    assert error.subject == "viewmats"
    assert words in str(error)
    assert "camera 1" in error.received


@pytest.mark.parametrize(("row", "column", "value"), [(0, 1, 2.0), (1, 0, 2.0), (2, 2, 2.0), (2, 0, 0.1)])
def test_intrinsics_that_are_not_supported(scene, row, column, value):
    Ks = scene.Ks.clone()
    Ks[1, row, column] = value
    error = refused(scene.replace(Ks=Ks))
    assert error.subject == "Ks"
    assert "camera 1" in error.received


@pytest.mark.parametrize(
    ("options", "subject"),
    [
        ({"width": 0}, "width"),
        ({"height": -3}, "height"),
        ({"width": 8.0}, "width"),
        ({"height": True}, "height"),
        ({"width": np.float32(8)}, "width"),
        ({"near": 0.0}, "near, far"),
        ({"near": 2.0, "far": 1.0}, "near, far"),
        ({"far": float("inf")}, "far"),
        ({"eps2d": -0.1}, "eps2d"),
        ({"eps2d": "0.3"}, "eps2d"),
        ({"depth": "median"}, "depth"),
        ({"backend": "metal"}, "backend"),
    ],
)
def test_wrong_options(scene, options, subject):
    size = {name: options[name] for name in ("width", "height") if name in options}
    rest = {name: value for name, value in options.items() if name not in size}
    assert refused(scene.replace(**size), **rest).subject == subject


def test_numpy_numbers_are_welcome(scene):
    sized = scene.replace(width=np.int64(8), height=np.int32(6))
    image, _, _ = rasterize(**vars(sized), backend="reference", near=np.float32(0.5), eps2d=np.int64(1))
    assert image.shape == (2, 6, 8, 4)


@pytest.mark.parametrize("shape", [(20, 0), (20,), (), (3, 20, 4), (2, 19, 4)])
def test_features_of_no_use(scene, shape):
    error = refused(scene.replace(features=torch.zeros(shape, dtype=torch.float64), background=None))
    assert error.subject == "features"
    assert error.expected == f"shape ({len(scene.means)}, D) or (2, {len(scene.means)}, D), with D of 1 or more"


@pytest.mark.parametrize("backend", [None, "cpu"])
def test_the_fast_backends_say_how_to_get_float64(scene, backend):
    error = refused(scene, backend=backend)
    assert "float32 on cpu" in error.expected
    assert "backend='reference'" in error.remedy


def test_a_gradient_that_would_be_missing_is_an_error(scene):
    single = scene.mapped(torch.Tensor.float)
    error = refused(single.replace(Ks=single.Ks.clone().requires_grad_()), backend="cpu")
    assert error.subject == "Ks"


def test_camera_gradients_only_where_asked_for(scene):
    for wanted in (False, True):
        viewmats = scene.viewmats.clone().requires_grad_()
        means = scene.means.clone().requires_grad_()
        options = {"backend": "reference", "depth": "expected", "camera_gradients": wanted}
        image, _, meta = rasterize(**vars(scene.replace(viewmats=viewmats, means=means)), **options)
        (image.sum() + meta.depth.sum()).backward()
        assert means.grad.abs().max() > 0
        assert (viewmats.grad is not None) == wanted


def test_a_sum_that_overflows_is_not_mistaken_for_infinity():
    scene = facing_scene([2.0, 3.0, 1.0, 1.0], [0.5] * 4).mapped(torch.Tensor.float)
    scene.means[2:, 2] = 3e38
    image, _, _ = rasterize(**vars(scene), backend="reference")
    assert image[..., :2].max() > 0.4


def test_unchecked_values_reach_the_image(scene):
    features = scene.features.clone()
    features[:, 0] = float("nan")
    image, _, _ = rasterize(**vars(scene.replace(features=features)), backend="reference", check=False)
    assert image[..., 0].isnan().any()
    assert not image[..., 1].isnan().any()


@pytest.mark.parametrize("backend", ["reference", "cpu"])
@given(
    seed=st.integers(0, 1000),
    spread=st.sampled_from([0.0, 1e-3, 1.0, 1e6, 1e12]),
    scale=st.sampled_from([1e-20, 1e-6, 1.0, 1e6]),
    focal=st.sampled_from([1e-3, 10.0, 1e7]),
    eps2d=st.sampled_from([0.0, 0.3, 100.0]),
)
@settings(max_examples=40, deadline=None)
def test_extreme_scenes_are_drawn(backend, seed, spread, scale, focal, eps2d):
    """Whatever passes the checks gives finite images with alpha in [0, 1], and finite gradients."""
    rng = np.random.default_rng(seed)
    count = 12
    leaves = {
        "means": rng.normal(size=(count, 3)) * spread,
        "quats": rng.normal(size=(count, 4)) * 10.0 ** rng.integers(-8, 9, (count, 1)),
        "scales": scale * 10.0 ** rng.uniform(-2, 2, (count, 3)),
        "opacities": rng.choice([0, 1e-3, 0.5, 1.0], count),
        "features": rng.normal(size=(count, 2)),
    }
    K = np.array([[focal, 0, 4], [0, focal, 3], [0, 0, 1]])
    dtype = torch.float64 if backend == "reference" else torch.float32
    tensors = {name: torch.tensor(value, dtype=dtype) for name, value in leaves.items()}
    for tensor in tensors.values():
        tensor.requires_grad_()
    cameras = [torch.tensor(matrix, dtype=dtype)[None] for matrix in (np.eye(4), K)]
    image, alpha, _ = rasterize(*tensors.values(), *cameras, 8, 6, backend=backend, eps2d=eps2d)
    assert torch.isfinite(image).all()
    assert ((alpha >= 0) & (alpha <= 1)).all()
    image.sum().backward()
    for name, tensor in tensors.items():
        assert torch.isfinite(tensor.grad).all(), name
