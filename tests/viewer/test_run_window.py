"""A run in the viewer, without a browser: what of it is drawn, what the controls do, and a training looked at."""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
import urllib.request
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from avatar.gaussians.tensor_file import save_bound
from avatar.models.model_file import save_avatar
from avatar.training.engine.checkpoints import Checkpoint, save_checkpoint
from pipelines.cli import main
from pipelines.commands import view as view_command
from pipelines.runs.layout import GAUSSIANS, STUDENT
from pipelines.viewer.run_models import covariances, training_now
from pipelines.viewer.run_session import open_run
from pipelines.viewer.run_window import RunWindow, open_run_window
from smplxpp.core import InputError, matrix_from_rotvec
from smplxpp.core.colors import linear_from_srgb
from smplxpp.core.light import Irradiance, Relighting
from tests.dolls.dancing import dance, gaussians, template, varied, write_dance, write_dance_run
from tests.runtime.bundles import student
from tests.viewer.test_window import free_port
from tests.web.chromium import Page, find_chromium


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A run with a student, beside the capture that it was trained on."""
    folder = tmp_path_factory.mktemp("viewed")
    run = write_dance_run(folder / "run")
    (run / STUDENT).parent.mkdir()
    save_avatar(run / STUDENT, student("whole"))
    write_dance(folder / "capture")
    return run


@pytest.fixture
def window(trained):
    one = open_run_window(open_run(trained, template(), capture=trained.parent / "capture"), port=free_port())
    yield one
    one.close()


def said(window: RunWindow, of: str = "_status") -> str:
    """What a text of the window shows: markdown without the backslashes that make it plain."""
    return getattr(window, of).content.replace("\\", "")


def points(window: RunWindow) -> np.ndarray:
    """(N, 3) where the scene has the Gaussians."""
    return window.scene._nodes["/gaussians"].buffer[:, :3].copy().view(np.float32)


def test_a_trained_run_shows_gaussians_first_and_its_layers_on_demand(window):
    assert window.server.get_host() == "127.0.0.1"
    browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    with browser.open(window.address, timeout=60) as answer:
        assert answer.status == 200
    assert window.scene.names == ("/gaussians",)
    assert "frame 0 of capture" in said(window) and "90_compensate" in said(window)
    for name in ("body", "dress"):
        window._layers[name].value = True
    window._redraw()
    assert set(window.scene.names) == {"/gaussians", "/template/body", "/template/dress"}
    window._layers["body"].value = False
    window._splats.value = False
    window._redraw()
    assert window.scene.names == ("/template/dress",)


def test_frames_are_gone_through(window):
    first = points(window)
    window._frame.value = 3
    window._go()
    assert "frame 3" in said(window)
    truth = window.session.player.pose(dance().frame(3), frame=3).means
    np.testing.assert_allclose(points(window), truth, atol=1e-6)
    assert np.abs(points(window) - first).max() > 0.02
    window._play.value = True
    end = time.monotonic() + 300.0
    while window.session.at == 3 and time.monotonic() < end:
        time.sleep(0.05)
    assert window.session.at != 3


def test_photographs_stand_where_their_cameras_did(window):
    assert window.scene.photographs == 0
    window._photographs.value = True
    window._photograph(step_back=True)
    assert window.scene.photographs == len(window.session.capture.cameras) == 5
    for camera, node in window.scene._frusta:
        np.testing.assert_allclose(node.position, camera.position)
        turn = np.roll(np.array(node.wxyz), -1)
        assert node.image.shape[:2] == (camera.height, camera.width) and node.image.max() > 100
        looks = matrix_from_rotvec(_rotvec(turn))[:, 2]
        np.testing.assert_allclose(looks, camera.forward, atol=1e-6)
    window._photographs.value = False
    window._photograph()
    assert window.scene.photographs == 0


def _rotvec(xyzw: np.ndarray) -> np.ndarray:
    sine = np.linalg.norm(xyzw[:3])
    return xyzw[:3] / max(sine, 1e-12) * 2.0 * np.arctan2(sine, xyzw[3])


def test_joints_and_expressions_are_moved_by_hand_and_taken_back(window):
    before = points(window)
    window._turned.value = "head"
    window._axes[1].value = 60.0
    window._turn()
    params = window.session.params
    own, turned = (matrix_from_rotvec(one.full_pose[0, 15]) for one in (dance().frame(0), params))
    np.testing.assert_allclose(own.T @ turned, matrix_from_rotvec(np.array([0.0, np.pi / 3, 0.0])), atol=1e-9)
    others = np.delete(params.full_pose - dance().frame(0).full_pose, 15, axis=1)
    assert not others.any() and np.abs(points(window) - before).max() > 0.05 and "by hand" in said(window)
    name = window.session.expressions[0]
    window._faces[name].value = 2.0
    window._express(name)
    assert window.session.params.expression[0, 0] == pytest.approx(dance().expression[0, 0] + 2.0)
    window._reset()
    np.testing.assert_allclose(points(window), before, atol=1e-6)
    assert "by hand" not in said(window)


def test_colours_of_layers(window):
    session, it = window.session, template()
    head = it.body.joint_names.index("head")
    heat = session.colors("one joint", "head").astype(int).sum(axis=1)
    weights = it.weights.dense()[:, head]
    assert heat[weights > 0.9].max() < heat[weights < 0.1].min()  # dark where it pulls
    assert (session.colors("photograph") == it.vertex_colors).all()
    assert len(np.unique(session.colors("labels"), axis=0)) > 1
    window._layers["body"].value = True
    for coloring in ("labels", "weights", "one joint"):
        window._coloring.value = coloring
        window._recolor()
        assert window._joint.visible == (coloring == "one joint") and "error" not in said(window)


def test_a_run_with_a_template_alone(tmp_path):
    session = open_run(write_dance_run(tmp_path / "run"), template())
    window = open_run_window(session, port=free_port())
    try:
        assert set(window.scene.names) == {"/template/body", "/template/dress"} and window._splats.disabled
        assert "T-pose" in said(window) and "no Gaussians" in said(window) and "none is" in window._training.content
        np.testing.assert_allclose(session.vertices(), template().vertices, atol=1e-9)
    finally:
        window.close()


def test_a_motion_that_is_given(trained, tmp_path):
    replace(dance(), fps=25.0).save(tmp_path / "m.npz")
    session = open_run(trained, template(), params=tmp_path / "m.npz")
    assert session.motion.fps == 25.0 and len(session.motion.numbers) == 6 and not session.motion.photographed
    with pytest.raises(InputError):
        open_run(trained, template(), capture=tmp_path)


def test_another_light(trained):
    dark = Relighting(Irradiance.uniform(0.25), Irradiance.uniform())
    window = open_run_window(open_run(trained, template(), relighting=dark), port=free_port())
    try:
        assert window._light.visible
        lit = colors(window)
        window._light.value = False
        window._relight()
        plain = colors(window)
        np.testing.assert_allclose(linear_from_srgb(lit), 0.25 * linear_from_srgb(plain), atol=1e-3)
    finally:
        window.close()


# --- a training that goes on -----------------------------------------------------------------------------------------


def begin(run: Path, stage: str, step: int) -> Path:
    """What a training of a stage has left after some steps."""
    work = run / f"{stage}_work"
    (work / "previews").mkdir(parents=True, exist_ok=True)
    lines = [{"kind": "evaluation", "iteration": 0, "mean": {"psnr": 20.5}}, {"kind": "step", "iteration": step}]
    lines[-1] |= {"loss": 0.25, "psnr_crop": 31.5}
    (work / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    Image.fromarray(np.full((8, 24, 3), step % 256, np.uint8)).save(work / "previews" / "Cam_000001.png")
    return work


def test_a_training_is_followed(tmp_path):
    run = write_dance_run(tmp_path / "run")
    session = open_run(run, template())
    window = open_run_window(session, port=free_port())
    try:
        begin(run, "70_fit", 10)
        window.look_again()
        told = said(window, "_training")
        assert "70_fit" in told and "step 10" in told and "31.5 dB" in told and "step 0: 20.5 dB" in told
        assert (window._preview.image == 10).all() and window._preview.visible
        # A folder's name is no markup, which would run as a script beside a person's data.
        nested = run / "70_fit_work" / "<img src=x onerror=alert(1)>"
        nested.mkdir()
        (run / "70_fit_work" / "metrics.jsonl").rename(nested / "metrics.jsonl")
        window.look_again()
        assert "<img" in said(window, "_training").replace("&lt;", "<") and "<" not in window._training.content
        shutil.rmtree(nested)
        work = begin(run, "70_fit", 200)
        later = time.time() + 5.0
        os.utime(work / "previews" / "Cam_000001.png", (later, later))
        window.look_again()
        assert (window._preview.image == 200).all() and "no Gaussians" in said(window)
        # The stage is done: its Gaussians show without a new start.
        shutil.rmtree(work)
        (run / GAUSSIANS).parent.mkdir()
        save_bound(varied(gaussians()), run / GAUSSIANS)
        window.look_again()
        assert "/gaussians" in window.scene.names and "70_fit" in said(window)
        assert not window._splats.disabled and "none is" in window._training.content
        before = colors(window)
        # The next one has a checkpoint: its attributes take their place.
        work = begin(run, "80_teacher", 30)
        state = {"gaussians.dc.dc": torch.full((400, 3), 0.9), "gaussians.sh.sh": torch.zeros(1)}
        save_checkpoint(work / "state.safetensors", Checkpoint(30, 1.0, "k", state))
        window.look_again()
        assert "80_teacher` has them so far" in said(window) and np.abs(colors(window) - before).max() > 0.1
        (work / "state.safetensors").write_bytes(b"half a file")
        window.look_again()
        assert "error" not in said(window)
    finally:
        window.close()


def colors(window: RunWindow) -> np.ndarray:
    """(N, 3) sRGB of the Gaussians in the scene."""
    return window.session.splats(np.array([0.0, 0.5, 3.0])).colors


def test_a_training_that_stands_still_says_so(tmp_path):
    begin(tmp_path, "85_bake", 7)
    assert "stopped" not in str(training_now(tmp_path))
    assert "nothing for 60 minutes" in str(training_now(tmp_path, clock=time.time() + 3600.0))
    (tmp_path / "85_bake_work" / "metrics.jsonl").unlink()
    assert training_now(tmp_path) is None
    (tmp_path / "85_bake_work" / "stage.json").write_text("{}")
    assert "begun" in str(training_now(tmp_path))


def test_a_broken_model_is_told_in_the_window(trained, tmp_path):
    run = shutil.copytree(trained, tmp_path / "run")
    window = open_run_window(open_run(run, template()), port=free_port())
    try:
        (run / STUDENT).write_bytes(b"no model")
        window.look_again()
        assert "error" in said(window)
    finally:
        window.close()


def test_covariances_are_those_of_turned_ellipsoids():
    quats = np.array([[1.0, 0, 0, 0], [np.cos(0.4), 0, 0, np.sin(0.4)]])
    scales = np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 3.0]])
    plain, turned = covariances(2.0 * quats, scales)
    np.testing.assert_allclose(plain, np.diag([1.0, 4.0, 9.0]))
    R = matrix_from_rotvec(np.array([0.0, 0.0, 0.8]))
    np.testing.assert_allclose(turned, R @ plain @ R.T, atol=1e-12)


# --- the command -----------------------------------------------------------------------------------------------------


def test_the_command_serves_until_it_is_interrupted(trained, monkeypatch, capsys):
    addresses = []
    monkeypatch.setattr(view_command, "wait", lambda: (_ for _ in ()).throw(KeyboardInterrupt))
    monkeypatch.setattr("webbrowser.open_new_tab", addresses.append)
    port = free_port()
    capture = trained.parent / "capture"
    assert main(["view", str(trained), "--capture", str(capture), "--port", str(port), "--json"]) == 0
    out = json.loads(capsys.readouterr().out)
    assert addresses[0].startswith(f"http://localhost:{port}/?token=")
    assert out["frames"] == 6 and out["gaussians"] == "90_compensate"
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        one.bind(("127.0.0.1", port))  # it is free again
    assert main(["view", str(trained / "nothing")]) == 2 and "smplxpp build" in " ".join(
        capsys.readouterr().err.split()
    )


@pytest.mark.skipif(find_chromium() is None, reason="no Chromium")
@pytest.mark.long
def test_a_browser_shows_the_person(window, tmp_path):
    with Page(tmp_path, (900, 600)) as page:
        page.send("Page.navigate", url=window.address)
        end = time.monotonic() + 600.0
        share = 0.0
        while time.monotonic() < end and share < 0.02:
            time.sleep(1.0)
            page.screenshot(tmp_path / "shot.png")
            left = np.asarray(Image.open(tmp_path / "shot.png").convert("RGB"))[150:, :500].astype(int)
            share = float((np.abs(left - left[0, 0]).max(axis=2) > 40).mean())
        assert share >= 0.02, "nothing of the person in the window"
        assert not [error for error in page.errors if "uncaught" in error.lower()]
