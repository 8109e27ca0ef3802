"""`Template.export` writes what the suffix names, with the writers' own bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.body import stress_poses
from smplxpp.core import BodyParams, InputError, SkinWeights
from smplxpp.export import write_glb, write_obj
from smplxpp.export.by_suffix import pruning_error
from smplxpp.template.template import Template
from tests.export.glb_reader import GlbReader
from tests.export.templates import random_template


@pytest.fixture(scope="module")
def small_template() -> Template:
    return random_template()


def test_a_suffix_chooses_the_writer(tmp_path, small_template):
    write_glb(tmp_path / "own.glb", small_template.on_floor())
    write_obj(tmp_path / "own.obj", small_template.on_floor())
    for name in ("glb", "obj"):
        assert small_template.export(tmp_path / f"by.{name}") == tmp_path / f"by.{name}"
        assert (tmp_path / f"by.{name}").read_bytes() == (tmp_path / f"own.{name}").read_bytes()
    small_template.export(tmp_path / "by.npz")
    assert Template.load(tmp_path / "by.npz").part_names == small_template.part_names


def test_a_format_refuses_what_it_cannot_hold(tmp_path, small_template):
    with pytest.raises(InputError, match="a suffix of"):
        small_template.export(tmp_path / "template.max")
    moves = BodyParams.concatenate([BodyParams.rest(betas=0), BodyParams.rest(betas=0)])
    with pytest.raises(InputError, match="at most 1 frames"):
        small_template.export(tmp_path / "template.obj", animation=moves)
    with pytest.raises(InputError, match="at most 0 frames"):
        small_template.export(tmp_path / "template.npz", animation=moves)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("most", [4, 8])
def test_a_file_has_as_many_joints_a_vertex_as_are_asked_for(tmp_path, small_template, most):
    small_template.export(tmp_path / "a.glb", max_influences=most)
    reader = GlbReader(tmp_path / "a.glb")
    (body,) = (mesh["primitives"][0]["attributes"] for mesh in reader.json["meshes"] if mesh["name"] == "body")
    assert ("WEIGHTS_1" in body) == (most == 8)
    weights = np.concatenate([reader.array(body[f"WEIGHTS_{k}"]) for k in range(most // 4)], axis=1)
    dense = np.sort(small_template.weights.dense()[:40], axis=1)[:, ::-1][:, :most]
    np.testing.assert_allclose(weights, dense / dense.sum(axis=1, keepdims=True), atol=1e-6)
    for wrong in (0, 9):
        with pytest.raises(InputError, match="option max_influences"):
            small_template.export(tmp_path / "b.glb", max_influences=wrong)
    with pytest.raises(InputError, match=r"option max_influences: expected a file \.glb"):
        small_template.export(tmp_path / "b.obj", max_influences=4)


def test_the_error_of_pruning_is_the_way_of_the_worst_vertex(small_template):
    """One vertex of the shoes hangs on a second joint by a share: it alone moves when that joint is left out."""
    dense = np.eye(24)[np.zeros(63, int)]
    dense[55, [0, 4]] = 0.6, 0.4
    template = replace(small_template, weights=SkinWeights.from_dense(dense))
    moves = template.posed_from_rest(stress_poses(BodyParams.rest(betas=0, expressions=0)))
    place = np.append(template.vertices[55], 1.0)
    way = 0.4 * np.linalg.norm(((moves[:, 4] - moves[:, 0]) @ place)[:, :3], axis=1)
    error = pruning_error(template, 1)
    assert error.worst_mm == pytest.approx(1000 * way.max()) and error.part == "shoes" and error.p99_mm < error.worst_mm
    assert pruning_error(template, 2).worst_mm == pytest.approx(0.0, abs=1e-9)
