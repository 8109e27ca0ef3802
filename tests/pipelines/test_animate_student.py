"""`smplxpp animate` of a student: from a run, from a bundle, at other rates, beyond what training saw."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from avatar.models.model_file import save_avatar
from pipelines.commands.animate import Animate
from pipelines.commands.options import Lighting
from pipelines.runs.layout import STUDENT
from smplxpp.core.errors import InputError
from smplxpp.core.light import panorama_directions
from tests.cloth.test_driver import swaying
from tests.core.files.radiance import write_radiance
from tests.dolls.dancing import dance, write_dance_run
from tests.runtime.bundles import student, write, write_dressed


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A run with a student, the same as a bundle, and a motion."""
    folder = tmp_path_factory.mktemp("students")
    run = write_dance_run(folder / "run")
    (run / STUDENT).parent.mkdir()
    save_avatar(run / STUDENT, student("whole"))
    write(folder / "me.avatar", student("whole"))
    replace(dance(), fps=20.0).save(folder / "motion.npz")
    return folder


def pictures(out: Path) -> list[np.ndarray]:
    return [np.asarray(Image.open(path)) for path in sorted(out.iterdir())]


def film(folder: Path, out: Path, *, source: str = "me.avatar", **options) -> tuple[dict, list[np.ndarray]]:
    command = Animate(folder / source, folder / "motion.npz", out, height=64, json=True, **options)
    return command.run(), pictures(out)


def test_a_run_and_its_bundle_give_the_same_film(folder, tmp_path):
    answer, of_run = film(folder, tmp_path / "a", source="run", model="auto")
    _, of_bundle = film(folder, tmp_path / "b")
    assert answer["frames"] == len(of_run) == len(of_bundle) == len(dance()) and answer["fps"] == 20.0
    for a, b in zip(of_run, of_bundle, strict=True):
        assert a.shape == b.shape and np.abs(a.astype(int) - b).mean() < 1.5  # their steps differ with the motion
    shown = [(one < 250).any(axis=2).mean() for one in of_run]
    assert min(shown) > 0.05 and max(shown) < 0.9  # a doll before white
    assert np.abs(of_run[0].astype(int) - of_run[-1]).max() > 60


def test_other_rates_keep_the_speed(folder, tmp_path):
    _, given = film(folder, tmp_path / "a")
    fast, fine = film(folder, tmp_path / "b", interpolate=90.0)
    assert fast["fps"] == 90.0 and fast["frames"] == len(fine) == int(5 / 20 * 90) + 1
    for at, k in ((0, 0), (9, 2)):  # the camera is fitted to some of the frames, others here
        assert fine[at].shape == given[k].shape and np.abs(fine[at].astype(int) - given[k]).mean() < 4.0
    assert np.abs(fine[9].astype(int) - given[5]).mean() > 8.0
    some, _ = film(folder, tmp_path / "c", start=2, interpolate=40.0)
    assert some["frames"] == 7
    with pytest.raises(InputError, match="interpolate"):
        film(folder, tmp_path / "d", interpolate=90.0, step=2)
    with pytest.raises(InputError, match="interpolate"):
        film(folder, tmp_path / "d", interpolate=90.0, source="run", model="template")


def test_poses_beyond_the_training_are_said_and_held_back(folder, tmp_path):
    far = replace(dance(), body_pose=dance().body_pose + np.linspace(0.0, 2.0, len(dance()))[:, None], fps=20.0)
    far.save(tmp_path / "far.npz")
    said = {}
    for outside in ("keep", "clamp"):
        command = Animate(
            folder / "me.avatar", tmp_path / "far.npz", tmp_path / outside, height=64, json=True, outside=outside
        )
        said[outside] = command.run()["notes"]
    assert "of 6 frames" in said["keep"][0] and "--outside clamp" in said["keep"][0]
    assert "held back" in said["clamp"][0]
    kept, held = pictures(tmp_path / "keep"), pictures(tmp_path / "clamp")
    assert kept[0].shape != held[0].shape or np.abs(kept[-1].astype(int) - held[-1]).max() > 60


def test_loose_clothes_of_a_bundle_are_simulated(tmp_path):
    write_dressed(tmp_path)
    frames = [swaying(k / 20.0) for k in range(3)]
    motion = frames[0].concatenate(frames)
    replace(motion, fps=20.0).save(tmp_path / "motion.npz")
    simulated, one = film(tmp_path, tmp_path / "a")
    skinned, other = film(tmp_path, tmp_path / "b", cloth="skin")
    by_field, third = film(tmp_path, tmp_path / "c", cloth="field")
    assert simulated["simulated"] == ["lower"] and skinned["simulated"] == by_field["simulated"] == []
    assert len(one) == len(other) == len(third) == 3
    # `skin` was the student's field, under the wrong name.
    for a, b in ((one, other), (one, third), (other, third)):
        assert np.abs(a[-1].astype(int) - b[-1]).max() > 10
    with pytest.raises(InputError, match="loose-parts"):
        film(tmp_path, tmp_path / "d", loose_parts=("lower",))


