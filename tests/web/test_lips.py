"""Live sound moves the mouth in the page: the same numbers as Python's, a microphone, a file, and what goes wrong."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from avatar.driving import stance_of
from avatar.runtime import load_bundle
from avatar.speech import ARTICULATORS, Face, StandingBody
from avatar.speech.audio_features import FRAME, RATE, log_mel
from avatar.speech.lips import PHONES, WEIGHTS, LipNetwork, smooth_mouth
from pipelines.commands.talk import write_talking_page
from pipelines.web.page import PageContent, lips_of, page_files, single_page
from pipelines.web.server import PageServer
from smplxpp.body import load_body
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.body.retarget import Skeleton
from smplxpp.core.files.sound_file import Sound, wave_bytes
from smplxpp.core.params import BodyParams
from tests.dolls.dancing import dance
from tests.web.avatars import NAME
from tests.web.chromium import Page, find_chromium
from tests.web.ear import LISTEN
from tests.web.modules import NEEDS_BUILD, node

JAW, PRESS = ARTICULATORS.index("jaw"), ARTICULATORS.index("press")
LIPS = "smplxppPlayer.player.lips"
VOICE_TAB = "[...document.querySelectorAll('.tabs button')].find(one => one.textContent === 'Voice')"


def babble(seconds: float = 3.0, rate: int = RATE, level: float = 0.3) -> Sound:
    """Two vowels by two resonances of a buzz, with closures and noise between them, from a fixed seed."""
    rng, count = np.random.default_rng(4), int(seconds * rate)
    times = np.arange(count) / rate
    samples = np.zeros(count)
    for k, at in enumerate(np.arange(0.2, seconds - 0.5, 0.4)):
        inside = (times >= at) & (times < at + 0.28)
        since = times[inside] - at
        first, second = ((750.0, 1150.0), (320.0, 2300.0))[k % 2]
        for harmonic in range(1, 30):
            hertz = 118.0 * harmonic
            gain = sum(1.0 / (1.0 + ((hertz - centre) / 90.0) ** 2) for centre in (first, second))
            samples[inside] += gain * np.sin(2.0 * np.pi * hertz * since) * np.sin(np.pi * since / 0.28)
    samples += 0.02 * rng.standard_normal(count)
    return Sound((level * samples / np.abs(samples).max()).astype(np.float32), rate)


@NEEDS_BUILD
def test_the_page_hears_what_python_hears(tmp_path):
    """Features and network, in pieces of any length, from stored weights."""
    sound = babble()
    (tmp_path / "sound").write_bytes(sound.samples.astype("<f4").tobytes())
    script = """const network = new m.LipNetwork(m.unpackTensors(new Uint8Array(readFileSync(given.weights)), "lips"));
    const ear = new m.Ear(), steady = new m.Steady();
    const result = { rows: [], phones: [], mouth: [], steady: [], delay: network.delay };
    const samples = new Float32Array(new Uint8Array(readFileSync(given.sound)).buffer);
    const lengths = [1, 7, 160, 300, 1024, 5000];
    for (let at = 0, k = 0; at < samples.length; at += lengths[k++ % 6]) {
      ear.push(samples.subarray(at, at + lengths[k % 6]), (row) => {
        const { phones, mouth } = network.push(row);
        result.rows.push([...row]); result.phones.push([...phones]); result.mouth.push([...mouth]);
        result.steady.push([...steady.push(mouth)]);
      });
    }"""
    found = node(script, given={"weights": str(WEIGHTS), "sound": str(tmp_path / "sound")})
    rows = log_mel(sound.samples)
    np.testing.assert_allclose(found["rows"], rows, atol=1e-4)
    network = LipNetwork.shipped()
    heard = network(sound)
    skipped = round(network.delay / FRAME) - 1  # rows that tell of times before the sound
    count = len(rows) - skipped
    assert found["delay"] == network.delay and len(found["mouth"]) == len(rows)
    assert np.asarray(found["phones"]).shape == (len(rows), len(PHONES))
    np.testing.assert_allclose(np.array(found["phones"])[skipped:], heard.phones[:count], atol=1e-4)
    np.testing.assert_allclose(np.array(found["mouth"])[skipped:], heard.mouth[:count], atol=1e-4)
    assert np.ptp(heard.mouth[:, JAW]) > 0.2
    np.testing.assert_allclose(found["steady"], smooth_mouth(np.array(found["mouth"])), atol=1e-5)


@NEEDS_BUILD
@pytest.mark.parametrize("jaw", [0.0, 0.05])
def test_the_page_moves_a_face_as_python_does(tmp_path, jaw):
    body = load_body()
    seen = BodyParams.rest(betas=0, expressions=52).select([0, 0, 0])
    expression = 0.3 * np.random.default_rng(2).random((3, 52))
    seen = replace(seen, expression=expression, jaw_pose=np.array([[jaw, 0.01, 0.0]] * 3))
    face = Face.of(body.expression_names, body.joint_names, seen)
    path = tmp_path / "lips.safetensors"
    path.write_bytes(lips_of(face))
    mouths = np.random.default_rng(3).random((6, 6))
    mouths[0], mouths[1, :] = 0.0, [0.0, 1.0, 0.0, 0.0, 0.0, 0.0]
    script = """const piece = m.unpackTensors(new Uint8Array(readFileSync(given.path)), "lips");
    const face = new m.SpeakingFace(piece, 52, 1), translation = new Float64Array(3);
    const blank = { rotations: new Float64Array(9), translation, expression: new Float64Array(52) };
    const result = given.mouths.map((mouth) => {
      const { expression, rotations } = face.pose(mouth, blank);
      return [[...expression], [...rotations]];
    });"""
    found = node(script, given={"path": str(path), "mouths": mouths.tolist()})
    wanted, turns = face.pose(mouths, np.zeros(6))
    moved = np.abs(face.basis).max(axis=0) > 0.0
    got = np.array([one[0] for one in found])
    np.testing.assert_allclose(got[:, moved], wanted[:, moved], atol=1e-9)
    assert 8 < moved.sum() < 52 and not got[:, ~moved].any()  # the rest stays the motion's
    rotations = np.array([one[1] for one in found])
    np.testing.assert_allclose(rotations[:, 3:6], turns, atol=1e-9)
    assert not rotations[:, [0, 1, 2, 6, 7, 8]].any()
    with pytest.raises(Exception, match="returned non-zero"):
        node(script.replace("piece, 52, 1", "piece, 50, 1"), given={"path": str(path), "mouths": []})


def dolls_face(data: Path) -> Face:
    """A face for the doll's expressions: its jaw alone opens, its first expression presses."""
    count = len(load_bundle(data).about.expression_names)
    basis = np.zeros((6, count))
    basis[PRESS, 0] = 0.7
    zeros = np.zeros(count)
    return Face(
        **{"arkit": np.zeros((52, count)), "basis": basis, "blink": zeros, "neutral": zeros, "lowest": zeros},
        **{"highest": zeros + 1.0, "jaw": np.zeros(3), "jaw_reach": 0.15},
    )


