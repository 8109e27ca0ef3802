"""Loose clothes in the page: the constraints, the motion and the starts of `smplxpp.cloth`."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from avatar.runtime import AvatarPlayer
from avatar.runtime.skeleton import LooseClothes
from smplxpp.cloth import DriverConfig, SolverConfig
from smplxpp.core import InputError
from smplxpp.core.params import BodyParams
from tests.cloth.persons import standing
from tests.cloth.test_driver import QUICK, swaying
from tests.web.avatars import SWAY_FPS as FPS
from tests.web.avatars import write_dressed
from tests.web.modules import NEEDS_BUILD, node

pytestmark = NEEDS_BUILD
PLAYED = """
const avatar = await read(given.path), deformer = new m.Deformer(avatar), result = [];
const driver = new m.ClothDriver(deformer, avatar.garments, given.start);
for (const [frame, seconds, how] of given.steps) {
  const pose = m.poseAt(avatar.motion, frame / avatar.motion.framesPerSecond);
  const cloth = driver[how ?? "step"](pose, seconds);
  deformer.pose(pose, cloth);
  result.push({ particles: driver.particles.map(x => [...x]), means: [...deformer.centers] });
}"""


def followed(path: Path, config: DriverConfig | None, steps: list[tuple[int, float]]) -> list[dict[str, Any]]:
    """What the runtime makes of the same steps."""
    player = AvatarPlayer(path, threads=1, cloth=config)
    out, motion = [], player.motion
    assert motion is not None and player._clothes is not None
    for frame, seconds in steps:
        splats = player.step(motion.frame(frame), seconds)
        driver = player._clothes._driver
        out.append({"particles": [driver.particles(g.part) for g in driver.garments], "means": splats.means.copy()})
    return out


def played(path: Path, config: DriverConfig | None, steps: list[tuple]) -> list[dict[str, Any]]:
    start = {} if config is None else {"ramp": config.ramp, "hold": config.hold}
    return node(PLAYED, given={"path": str(path), "start": start, "steps": steps})


def arrays(steps: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The page's steps in the place of the runtime's."""
    return [{"particles": [np.reshape(p, (-1, 3)) for p in step["particles"]]} for step in steps]


def differences(ours: list[dict[str, Any]], theirs: list[dict[str, Any]]) -> np.ndarray:
    """Mean distances of the particles at every step, metres."""
    return np.array(
        [
            np.mean(
                [
                    np.linalg.norm(np.reshape(a, (-1, 3)) - b, axis=1).mean()
                    for a, b in zip(one["particles"], other["particles"], strict=True)
                ]
            )
            for one, other in zip(ours, theirs, strict=True)
        ]
    )


@pytest.fixture(scope="module")
def dressed(tmp_path_factory) -> Path:
    """One skirt, and a motion of 24 frames."""
    motion = BodyParams.concatenate([swaying(k / FPS) for k in range(24)])
    return write_dressed(tmp_path_factory.mktemp("cloth") / "me.avatar", motion)


def test_constraints_are_those_of_the_driver(dressed):
    script = """
    const [garment] = (await read(given)).garments, fixed = m.pinned(garment), model = m.buildModel(garment, fixed);
    const result = { ...model, fixed, share: m.shareOf(garment) };
    for (const [name, value] of Object.entries(result)) result[name] = [...value];"""
    found = node(script, given=str(dressed))
    garment = LooseClothes(AvatarPlayer(dressed).bundle)._driver.garments[0]
    model = garment.model()
    np.testing.assert_array_equal(np.array(found["fixed"], bool), garment.pinned)
    np.testing.assert_allclose(found["share"], garment.share(), atol=1e-6)
    assert 0 < garment.pinned.sum() < len(garment.pinned) and len(model.hinges) > 100
    for own, name in (("edges", "edges"), ("hinges", "hinges"), ("anchor", "anchor")):
        np.testing.assert_array_equal(found[own], getattr(model, name).ravel(), err_msg=name)
    for own, name in (
        *(("inverseMass", "inverse_mass"), ("lengths", "lengths"), ("stretch", "stretch"), ("compress", "compress")),
        *(("curvature", "curvature"), ("restCurvature", "rest_curvature"), ("bend", "bend"), ("tether", "tether")),
        ("apart", "apart"),
    ):
        np.testing.assert_allclose(found[own], getattr(model, name).ravel(), rtol=2e-6, atol=1e-7, err_msg=name)


