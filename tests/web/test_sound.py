"""A page whose motion has a sound: both together by the sound's own clock, measured on what is heard."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from avatar.runtime.bundle import load_bundle, save_with_motion
from pipelines.web.page import PageContent, page_files, single_page
from pipelines.web.server import PageServer
from smplxpp.core.files.sound_file import Sound, wave_bytes
from smplxpp.core.params import BodyParams
from tests.dolls.dancing import dance
from tests.web.avatars import NAME, write_avatar
from tests.web.chromium import Page, find_chromium
from tests.web.ear import LISTEN

CLICKS = (0.7, 1.9)
SECONDS, RATE = 3.0, 22050
TOGETHER = 0.04
PLAY, CLOCK = "button.speak", "smplxppPlayer.player.clock"
# What the clock answers at which of the audio's times.
WATCH = f"""{LISTEN} window.answers = [];
const clock = {CLOCK}, own = clock.at.bind(clock);
clock.at = (playing, time, speed) => {{
  const answer = own(playing, time, speed);
  if (playing && clock.source) answers.push([clock.context.currentTime, clock.context.outputLatency || 0, answer]);
  return answer;
}};
clock.unlock(); listen(clock.context, clock.output)"""


def clicks() -> Sound:
    samples = np.zeros(int(SECONDS * RATE), np.float32)
    for at in CLICKS:
        samples[int(at * RATE) : int(at * RATE) + 400] = 0.9
    return Sound(samples, RATE)


@pytest.fixture(scope="module")
def talking(tmp_path_factory) -> Path:
    """The doll with a motion of its own as long as the sound."""
    folder = tmp_path_factory.mktemp("talking")
    write_avatar(folder / "doll.avatar")
    motion = dance()
    slow = replace(motion, fps=(len(motion) - 1) / SECONDS)
    save_with_motion(folder / "talking.avatar", folder / "doll.avatar", slow)
    return folder / "talking.avatar"


def test_a_bundle_takes_another_motion_and_keeps_the_rest(talking):
    new, old = load_bundle(talking), load_bundle(talking.with_name("doll.avatar"))
    assert new.about == old.about and new.tensors.keys() == old.tensors.keys()
    for name, value in old.tensors.items():
        np.testing.assert_array_equal(new.tensors[name], value)
    motion = BodyParams.from_mapping(new.motion, source="bundle")
    assert len(motion) == len(dance()) and motion.fps == pytest.approx((len(motion) - 1) / SECONDS)


def test_pages_carry_the_sound(talking):
    sound = wave_bytes(clicks())
    files = page_files(b"bundle", PageContent(name=NAME, sound=sound))
    assert files["sound.wav"] == sound and b'data-sound="sound.wav"' in files["index.html"]
    page = single_page(b"bundle", PageContent(name=NAME, sound=sound)).decode()
    assert page.count("</script>") == 3 and "connect-src 'none'" in page
    assert b"data-sound" not in page_files(b"bundle", PageContent(name=NAME))["index.html"]


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Page]:
    if find_chromium() is None:
        pytest.skip("no Chromium here (apt-get install chromium)")
    with Page(tmp_path_factory.mktemp("browser"), size=(320, 240)) as page:
        yield page


@pytest.fixture
def page(browser, talking) -> Iterator[Page]:
    browser.errors.clear()
    with PageServer(page_files(talking.read_bytes(), PageContent(name=NAME, sound=wave_bytes(clicks())))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser.go(server.address)
        yield browser
        server.shutdown()
    assert browser.errors == []


def test_sound_and_motion_are_together(page):
    """It waits for a click, plays once, and the pose is at the time of the click that is heard."""
    assert page.evaluate("smplxppPlayer.player.playing") is False
    assert page.evaluate(f"getComputedStyle(document.querySelector('{PLAY}')).display") != "none"
    page.click("h1")  # somewhere: the browser lets it be heard from now on
    page.evaluate(WATCH)
    page.click(PLAY)
    page.until("answers.length && !smplxppPlayer.player.playing", "it never ends")
    heard, answers = page.evaluate("begins"), np.array(page.evaluate("answers"), float)
    assert len(heard) == len(CLICKS) and page.evaluate("smplxppPlayer.player.time") == 0.0
    now, latency, pose = answers.T
    going = (pose > 0.05) & (pose < SECONDS)
    assert going.any()
    for at, click in zip(heard, CLICKS, strict=True):
        sound = now[going] - latency[going] - at + click
        assert np.abs(sound - pose[going]).max() < TOGETHER


def test_a_seek_and_a_speed_take_the_sound_along(page):
    page.click("h1")
    page.evaluate(WATCH)
    page.click(PLAY)
    page.until("smplxppPlayer.player.time > 0.1")
    page.click(".bar .play")
    page.until("!smplxppPlayer.player.playing")
    # By the audio's clock: on a busy machine the page may tell late what was heard early.
    silent_from = page.evaluate(f"{CLOCK}.context.currentTime") + 0.3
    page.evaluate("new Promise(done => setTimeout(done, 300))")
    paused = page.evaluate("smplxppPlayer.player.time")
    page.evaluate("answers.length = 0; new Promise(done => setTimeout(done, 300))")
    assert page.evaluate("smplxppPlayer.player.time") == paused
    assert max(page.evaluate("begins"), default=0.0) < silent_from
    page.evaluate("smplxppPlayer.player.speed = 0.5; smplxppPlayer.player.seek(1.6); 0")
    page.click(".bar .play")
    page.until("answers.length && !smplxppPlayer.player.playing")
    heard, answers = page.evaluate("begins"), np.array(page.evaluate("answers"), float)
    heard = [at for at in heard if at >= silent_from]
    assert len(heard) == 1, heard  # the first click lies before
    now, latency, pose = answers[(answers[:, 2] > 1.65) & (answers[:, 2] < SECONDS)].T
    sound = CLICKS[1] + 0.5 * (now - latency - heard[0])
    assert len(pose) and np.abs(sound - pose).max() < TOGETHER


def test_one_file_plays_its_sound_from_disk(browser, talking, tmp_path):
    (tmp_path / "player.html").write_bytes(
        single_page(talking.read_bytes(), PageContent(name=NAME, sound=wave_bytes(clicks())))
    )
    browser.errors.clear()
    browser.go((tmp_path / "player.html").as_uri())
    assert browser.evaluate("smplxppPlayer.player.playing") is False
    browser.click(PLAY)
    browser.until("smplxppPlayer.player.time > 0.2", "it does not play")
    assert browser.evaluate(f"{CLOCK}.context.state") == "running"
    assert browser.evaluate(f"{CLOCK}.seconds") == pytest.approx(SECONDS, abs=0.01)
    assert browser.errors == []


def test_a_damaged_sound_is_said_and_the_motion_plays(browser, talking, tmp_path):
    (tmp_path / "player.html").write_bytes(single_page(talking.read_bytes(), PageContent(name=NAME, sound=b"no sound")))
    browser.errors.clear()
    browser.go((tmp_path / "player.html").as_uri())
    browser.click(PLAY)
    browser.until("document.querySelector('.card.failed')", "nothing is said")
    assert "sound" in browser.evaluate("document.querySelector('.card.failed').innerText")
    browser.until("smplxppPlayer.player.time > 0.2", "it does not play")
    assert browser.errors == []
