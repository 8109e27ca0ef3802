"""The inside of the mouth is found by name and by what a hanging jaw uncovers; in poses, by what shows of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from smplxpp.body import load_body
from smplxpp.core.params import BodyParams
from smplxpp.template.mouth import inside_of_mouth, shown_mouth
from tests.dolls.standing import doll
from tests.template.test_template import template_of

NAMES = ("upper_teeth", "lower_teeth", "tongue")


@pytest.fixture(scope="module")
def template():
    return template_of(load_body(num_betas=4, num_expressions=6), np.array([0.5, -1.0, 0.3, 0.0]))


@pytest.fixture(scope="module")
def inside(template):
    return inside_of_mouth(template)


def named(template):
    body, out = template.body, np.zeros(template.vertex_count, bool)
    out[: body.vertex_count] = np.isin(body.part_labels, [body.part_label_names.index(name) for name in NAMES])
    return out


def posed(template, jaw, **other):
    rest = BodyParams.rest(betas=template.body.num_betas, expressions=template.body.num_expressions)
    return template.pose(replace(rest, jaw_pose=np.array([[jaw, 0.0, 0.0]]), **other))[0]


def test_teeth_tongue_and_what_lies_about_them(template, inside):
    teeth = named(template)
    assert inside[teeth].all() and 10 < (inside & ~teeth).sum() < 200
    middle = template.vertices[teeth].mean(axis=0)
    assert np.linalg.norm(template.vertices[inside] - middle, axis=1).max() < 0.08
    assert not inside[template.body.vertex_count :].any()


def test_a_body_that_names_no_teeth_shows_them_by_its_jaw(template, inside):
    body = replace(template.body, part_label_names=tuple(f"part {k}" for k in range(6)))
    found = inside_of_mouth(replace(template, body=body))
    assert found[inside].mean() > 0.2 and not (found & ~inside).any()


def test_a_body_without_a_jaw_has_none():
    assert not inside_of_mouth(doll().template).any()


def test_an_open_mouth_shows_more(template, inside):
    closed, ajar, wide = (shown_mouth(template, inside, posed(template, jaw)) for jaw in (0.0, 0.1, 0.4))
    assert closed.sum() < 0.5 * ajar.sum() and ajar.sum() < wide.sum()
    assert not (wide & ~inside).any()


def test_where_the_person_stands_and_looks_does_not_matter(template, inside):
    turned = {"global_orient": np.array([[0.3, 2.0, 0.4]]), "transl": np.array([[1.0, -2.0, 3.0]])}
    here, there = (shown_mouth(template, inside, posed(template, 0.3, **how)) for how in ({}, turned))
    assert (here != there).sum() < 0.2 * here.sum()