@pytest.mark.parametrize("config", [replace(QUICK, ramp=0.0, hold=0.0), DriverConfig()], ids=["at once", "cold"])
@pytest.mark.long
def test_the_skirt_moves_as_with_the_runtime(dressed, config):
    """To the bit while the rounding is the same, and to half a millimetre after what chaos makes of it in 1.2 s."""
    steps = [(k, 1.0 / FPS) for k in range(24)]
    ours, theirs = played(dressed, config, steps), followed(dressed, config, steps)
    found = differences(ours, theirs)
    assert found[:3].max() < 1e-6 and found.max() < 5e-4
    still = np.array(theirs[0]["particles"][0])
    assert np.linalg.norm(np.array(theirs[12]["particles"][0]) - still, axis=1).mean() > 0.02
    for one, other in zip(ours[::6], theirs[::6], strict=True):
        np.testing.assert_allclose(np.reshape(one["means"], (-1, 3)), other["means"], atol=5e-3)


@pytest.mark.long
def test_the_outer_of_two_skirts_lies_on_the_inner_one(tmp_path):
    motion = BodyParams.concatenate([swaying(k / FPS) for k in range(10)])
    path = write_dressed(tmp_path / "two.avatar", motion, layers=2)
    steps = [(k, 1.0 / FPS) for k in range(10)]
    assert differences(played(path, QUICK, steps), followed(path, QUICK, steps)).max() < 5e-4


@pytest.mark.long
def test_cuts_start_anew_and_far_away_is_as_near(tmp_path):
    """A leap of ten metres, half a second without a pose, and a walk away from the origin."""
    places = [0.0, 0.05, 10.0, 10.05, 10.1, 13.0, 15.5]
    motion = BodyParams.concatenate([standing(at=(x, 0.0, 0.0), lifted=0.2) for x in places])
    path = write_dressed(tmp_path / "far.avatar", motion)
    steps = [(0, 0.05), (1, 0.05), (2, 0.05), (3, 0.05), (4, 0.5), (5, 0.25), (6, 0.25)]
    ours, theirs = played(path, QUICK, steps), followed(path, QUICK, steps)
    assert differences(ours, theirs).max() < 5e-4
    cold = played(path, QUICK, [(2, 0.05)])
    assert differences(ours[2:3], arrays(cold)).max() == 0.0


@pytest.mark.long
def test_pictures_far_apart_are_followed_by_poses_between(dressed):
    """Pictures two a second move the skirt about as pictures twenty a second do; a second and more is a cut."""
    often = played(dressed, QUICK, [(k, 1.0 / FPS) for k in range(21)])
    seldom = played(dressed, QUICK, [(k, 10.0 / FPS, "follow") for k in range(0, 21, 10)])
    anew = played(dressed, QUICK, [(0, 0.0), (10, 1.5, "follow")])
    still = played(dressed, QUICK, [(0, 0.0, "follow"), (20, 0.0, "follow")])
    fine, moved = arrays(often[::10]), arrays(often[:1])
    assert differences(seldom, fine).max() < 0.03 < 0.06 < differences(often[10:11], moved)[0]
    assert differences(anew[1:], arrays(played(dressed, QUICK, [(10, 0.0)]))).max() == 0.0
    assert differences(still[1:], arrays(still[:1])).max() == 0.0


@pytest.mark.long
def test_a_motion_in_a_loop_starts_again_from_its_first_start(dressed):
    """Near the pose of the last cold start one step leads there; farther away the start is a cold one, to the bit."""
    looped = played(dressed, QUICK, [(0, 0.0), *((k, 1.0 / FPS) for k in range(1, 13)), (0, 99.0)])
    cold, then = arrays(looped[:1]), looped[-1:]
    assert 0.0 < differences(then, cold)[0] < 4e-3 < 0.02 < differences(looped[-2:-1], cold)[0]
    elsewhere = played(dressed, QUICK, [(0, 0.0), (12, 99.0)])
    assert differences(elsewhere[1:], arrays(played(dressed, QUICK, [(12, 0.0)])))[0] == 0.0