@cache
def standing_body() -> StandingBody:
    """The open body with hanging arms: the doll's legs are points, on which nobody stands."""
    body, pose = load_body(), np.zeros((21, 3))
    pose[[SMPLX_JOINTS.index("left_shoulder") - 1, SMPLX_JOINTS.index("right_shoulder") - 1], 2] = -0.9, 0.9
    return StandingBody.of(Skeleton.of(body), replace(BodyParams.rest(), body_pose=pose.reshape(1, 63)))


@cache
def dolls_lips(data: Path) -> bytes:
    """How the doll's mouth speaks and its hands gesture, for a page."""
    face = dolls_face(data)
    return lips_of(face, stance_of(face, standing_body(), load_body()))


@pytest.fixture(scope="module")
def listening(tmp_path_factory) -> Iterator[Page]:
    """A browser whose microphone hears babble, and who is always allowed to listen."""
    if find_chromium() is None:
        pytest.skip("no Chromium here (apt-get install chromium)")
    folder = tmp_path_factory.mktemp("browser")
    (folder / "heard.wav").write_bytes(wave_bytes(babble(4.0, 48_000)))
    flags = (
        *("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"),
        f"--use-file-for-fake-audio-capture={folder / 'heard.wav'}",
    )
    with Page(folder, size=(320, 240), flags=flags) as page:
        yield page


