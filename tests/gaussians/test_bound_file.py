"""The file of bound Gaussians."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file, save_file

from avatar.gaussians.tensor_file import load_bound, save_bound
from smplxpp.core.errors import InputError
from tests.gaussians.bound_scenes import random_bound, sphere


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("degree", [0, 2])
def test_round_trip_is_exact(tmp_path, dtype, degree):
    _, faces = sphere()
    bound = random_bound(faces, degree=degree, dtype=dtype)
    save_bound(bound, tmp_path / "a.safetensors")
    again = load_bound(tmp_path / "a.safetensors", faces=faces.numpy())
    assert (again.face_count, again.topology) == (bound.face_count, bound.topology)
    for name, value in bound.tensors.items():
        assert torch.equal(getattr(again, name), value), name


def test_tensors_with_gradients_and_views_are_saved(tmp_path):
    _, faces = sphere()
    bound = random_bound(faces, count=30)
    loose = replace(bound, dc=bound.sh[:, 0].requires_grad_(True))
    save_bound(loose, tmp_path / "a.safetensors")
    again = load_bound(tmp_path / "a.safetensors")
    assert torch.equal(again.dc, bound.sh[:, 0]) and not again.dc.requires_grad


def test_gaussians_of_another_mesh_are_refused(tmp_path):
    _, faces = sphere()
    save_bound(random_bound(faces), tmp_path / "a.safetensors")
    with pytest.raises(InputError, match=r"a\.safetensors.*128 other faces"):
        load_bound(tmp_path / "a.safetensors", faces=faces.flip(0).numpy())


def test_damaged_and_foreign_files_are_refused(tmp_path):
    _, faces = sphere()
    good, path = tmp_path / "good.safetensors", tmp_path / "a.safetensors"
    with pytest.raises(InputError, match="existing file"):
        load_bound(path)
    save_bound(random_bound(faces), good)
    path.write_bytes(good.read_bytes()[:-8])
    with pytest.raises(InputError, match="safetensors file"):
        load_bound(path)
    tensors = load_file(good)
    about = {"schema": 1, "face_count": 128, "topology": "x"}
    cases = {
        "another file": (tensors, None),
        "schema: 9": (tensors, about | {"schema": 9}),
        "all tensors": ({k: v for k, v in tensors.items() if k != "dc"}, about),
        "all tensors.*extra": (tensors | {"extra": tensors["dc"].clone()}, about),
        "topology: expected a text": (tensors, {k: v for k, v in about.items() if k != "topology"}),
        "face_count.*many": (tensors, about | {"face_count": "many"}),
        "metadata: expected an object": (tensors, [1, 2]),
        "whole numbers": (tensors | {"face_index": tensors["face_index"].double()}, about),
        "any length but zero": (tensors | {"quats": tensors["quats"] * 0.0}, about),
        "opacity_logits: expected floats": (
            tensors | {"opacity_logits": tensors["opacity_logits"].int()},
            about,
        ),
        "dc: expected finite": (tensors | {"dc": tensors["dc"] * float("nan")}, about),
        "face_index": (tensors, about | {"face_count": 3}),
        "quats": (tensors | {"quats": tensors["quats"][:-1].clone()}, about),
    }
    for message, (content, about) in cases.items():
        save_file(content, path, metadata=about and {"bound_gaussians": json.dumps(about)})
        with pytest.raises(InputError, match=message):
            load_bound(path)


def test_the_same_gaussians_give_the_same_bytes(tmp_path):
    _, faces = sphere()
    for name in "ab":
        save_bound(random_bound(faces), tmp_path / name)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