def changed(path: Path, out: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    """Rewrite what the garments say of themselves, and the digests over it."""
    import hashlib

    with zipfile.ZipFile(path) as old:
        files = {name: old.read(name) for name in old.namelist()}
    data = files["garments.safetensors"]
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    about = json.loads(header["__metadata__"]["about"])
    change(about)
    header["__metadata__"]["about"] = json.dumps(about)
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    files["garments.safetensors"] = data = len(text).to_bytes(8, "little") + text + data[8 + size :]
    manifest = json.loads(files["manifest.json"])
    manifest["pieces"]["garments"] |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    files["manifest.json"] = json.dumps(manifest).encode()
    with zipfile.ZipFile(out, "w") as new:
        for name, content in files.items():
            new.writestr(name, content)
    return out


# Every number other than its default, and so that a swaying skirt shows it.
OTHERS = DriverConfig(
    **{"ramp": 0.25, "ramp_step": 0.05, "hold": 0.1, "longest_step": 0.07, "teleport": 6.0, "most_stretch": 3.0},
    **{
        "most_drawn": 1.05,
        "sliver": 0.002,
        "beside": 0.02,
        "drawn_margin": 0.015,
        "least_determinant": 0.5,
        "wander": 2.0,
        "floor": 0.55,
    },
    solver=SolverConfig(
        substep=0.003, contacts_every=4, own_margin=0.005, most_speed=1.0, most_stretch=1.05, gravity=3.0
    ),
)


def told(numbers: dict[str, Any]) -> Callable[[dict[str, Any]], None]:
    """Say in a bundle how its garments are stepped."""
    return lambda about: about.update(simulation=numbers)


@pytest.mark.long
def test_the_page_and_the_runtime_step_clothes_by_the_numbers_of_the_bundle(dressed, tmp_path):
    """Eighteen of them stood in TypeScript a second time."""
    usual_numbers, others = asdict(DriverConfig()), asdict(OTHERS)
    for found, own in ((others, usual_numbers), (others["solver"], usual_numbers["solver"])):
        assert all(found[name] != value for name, value in own.items()), "a number that is not tried"
    path = changed(dressed, tmp_path / "other.avatar", told(others))
    steps = [(k, 1.0 / FPS) for k in range(12)]
    ours, theirs, usual = played(path, None, steps), followed(path, None, steps), followed(dressed, None, steps)
    assert differences(ours, theirs).max() < 5e-4
    assert differences(arrays(ours), usual).min() > 5e-3
    for one, other in zip(ours[::3], theirs[::3], strict=True):
        np.testing.assert_allclose(np.reshape(one["means"], (-1, 3)), other["means"], atol=5e-3)


@pytest.mark.long
def test_bundles_that_say_no_numbers_are_stepped_as_before(dressed, tmp_path):
    older = changed(dressed, tmp_path / "older.avatar", lambda about: about.pop("simulation"))
    empty = changed(dressed, tmp_path / "empty.avatar", told({"solver": {}}))
    steps = [(k, 1.0 / FPS) for k in range(3)]
    found = played(older, None, steps)
    assert differences(found, followed(older, None, steps)).max() < 5e-4
    assert differences(found, arrays(played(empty, None, steps))).max() == 0.0


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (told({"ramp": "long"}), "ramp"),
        (told({"solver": {"substep": 1e-9}}), "substep"),
        (told({"solver": {"contacts_every": 2.5}}), "contacts_every"),
        (told({"sliver": 0.0}), "sliver"),
        (told({"teleport": -1.0}), "teleport"),
        (told({"floor": "none"}), "floor"),
        (told({"solver": {"most_stretch": 0.5}}), "most_stretch"),
        (told({"solver": [1.0]}), "solver"),
        (told(None), "simulation"),
        (lambda about: about.update(schema=99), "version 99"),
        (lambda about: about["garments"][0]["config"].update(pin_depth="deep"), "pin_depth"),
        (lambda about: about["garments"][0]["config"]["fabric"].update(density=0.0), "density"),
        (lambda about: about["garments"].append({}), "garment 1: particles"),
        (lambda about: about.update(garments=None), "a list"),
    ],
)
def test_garments_that_do_not_fit_are_refused(dressed, tmp_path, change, word):
    path = changed(dressed, tmp_path / "other.avatar", change)
    said = node(
        "let result = ''; try { await read(given); } catch (error) { result = error.message; }", given=str(path)
    )
    assert word in said
    with pytest.raises(InputError, match=word):
        AvatarPlayer(path)