@pytest.fixture(scope="module")
def deaf(tmp_path_factory) -> Iterator[Page]:
    """A browser without a microphone."""
    if find_chromium() is None:
        pytest.skip("no Chromium here (apt-get install chromium)")
    with Page(tmp_path_factory.mktemp("deaf"), size=(320, 240)) as page:
        yield page


def opened(browser: Page, avatar: Path) -> PageServer:
    browser.errors.clear()
    server = PageServer(page_files(avatar.read_bytes(), PageContent(name=NAME, lips=dolls_lips(avatar))))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    browser.go(server.address)
    browser.click("h1")
    return server


@pytest.mark.long
def test_the_microphone_moves_the_mouth_and_nothing_else(listening, avatar):
    server = opened(listening, avatar)
    try:
        assert listening.evaluate(f"!!{VOICE_TAB} && {LIPS}.source === ''")
        before = listening.evaluate(
            "smplxppPlayer.player.playing = false; JSON.stringify(smplxppPlayer.player.pose(0))"
        )
        listening.evaluate(f"{LIPS}.listen()")
        assert listening.evaluate(f"{LIPS}.source") == "microphone"
        jaw = "smplxppPlayer.player.pose(0).rotations[3 * smplxppPlayer.player.summary.jointNames.indexOf('jaw')]"
        listening.evaluate(f"window.seen = []; window.watch = setInterval(() => seen.push([...{LIPS}.mouth()]), 20); 0")
        listening.until(f"Math.max(...seen.map(m => m[{JAW}])) - Math.min(...seen.map(m => m[{JAW}])) > 0.2")
        has_jaw = listening.evaluate("smplxppPlayer.player.summary.jointNames.includes('jaw')")
        if has_jaw:
            listening.until(f"{jaw} > 0.02", "the jaw does not hang")
        listening.until("smplxppPlayer.player.pictures > 2")
        listening.evaluate(f"clearInterval(watch); {LIPS}.stop(); 0")
        listening.until(f"!{LIPS}.on")
        assert listening.evaluate("JSON.stringify(smplxppPlayer.player.pose(0))") == before
        assert listening.errors == []
    finally:
        server.shutdown()


def test_a_file_is_heard_and_the_mouth_is_with_it(listening, avatar):
    """What the page shows at a time of the file is what Python says of that time."""
    sound = babble(3.0, 44_100)
    server = opened(listening, avatar)
    try:
        samples = list(wave_bytes(sound))
        listening.evaluate(
            f"window.data = new Uint8Array({samples}).buffer; window.answers = []; {LISTEN}"
            f"{LIPS}.play(data, 'babble.wav').then(() => listen({LIPS}.context, {LIPS}.output)).then(() => 0)"
        )
        assert listening.evaluate(f"{LIPS}.source") == "file"
        listening.evaluate(
            f"const now = () => [{LIPS}.played, ...{LIPS}.mouth()];"
            f"window.watch = setInterval(() => {LIPS}.source && answers.push(now()), 15); 0"
        )
        listening.until(f"{LIPS}.source === ''", "it never ends")
        listening.evaluate("clearInterval(watch); 0")
        answers = np.array(listening.evaluate("answers"), float)
        heard = LipNetwork.shipped()(sound)
        truth = smooth_mouth(heard.mouth)[:, JAW]
        inside = (answers[:, 0] > 0.1) & (answers[:, 0] < 2.8)
        assert inside.sum() > 5 and np.ptp(truth) > 0.2
        wanted = np.interp(answers[inside, 0], heard.times, truth)
        # The page has its own way to 16 kHz.
        assert np.abs(answers[inside, 1 + JAW] - wanted).mean() < 0.05
        assert listening.evaluate("begins.length") > 2  # it is heard, too
        assert "is over" in listening.evaluate("document.querySelector('.panel').textContent")
        assert listening.errors == []
    finally:
        server.shutdown()


