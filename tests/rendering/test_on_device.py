"""A player on a GPU (a pretended one) against the player of the CPU, whose kernels share no line with it."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import avatar
from avatar.rendering import on_device
from avatar.rendering.on_device import SplatsOnDevice, record_graph
from avatar.runtime import AvatarPlayer
from pipelines.cli import main
from smplxpp.core import InputError
from smplxpp.core.light import Irradiance, Relighting
from tests.cloth.test_driver import QUICK, swaying
from tests.dolls.dancing import cameras, dance
from tests.pretended_cuda import CountedWaits, pretended_cuda
from tests.runtime.bundles import KINDS, student, write, write_dressed

FRAMES = ((3, 2), (5, None), (1, 1))
"""Frames of the dance, each with the training frame whose code it takes."""
# Float32 sums in another order: 2e-7 m between corners that lie 5 mm apart turn a triangle by 4e-5.
PLACES = {"means": 1e-6, "scales": 1e-6, "dc": 1e-6, "quats": 5e-5, "rotations": 5e-5, "opacities": 1e-6}


@pytest.fixture
def device():
    with pretended_cuda():
        yield


def same_splats(one, other) -> None:
    for name, bound in PLACES.items():
        np.testing.assert_allclose(getattr(one, name), getattr(other, name), rtol=0, atol=bound, err_msg=name)
    for name in ("sh", "face"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("device")
def test_poses_and_pictures_are_those_of_the_cpu(kind, tmp_path):
    write(tmp_path / "a.avatar", student(kind))
    here, there = AvatarPlayer(tmp_path / "a.avatar", threads=1), avatar.load(tmp_path / "a.avatar", device="cuda")
    for frame, code in FRAMES:
        splats = there.pose(dance().frame(frame), frame=code)
        same_splats(splats, here.pose(dance().frame(frame), frame=code))
        np.testing.assert_allclose(there.vertices, here.vertices, rtol=0, atol=1e-6)
    camera = cameras()["Held0"]
    (image, alpha), (wanted, its_alpha) = (one.draw(camera, background=(0.2, 0.4, 0.6)) for one in (there, here))
    assert 0.05 < alpha.mean() < 0.9
    assert np.square(image - wanted).mean() < 10**-8.0  # 80 dB: a pixel at the edge of what is skipped may differ
    np.testing.assert_allclose(alpha, its_alpha, rtol=0, atol=1e-2)
    eye = np.float32([0.3, 0.8, 2.0])
    np.testing.assert_allclose(splats.colors(eye), here.pose(dance().frame(1), frame=1).colors(eye), rtol=0, atol=1e-5)


@pytest.mark.usefixtures("device")
@pytest.mark.long
def test_clothes_are_simulated_as_on_the_cpu(tmp_path):
    write_dressed(tmp_path)
    here, there = (AvatarPlayer(tmp_path / "me.avatar", threads=1, device=d, cloth=QUICK) for d in ("cpu", "cuda"))
    assert there.has_clothes
    for k in range(3):
        same_splats(there.step(swaying(k / 20.0), 0.05), here.step(swaying(k / 20.0), 0.05))
    same_splats(there.pose(swaying(0.0)), here.pose(swaying(0.0)))  # without clothes, after them
    assert there.cloth_quality == here.cloth_quality
    # Parts that are taken off, and the skin that lies bare then, in pictures too.
    for one in (there, here):
        one.hide(["lower"])
    same_splats(there.pose(swaying(0.0)), here.pose(swaying(0.0)))
    (image, alpha), (wanted, _) = (one.draw(cameras()["Held0"]) for one in (there, here))
    assert alpha.max() > 0.9 and np.square(image - wanted).mean() < 10**-8.0


@pytest.mark.usefixtures("device")
def test_another_light_is_that_of_the_cpu(tmp_path):
    write(tmp_path / "a.avatar", student("whole"))
    red = Relighting(
        replace(Irradiance.uniform(), coefficients=Irradiance.uniform().coefficients * [1, 0.5, 0.5]),
        Irradiance.uniform(),
    )
    pictures = []
    for place in ("cpu", "cuda"):
        player = AvatarPlayer(tmp_path / "a.avatar", threads=1, device=place)
        player.pose(dance().frame(4))
        pictures.append(player.draw(cameras()["Held0"], relighting=red)[0])
    assert np.square(pictures[0] - pictures[1]).mean() < 10**-7.0


@pytest.mark.usefixtures("device")
def test_a_pose_takes_one_copy_and_waits_for_nothing(tmp_path, caplog):
    write(tmp_path / "a.avatar", student("whole"))
    player = AvatarPlayer(tmp_path / "a.avatar", threads=1, device="cuda")
    player.pose(dance().frame(0))
    with CountedWaits() as counted:
        player.pose(dance().frame(4))
    assert (counted.count, counted.sent) == (0, 1)
    assert caplog.text.count("not recorded as a CUDA graph") == 1


@pytest.mark.usefixtures("device")
def test_arrays_of_splats_are_copied_when_they_are_asked_for():
    splats = object.__new__(SplatsOnDevice)  # without the tests' own check of all arrays
    object.__setattr__(splats, "_tensors", {"means": torch.ones(2, 3, device="cuda")})
    assert set(vars(splats)) == {"_tensors"}
    assert splats.means is splats.means and splats.means.tolist() == [[1.0] * 3] * 2
    assert set(vars(splats)) == {"_tensors", "means"}
    with pytest.raises(AttributeError, match="nonsense"):
        _ = splats.nonsense


@pytest.mark.usefixtures("device")
def test_replayed_graphs_are_told_apart_by_code_and_clothes(tmp_path, monkeypatch):
    """A graph writes into its own tensors: the splats of a pose are those of its graph."""
    recorded = []

    def record(work, *, subject):
        result = work()

        def replay() -> None:
            copy_into(result, work())

        recorded.append(subject)
        return replay, result

    monkeypatch.setattr(on_device, "record_graph", record)
    write(tmp_path / "a.avatar", student("regression"))
    here, there = (AvatarPlayer(tmp_path / "a.avatar", threads=1, device=place) for place in ("cpu", "cuda"))
    for frame, code in (*FRAMES, *FRAMES):
        same_splats(there.pose(dance().frame(frame), frame=code), here.pose(dance().frame(frame), frame=code))
    assert recorded == ["the player", "the player"]


def copy_into(result, values) -> None:
    """Overwrite all tensors of nested dataclasses."""
    for field in dataclasses.fields(result):
        one, other = getattr(result, field.name), getattr(values, field.name)
        if isinstance(one, torch.Tensor):
            one.copy_(other)
        elif dataclasses.is_dataclass(one):
            copy_into(one, other)


def test_a_device_that_is_not_there_is_refused(tmp_path, capsys):
    write(tmp_path / "a.avatar", student("no field"))
    for device in ("cuda", "mps"):
        with pytest.raises(InputError, match=f"device of a player.*{device}"):
            AvatarPlayer(tmp_path / "a.avatar", device=device)
    replace(dance(), fps=30.0).save(tmp_path / "dance.npz")
    options = ["--params", str(tmp_path / "dance.npz"), "--out", str(tmp_path / "film"), "--device", "cuda"]
    assert main(["animate", str(tmp_path / "a.avatar"), *options]) == 2
    assert "device of a player" in capsys.readouterr().err and not (tmp_path / "film").exists()
    assert main(["animate", str(tmp_path), "--model", "template", *options]) == 2
    assert "cpu, which draws the template" in capsys.readouterr().err


@pytest.mark.usefixtures("device")
def test_a_picture_comes_after_a_pose(tmp_path):
    write(tmp_path / "a.avatar", student("no field"))
    player = AvatarPlayer(tmp_path / "a.avatar", device="cuda")
    with pytest.raises(InputError, match="a pose before its picture"):
        player.draw(cameras()["Held0"])
    player.pose(dance().frame(0))
    with pytest.raises(InputError, match="orthographic"):
        player.draw(replace(cameras()["Held0"], orthographic=True))


@pytest.mark.usefixtures("device")
def test_animate_draws_the_same_film(tmp_path):
    write(tmp_path / "a.avatar", student("whole"))
    replace(dance(), fps=30.0).save(tmp_path / "dance.npz")
    pictures = {}
    for place in ("cpu", "cuda"):
        out = tmp_path / place
        options = ["--params", str(tmp_path / "dance.npz"), "--out", str(out), "--stop", "2", "--height", "64"]
        assert main(["animate", str(tmp_path / "a.avatar"), *options, "--device", place, "--json"]) == 0
        pictures[place] = [np.asarray(Image.open(path), float) for path in sorted(out.glob("*.png"))]
    assert len(pictures["cpu"]) == len(pictures["cuda"]) == 2
    for one, other in zip(pictures["cpu"], pictures["cuda"], strict=True):
        assert np.abs(one - other).mean() < 0.05 and one.std() > 1.0


def test_what_cannot_be_recorded_is_told(caplog):
    assert record_graph(lambda: 1, subject="this") is None
    assert "this is not recorded as a CUDA graph" in caplog.text
