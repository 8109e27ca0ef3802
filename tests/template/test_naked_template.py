"""The template without its parts: the same body, posed the same, a template in its own right."""

from __future__ import annotations

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.body.named_poses import stress_poses
from smplxpp.core.params import BodyParams
from smplxpp.template.template import Template
from tests.template.test_template import template_of


@pytest.fixture(scope="module")
def template():
    return template_of(load_body(num_betas=4, num_expressions=6), np.array([0.5, -1.0, 0.3, 0.0]))


def test_only_the_body_is_left_and_it_poses_as_before(template):
    naked = template.naked()
    count = template.body.vertex_count
    assert naked.part_names == ("body",) and naked.vertex_count == naked.body.vertex_count == count
    assert len(naked.faces) == template.part_faces("body").sum() and not naked.cloth_mask.any()
    params = stress_poses(BodyParams.rest(betas=template.betas, expressions=6))
    np.testing.assert_array_equal(naked.pose(params), template.pose(params)[:, :count])


def test_colours_weights_and_the_way_back_are_kept(template):
    naked = template.naked()
    count = naked.vertex_count
    np.testing.assert_array_equal(naked.vertex_colors, template.vertex_colors[:count])
    np.testing.assert_array_equal(naked.weights.dense(), template.weights.dense()[:count])
    np.testing.assert_array_equal(naked.body_index, np.arange(count))


def test_the_file_holds_it(template, tmp_path):
    naked = template.naked()
    naked.save(tmp_path / "naked.npz")
    np.testing.assert_array_equal(Template.load(tmp_path / "naked.npz").faces, naked.faces)
    assert naked.naked().vertex_count == naked.vertex_count