def test_what_goes_wrong_is_said(deaf, avatar):
    """No microphone, a file that is none, a silent one: words in the page, and it plays on."""
    server = opened(deaf, avatar)
    try:
        said = "document.querySelector('.panel [role=status]').textContent"
        deaf.evaluate(f"{LIPS}.listen()")
        assert "microphone cannot be used" in deaf.evaluate(said)
        deaf.evaluate(f"{LIPS}.play(new Uint8Array(50).buffer, 'noise.bin')")
        assert "noise.bin is damaged" in deaf.evaluate(said)
        silence = list(wave_bytes(Sound(np.zeros(8000, np.float32), 16_000)))
        deaf.evaluate(f"{LIPS}.play(new Uint8Array({silence}).buffer, 'quiet.wav')")
        assert "quiet.wav is silent" in deaf.evaluate(said)
        assert deaf.evaluate(f"{LIPS}.source === '' && !{LIPS}.on")
        pictures = deaf.evaluate("smplxppPlayer.player.pictures")
        deaf.until(f"smplxppPlayer.player.pictures > {pictures}", "it does not play on")
        assert deaf.errors == []
    finally:
        server.shutdown()


def test_one_file_has_it_and_a_page_without_lips_has_no_voice(deaf, avatar, tmp_path):
    whole, bare = tmp_path / "whole.html", tmp_path / "bare.html"
    whole.write_bytes(single_page(avatar.read_bytes(), PageContent(name=NAME, lips=dolls_lips(avatar))))
    bare.write_bytes(single_page(avatar.read_bytes(), PageContent(name=NAME)))
    deaf.go(whole.as_uri())
    assert deaf.evaluate(f"!!{LIPS} && !!{VOICE_TAB}")
    assert deaf.evaluate(f"{LIPS}.mouth().every(value => value === 0)")
    deaf.go(bare.as_uri())
    assert deaf.evaluate(f"{LIPS} === null && !{VOICE_TAB}")


def test_a_page_that_talks_has_live_lips_too(deaf, avatar, tmp_path):
    """It had the sound alone, and no Voice among its settings."""
    sound, lips = babble(1.0, 16_000), dolls_lips(avatar)
    for path in (tmp_path / "page.html", tmp_path / "folder"):
        write_talking_page(path, avatar, dance(), sound, name=NAME, lips=lips)
    deaf.go((tmp_path / "page.html").as_uri())
    assert deaf.evaluate(f"!!{LIPS} && !!{VOICE_TAB} && !!smplxppPlayer.player.clock")
    assert (tmp_path / "folder" / "lips.safetensors").read_bytes() == lips
    assert (tmp_path / "folder" / "sound.wav").read_bytes() == wave_bytes(sound)


def test_damaged_lips_are_said(deaf, avatar, tmp_path):
    (tmp_path / "page.html").write_bytes(
        single_page(avatar.read_bytes(), PageContent(name=NAME, lips=dolls_lips(avatar)[:5000]))
    )
    deaf.go((tmp_path / "page.html").as_uri())
    deaf.until("document.querySelector('.card.failed')")
    assert "lips" in deaf.evaluate("document.querySelector('.card.failed').innerText")