def test_a_camera_that_stands_still_sees_all_of_a_walk(folder, tmp_path):
    """A player's arrays are its own: poses taken one after the other were all the last, and the walk left the film."""
    away = replace(dance(), transl=np.linspace(-1.5, 1.5, len(dance()))[:, None] * [1.0, 0.0, 0.0], fps=20.0)
    away.save(tmp_path / "away.npz")
    Animate(folder / "me.avatar", tmp_path / "away.npz", tmp_path / "out", height=64, json=True).run()
    middles = []
    for picture in pictures(tmp_path / "out"):
        columns = np.flatnonzero((picture < 230).any(axis=(0, 2)))
        assert 0 < columns.min() and columns.max() < picture.shape[1] - 1
        middles.append(columns.mean())
    assert np.diff(middles).min() > 5.0


def test_frames_of_the_training_take_their_codes(folder, tmp_path):
    _, null = film(folder, tmp_path / "a")
    _, trained = film(folder, tmp_path / "b", codes="trained")
    differs = [int(np.abs(a.astype(int) - b).max()) for a, b in zip(null, trained, strict=True)]
    # The doll has codes of its first three frames; its null code is the first one's.
    assert min(differs[1:3]) >= 2 and differs[0] == max(differs[3:]) == 0
    _, some = film(folder, tmp_path / "c", codes="trained", start=2, stop=4)
    _, plain = film(folder, tmp_path / "d", start=2, stop=4)
    later = [int(np.abs(a.astype(int) - b).max()) for a, b in zip(some, plain, strict=True)]
    assert later[0] >= 2 and later[1] == 0
    for wrong in ({"interpolate": 40.0}, {"source": "run", "model": "template"}):
        with pytest.raises(InputError, match="codes"):
            film(folder, tmp_path / "e", codes="trained", **wrong)
    write_dressed(tmp_path)
    with pytest.raises(InputError, match="cloth field"):
        Animate(tmp_path / "me.avatar", folder / "motion.npz", tmp_path / "f", codes="trained", json=True).run()


def test_another_light(folder, tmp_path):
    """A lamp to the person's left, which is on the picture's right: that side brightens, the other darkens."""
    lamp = np.exp(4.0 * (panorama_directions(16, 32) @ [1.0, 0.0, 0.0] - 1.0))[..., None] * np.ones(3)
    write_radiance(tmp_path / "lamp.hdr", lamp)
    for source, model in (("me.avatar", "student"), ("run", "template")):
        options = {"source": source, "model": model, "stop": 1}
        _, (plain,) = film(folder, tmp_path / f"{model} a", **options)
        _, (lit,) = film(folder, tmp_path / f"{model} b", lighting=Lighting(tmp_path / "lamp.hdr"), **options)
        seen = (plain < 245).any(axis=2) & (lit < 245).any(axis=2)
        middle = np.argwhere(seen)[:, 1].mean()
        columns = np.broadcast_to(np.arange(plain.shape[1]), seen.shape)
        sides = [seen & (columns > middle), seen & (columns < middle)]
        right, left = (lit[side].mean() / plain[side].mean() for side in sides)
        assert right > 1.2 * left, model
    turned = Lighting(tmp_path / "lamp.hdr", environment_turn=180.0)
    _, (other,) = film(folder, tmp_path / "c", stop=1, lighting=turned)
    assert np.abs(other.astype(int) - pictures(tmp_path / "student b")[0]).max() > 60
    with pytest.raises(InputError, match="environment"):
        film(folder, tmp_path / "d", lighting=Lighting(exposure=2.0))
    with pytest.raises(InputError, match="light"):
        film(folder, tmp_path / "e", lighting=Lighting(tmp_path / "none.hdr"))
    with pytest.raises(InputError, match="environment"):
        lit = Lighting(tmp_path / "lamp.hdr")
        Animate(folder / "run", folder / "motion.npz", tmp_path / "a.glb", lighting=lit).run()


def test_a_student_is_no_glb(folder, tmp_path):
    with pytest.raises(InputError, match=r"\.mp4"):
        Animate(folder / "me.avatar", folder / "motion.npz", tmp_path / "a.glb").run()
