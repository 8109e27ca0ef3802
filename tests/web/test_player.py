"""The page in a real browser: it plays what Python plays, by WebGPU and WebGL2, and says what is wrong with a file."""

from __future__ import annotations

import base64
import io
import json
import threading
import time
import zipfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from avatar.runtime import AvatarPlayer
from pipelines.web.page import PageContent, page_files, single_page
from pipelines.web.server import PageServer
from smplxpp.core.params import BodyParams
from tests.cloth.test_driver import swaying
from tests.dolls.doll import place_camera
from tests.web.avatars import (
    BACKGROUND,
    NAME,
    SWAY_FPS,
    asked,
    camera,
    decibels,
    drawn,
    write_dressed,
)
from tests.web.chromium import Page, find_chromium

pytestmark = pytest.mark.skipif(find_chromium() is None, reason="no Chromium here (apt-get install chromium)")
RENDERERS = {"webgpu": "WebGPU", "webgl2": "WebGL2"}


@pytest.fixture(scope="module", params=RENDERERS)
def player(request, browser, avatar) -> Iterator[Page]:
    """The page that a server gives, with either renderer."""
    with PageServer(page_files(avatar.read_bytes(), PageContent(name=NAME))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser.errors.clear()
        browser.go(f"{server.address}?renderer={request.param}")
        assert browser.evaluate("smplxppPlayer.player.renderer.name") == RENDERERS[request.param]
        browser.evaluate("smplxppPlayer.player.playing = false")
        yield browser
        assert browser.errors == []
        server.shutdown()


@pytest.mark.parametrize("frame", [0, 4])
def test_pictures_are_those_of_the_runtime(player, avatar, frame):
    image, alpha = drawn(avatar, frame, camera())
    inside = alpha > 0.5
    assert 0.03 < inside.mean() < 0.9
    got = player.picture(asked(camera(), frame)) / 255.0
    assert decibels(got, image, inside) > 38.0
    assert decibels(got, image, ~inside) > 38.0
    other, _ = drawn(avatar, 5 - frame, camera())
    assert decibels(got, other, inside) < 30.0  # another pose is another picture


def test_another_view_shows_other_colours(player, avatar):
    for angle in (0.0, 130.0):
        image, alpha = drawn(avatar, 2, camera(angle))
        got = player.picture(asked(camera(angle), 2)) / 255.0
        assert decibels(got, image, alpha > 0.5) > 38.0


def test_between_frames_is_between(player):
    first, half, last = (player.picture(asked(camera(), frame)).astype(float) for frame in (1, 1.5, 2))
    whole = np.abs(last - first).mean()
    assert np.abs(half - first).mean() < whole and np.abs(half - last).mean() < whole


def test_it_moves(player):
    before = player.evaluate("smplxppPlayer.player.time")
    player.evaluate("smplxppPlayer.player.playing = true")
    drawn_before = player.evaluate("smplxppPlayer.player.pictures")
    end = time.monotonic() + 300
    while player.evaluate("smplxppPlayer.player.pictures") < drawn_before + 3:
        assert time.monotonic() < end, "no pictures"
        time.sleep(0.1)
    player.evaluate("smplxppPlayer.player.playing = false")
    assert player.evaluate("smplxppPlayer.player.time") != before


def test_parts_expressions_and_joints_change_the_picture(player):
    view = asked(camera(), 1)
    plain = player.picture(view)
    change = "smplxppPlayer.player."
    for do, undo in (
        ("hidden.add(1)", "hidden.clear()"),
        ("expressions.set(0, 3)", "expressions.clear()"),
        ("turns.set(15, [0.8, 0, 0])", "turns.clear()"),
    ):
        player.evaluate(f"{change}{do}; 0")
        assert np.abs(player.picture(view).astype(int) - plain).max() > 20, do
        player.evaluate(f"{change}{undo}; 0")
        np.testing.assert_array_equal(player.picture(view), plain)


def test_a_lost_context_comes_back(player):
    view = asked(camera(), 1)
    plain = player.picture(view)
    player.evaluate(
        "smplxppPlayer.player.renderer.lose(); new Promise(done => { const look = () =>"
        " smplxppPlayer.player.renderer.lost ? setTimeout(look, 20) : done(); setTimeout(look, 200); })"
    )
    np.testing.assert_allclose(player.picture(view).astype(int), plain, atol=1)


def test_one_file_opens_from_disk_and_asks_no_network(browser, avatar, tmp_path):
    page = tmp_path / "player.html"
    page.write_bytes(single_page(avatar.read_bytes(), PageContent(name=NAME)))
    browser.errors.clear()
    browser.go(page.as_uri())
    assert browser.evaluate("document.querySelector('h1').textContent") == NAME
    # Nothing was asked for, and the CPU plays the GPU here: WebGL2 is faster on it.
    assert browser.evaluate("navigator.gpu.requestAdapter().then(adapter => !!adapter)")
    assert browser.evaluate("smplxppPlayer.player.renderer.name") == "WebGL2"
    image, alpha = drawn(avatar, 3, camera())
    assert decibels(browser.picture(asked(camera(), 3)) / 255.0, image, alpha > 0.5) > 38.0
    assert browser.evaluate("fetch('https://example.invalid').then(() => 'sent', () => 'refused')") == "refused"
    assert all("Content Security Policy" in error for error in browser.errors), browser.errors


@pytest.mark.long
def test_loose_clothes_are_simulated(browser, tmp_path):
    """A cold start and steps from there are the runtime's; live, the cloth goes on when the pose stands still."""
    path = tmp_path / "dressed.avatar"
    write_dressed(path, BodyParams.concatenate([swaying(k / SWAY_FPS) for k in range(16)]))
    page = tmp_path / "player.html"
    page.write_bytes(single_page(path.read_bytes(), PageContent(name=NAME)))
    browser.go(page.as_uri())
    browser.errors.clear()
    # What the page shows by itself between the pictures leaves the clothes alone.
    browser.evaluate("smplxppPlayer.player.playing = smplxppPlayer.player.simulating = false")
    view, player = place_camera("view", 30.0, size=(192, 256), height=0.7, target=0.7), AvatarPlayer(path, threads=1)

    def check(frame: int, got: np.ndarray) -> np.ndarray:
        image, alpha = player.draw(view, background=BACKGROUND)
        # Rounding grows from step to step.
        assert decibels(got / 255.0, np.clip(image, 0.0, 1.0), alpha > 0.5) > 35.0, frame
        return got

    motion = player.motion
    assert motion is not None
    for frame in (0, 5, 10, 15):
        player.step(motion.frame(frame), 5.0 / SWAY_FPS)
        more = {} if frame == 0 else {"seconds": 5.0 / SWAY_FPS}
        asked_for = {**asked(view, 0), "time": frame / SWAY_FPS, **more}
        simulated = check(frame, browser.picture(asked_for))
    player.pose(motion.frame(15))
    skinned = check(15, browser.picture({**asked_for, "seconds": None}))
    assert np.abs(simulated.astype(int) - skinned).max() > 50
    browser.evaluate("smplxppPlayer.player.simulating = true")
    for change, pictures in (("update()", 1), ("turns.set(1, [-0.8, 0, 0]), smplxppPlayer.player.update()", 4)):
        before = browser.evaluate(f"smplxppPlayer.player.pictures + 0 * [smplxppPlayer.player.{change}].length")
        end = time.monotonic() + 300
        while browser.evaluate("smplxppPlayer.player.pictures") < before + pictures:
            assert time.monotonic() < end, "the cloth does not go on"
            time.sleep(0.1)
    assert browser.evaluate("[...document.querySelectorAll('.switch')].at(-1).textContent") == "Clothes are simulated"
    assert browser.errors == []


def damaged(avatar: Path) -> dict[str, tuple[bytes, str]]:
    """Files that are no avatars, and a word of what is to be said of each."""
    whole = avatar.read_bytes()

    def changed(name: str, change) -> bytes:
        out = io.BytesIO()
        with zipfile.ZipFile(avatar) as old, zipfile.ZipFile(out, "w") as new:
            for entry in old.namelist():
                new.writestr(entry, change(old.read(entry)) if entry == name else old.read(entry))
        return out.getvalue()

    def newer(text: bytes) -> bytes:
        return json.dumps({**json.loads(text), "version": 99}).encode()

    return {
        "truncated": (whole[: len(whole) // 2], "cut off"),
        "tampered": (changed("gaussians.safetensors", lambda data: data[:-1] + b"\x01"), "digest"),
        "newer": (changed("manifest.json", newer), "version 99"),
        "foreign": (b"solid ascii stl" * 100, "another file"),
        "another zip": (changed("manifest.json", lambda _: b"{}"), "another archive"),
        "nothing": (b"", "another file"),
    }


@pytest.mark.parametrize("kind", ["truncated", "tampered", "newer", "foreign", "another zip", "nothing"])
def test_what_is_wrong_with_a_file_is_said(browser, avatar, tmp_path, kind):
    data, word = damaged(avatar)[kind]
    page = tmp_path / "player.html"
    if not browser.evaluate("!!window.smplxppPlayer"):
        page.write_bytes(single_page(avatar.read_bytes(), PageContent(name=NAME)))
        browser.go(page.as_uri())
    browser.errors.clear()
    text = base64.b64encode(data).decode()
    browser.evaluate(f"smplxppPlayer.open(Uint8Array.from(atob('{text}'), c => c.charCodeAt(0)).buffer)")
    said = browser.evaluate("document.querySelector('.card.failed')?.innerText")
    assert said is not None and word in said, said
    assert browser.errors == []
