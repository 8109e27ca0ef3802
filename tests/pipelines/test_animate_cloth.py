"""`smplxpp animate` with loose clothes: simulated where the run has found some or a part is named."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from pipelines.cli import main
from pipelines.commands.animate import Animate
from pipelines.commands.driving import Driving
from pipelines.runs.layout import GARMENTS, PARAMS, TEMPLATE
from smplxpp.cloth.garment_file import save_garments
from smplxpp.core import BodyParams, GeometryWarning, InputError
from tests.cloth.persons import PART, person, standing
from tests.dolls.skirted import garment, pose

FRAMES = 6


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "skirted"
    for path in (TEMPLATE, PARAMS, GARMENTS):
        (folder / path).parent.mkdir(parents=True)
    person().save(folder / TEMPLATE)
    standing().save(folder / PARAMS)
    save_garments(folder / GARMENTS, [garment()])
    return folder


@pytest.fixture
def params(tmp_path):
    motion = BodyParams.concatenate([pose(frame) for frame in range(FRAMES)])
    replace(motion, fps=30.0).save(tmp_path / "walk.npz")
    return tmp_path / "walk.npz"


def film(run, params, out, **options) -> tuple[dict, np.ndarray]:
    result = Animate(run, params, out, height=80, json=True, fps=15.0, **options).run()
    return result, np.stack([np.asarray(Image.open(path)).astype(int) for path in sorted(out.iterdir())])


@pytest.mark.long
def test_clothes_that_training_found_swing(run, params, tmp_path):
    simulated, moving = film(run, params, tmp_path / "simulated")
    skinned, stiff = film(run, params, tmp_path / "skinned", cloth="skin")
    assert simulated["simulated"] == [PART] and skinned["simulated"] == [] and simulated["notes"] == []
    changed = (moving != stiff).any(axis=3)
    assert changed.any(axis=(1, 2)).all()
    rows = np.flatnonzero(changed.any(axis=(0, 2)))
    assert rows.min() > 20  # head and waist are where the joints have them
    np.testing.assert_array_equal(film(run, params, tmp_path / "again")[1], moving)


def test_a_part_of_a_film_is_simulated_too(run, params, tmp_path):
    part, pictures = film(run, params, tmp_path / "part", start=3)
    later, last = film(run, params, tmp_path / "later", start=4)
    assert (part["frames"], later["frames"]) == (len(pictures), len(last)) == (3, 2)
    # Both are preceded by the whole motion before them; the camera alone is fitted to other frames.
    assert [part["simulated"], later["simulated"]] == [[PART]] * 2


def test_frames_without_a_pose_are_said_and_the_film_goes_on(run, params, tmp_path):
    """One NaN refused the motion."""
    with np.load(params) as file:
        arrays = {name: file[name].copy() for name in file}
    truth = arrays["transl"].copy()
    arrays["transl"][2], arrays["body_pose"][FRAMES - 1, 4] = np.nan, np.inf
    np.savez(tmp_path / "holes.npz", **arrays)
    with pytest.warns(GeometryWarning, match=f"2 of {FRAMES} frames hold NaN or infinity, the first 2"):
        result, pictures = film(run, tmp_path / "holes.npz", tmp_path / "film")
    assert result["frames"] == len(pictures) == FRAMES and result["notes"] == []
    with pytest.warns(GeometryWarning):
        filled = Driving().load(tmp_path / "holes.npz", person().body)
    np.testing.assert_array_equal(np.delete(filled.transl, [2, FRAMES - 1], 0), np.delete(truth, [2, FRAMES - 1], 0))
    held = np.linalg.norm(truth[1] - truth[2])
    assert np.linalg.norm(filled.transl[2] - truth[2]) < 0.5 * held
    np.testing.assert_array_equal(filled.transl[-1], truth[-2])


def test_the_template_has_no_field(run, params, tmp_path):
    with pytest.raises(InputError, match="cloth"):
        film(run, params, tmp_path / "film", cloth="field")


@pytest.mark.long
def test_parts_may_be_named_without_any_training(run, params, tmp_path, capsys):
    options = ("--params", str(params), "-o", str(tmp_path / "named"), "--height", "40", "--json")
    assert main(["animate", str(run), *options, "--loose-parts", PART]) == 0
    assert json.loads(capsys.readouterr().out)["simulated"] == [PART]
    with pytest.raises(InputError, match="loose part"):
        film(run, params, tmp_path / "cape", loose_parts=("cape",))
    assert not (tmp_path / "cape").exists()
