"""`Template.export` writes what the suffix names, with the writers' own bytes."""

from __future__ import annotations

import pytest

from smplxpp.core import BodyParams, InputError
from smplxpp.export import write_glb, write_obj
from smplxpp.template.template import Template
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
        small_template.export(tmp_path / "template.fbx")
    moves = BodyParams.concatenate([BodyParams.rest(betas=0), BodyParams.rest(betas=0)])
    with pytest.raises(InputError, match="at most 1 frames"):
        small_template.export(tmp_path / "template.obj", animation=moves)
    with pytest.raises(InputError, match="at most 0 frames"):
        small_template.export(tmp_path / "template.npz", animation=moves)
    assert list(tmp_path.iterdir()) == []
