"""Motions of others on the command line: BVH files, other bodies, other runs, and options that do not fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.commands.animate import Animate
from pipelines.commands.driving import Driving, unshaped
from pipelines.commands.params import ParamsConvert
from pipelines.commands.templates import load_run_template
from pipelines.viewer.run_session import open_run
from smplxpp.body import load_body
from smplxpp.body.retarget import Skeleton, retarget
from smplxpp.core import BodyParams, InputError
from smplxpp.export.motion_files import write_bvh
from tests.body.walks import betas, shaped, walk
from tests.dolls.dancing import template, write_dance_run
from tests.pipelines.test_animate import run  # noqa: F401


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A short walk of a tall person as parameters with her shape, and as BVH."""
    folder = tmp_path_factory.mktemp("motions")
    short = walk(1).select(slice(0, 20))
    replace(short, betas=np.repeat(betas(1)[None], 20, axis=0), fps=30.0).save(folder / "walk.npz")
    write_bvh(folder / "walk.bvh", load_body(), short, joints=shaped(1).places)
    return folder


def truth() -> BodyParams:
    return retarget(walk(1).select(slice(0, 20)), shaped(1), shaped(None))


def test_a_motion_of_another_shape(folder):
    body = unshaped(load_body())
    driven = Driving(retarget_from=Path("open")).load(folder / "walk.npz", body)
    np.testing.assert_allclose(driven.transl, truth().transl, atol=1e-9)
    as_it_is = Driving().load(folder / "walk.npz", body)
    np.testing.assert_allclose(as_it_is.transl, walk(1).transl[:20], atol=1e-9)


def test_a_bvh_is_retargeted_by_itself(folder):
    driven = Driving().load(folder / "walk.bvh", load_body())
    way = [np.diff(one.transl, axis=0) for one in (driven, truth())]
    np.testing.assert_allclose(way[0], way[1], atol=2e-4)
    ParamsConvert(input=folder / "walk.bvh", out=folder / "converted.npz").run()
    with np.load(folder / "converted.npz") as file:
        np.testing.assert_allclose(BodyParams.from_mapping(file).transl, driven.transl, atol=1e-6)


def test_films_of_a_bvh_and_of_another_run_s_motion(run, folder, tmp_path):  # noqa: F811
    made = Animate(run, folder / "walk.bvh", tmp_path / "a", height=60, stop=2, json=True).run()
    assert made["frames"] == 2 and made["fps"] == pytest.approx(30.0, rel=1e-4)
    of_run = Driving(retarget_from=run).load(folder / "walk.npz", load_body())
    np.testing.assert_allclose(of_run.transl, walk(1).transl[:20], atol=1e-9)  # the run's body is the mean one


def test_the_viewer_takes_a_bvh(run, folder, tmp_path):  # noqa: F811
    session = open_run(run, load_run_template(run), params=folder / "walk.bvh")
    np.testing.assert_allclose(
        np.diff(session.motion.params.transl, axis=0), np.diff(truth().transl, axis=0), atol=2e-4
    )
    with pytest.raises(InputError, match="legs"):  # the doll has none
        open_run(write_dance_run(tmp_path / "run"), template(), params=folder / "walk.bvh")


@pytest.mark.parametrize(
    ("options", "file", "words"),
    [
        ({"retarget_from": Path("open")}, "walk.bvh", "retarget-from"),
        ({"joint_map": Path("map.json")}, "walk.npz", "joint-map"),
        ({"retarget_from": Path("/nowhere.npz")}, "walk.npz", "nowhere"),
    ],
)
def test_options_that_do_not_fit_are_refused(folder, options, file, words):
    with pytest.raises(InputError, match=words):
        Driving(**options).load(folder / file, load_body())


def test_a_folder_without_a_template_is_no_body(folder):
    with pytest.raises(InputError, match="retarget-from"):
        Driving(retarget_from=folder).load(folder / "walk.npz", load_body())


def test_skeletons_of_templates_are_those_of_their_bodies():
    body = load_body()
    np.testing.assert_allclose(Skeleton.of(unshaped(body)).places, Skeleton.of(body).places)
