"""Avatars in other people's pages: the examples in a real browser, and the mouth by visemes as Python makes it."""

from __future__ import annotations

import base64
import json
import os
import subprocess
import threading
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from avatar.runtime import AvatarPlayer, load_bundle
from avatar.speech import Face, Speech, articulate
from avatar.speech.gesture_planner import GesturePlanner
from avatar.speech.phonemes import Phoneme
from pipelines.web.page import PageContent, page_files
from pipelines.web.server import PageServer
from smplxpp.body.blendshapes import ARKIT
from smplxpp.body.layout import SMPLX_JOINTS
from smplxpp.body.named_poses import ARM_JOINTS
from smplxpp.core.files.sound_file import wave_bytes
from smplxpp.core.files.tensor_bytes import unpack_tensors
from tests.web.avatars import BACKGROUND, NAME, asked, camera, decibels, motion
from tests.web.chromium import Page, find_chromium
from tests.web.modules import NEEDS_BUILD, TOOLS, WEB, node
from tests.web.test_lips import babble, dolls_lips, standing_body

NEEDS_BROWSER = pytest.mark.skipif(find_chromium() is None, reason="no Chromium here (apt-get install chromium)")
EXAMPLES = WEB.parent / "examples" / "web"
# Counts what a page has running, before any of its scripts.
COUNT = """window.running = new Set(); window.names = new Set(Object.keys(window));
window.Worker = class extends Worker {
  constructor(...args) { super(...args); running.add(this); }
  terminate() { running.delete(this); super.terminate(); } };"""


@pytest.fixture(scope="module")
def site(avatar, browser, tmp_path_factory) -> Iterator[str]:
    """The examples, the folder of `smplxpp web`, and, where npm's tools are, the package built of `web/`."""
    files = page_files(avatar.read_bytes(), PageContent(name=NAME, lips=dolls_lips(avatar)))
    files |= {name: (EXAMPLES / name).read_bytes() for name in ("plain.html", "three.html")}
    if (TOOLS / "esbuild").exists() and (WEB / "node_modules" / "three").exists():
        package = tmp_path_factory.mktemp("package") / "dist"
        files |= react_files(package)
        files |= {f"smplxpp-player/{path.name}": path.read_bytes() for path in package.glob("*.js")}
        for name in ("three.module.js", "three.core.js"):
            files[f"three/{name}"] = (WEB / "node_modules" / "three" / "build" / name).read_bytes()
    browser.send("Page.addScriptToEvaluateOnNewDocument", source=COUNT)
    with PageServer(files) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.address
        server.shutdown()


def react_files(package: Path) -> dict[str, bytes]:
    """The page of React, with the package that is built of `web/` into a new folder."""
    subprocess.run(["node", "build.mjs", "--package", str(package)], cwd=WEB, check=True, capture_output=True)
    command = [str(TOOLS / "esbuild"), str(EXAMPLES / "react" / "main.jsx"), "--bundle", "--jsx=automatic"]
    command += [f"--alias:smplxpp-player={package / 'index.js'}", "--log-level=error"]
    paths = {**os.environ, "NODE_PATH": str(WEB / "node_modules")}
    script = subprocess.run(command, env=paths, check=True, capture_output=True).stdout
    return {"main.js": script, "react.html": (EXAMPLES / "react" / "index.html").read_bytes()}


def show(page: Page, address: str, condition: str) -> None:
    """Open a page of somebody else's, and wait for something in it."""
    page.errors.clear()
    page.send("Page.navigate", url=address)
    page.until(f"document.readyState === 'complete' && ({condition})", f"{address}: {condition}")


def pixels(page: Page, expression: str, shape: tuple[int, int]) -> np.ndarray:
    """Return (H, W, 4) bytes that a promise gives."""
    text = page.evaluate(
        f"Promise.resolve({expression}).then(bytes => {{ let text = ''; for (const one of bytes)"
        " text += String.fromCharCode(one); return btoa(text); })"
    )
    return np.frombuffer(base64.b64decode(text), np.uint8).reshape(*shape, 4)


def failure(page: Page, promise: str) -> str:
    return page.evaluate(f"{promise}.then(() => 'it did not fail', error => error.message)")


@NEEDS_BROWSER
def test_a_page_without_any_build_has_two_avatars_and_loses_nothing_of_its_own(browser, site, avatar):
    other = "document.querySelector('smplxpp-avatar')"
    show(browser, site + "plain.html", f"guide.player?.pictures && {other}.avatar.player?.pictures")
    # The page keeps its names, keys and wheel.
    assert browser.evaluate("Object.keys(window).filter(name => !names.has(name) && name !== 'names')") == ["guide"]
    taken = """[...[" ", "ArrowDown", "Home"].map(key => [document.body, new KeyboardEvent("keydown", {key, ...how})]),
      [guide.canvas, new WheelEvent("wheel", how)]].filter(([target, event]) => !target.dispatchEvent(event)).length"""
    assert browser.evaluate(f"(how => {taken})({{bubbles: true, cancelable: true}})") == 0
    # What shines through is what Python leaves open.
    view, player = camera(), AvatarPlayer(avatar, threads=1)
    player.pose(motion().frame(0))
    image, alpha = player.draw(view, background=(0.0, 0.0, 0.0))
    given = json.dumps({**asked(view, 0), "background": [0, 0, 0, 0]})
    browser.evaluate("guide.pause()")
    got = pixels(browser, f"guide.player.picture({given})", image.shape[:2]) / 255.0
    assert np.abs(got[..., 3] - alpha).max() < 0.03
    assert decibels(got[..., :3], np.clip(image, 0.0, 1.0), alpha > 0.5) > 38.0
    # Poses, parts, and what they cannot be.
    joint = browser.evaluate("guide.summary.jointNames[3]")
    browser.evaluate(f"guide.pose({{joints: {{{joint}: [0.1, 0.2, 0.3]}}, expression: [0.5], translation: [1, 2, 3]}})")
    pose = "(({rotations, translation, expression}) => [...rotations.slice(9, 12), ...translation, expression[0]])"
    assert browser.evaluate(f"{pose}(guide.player.pose(0))") == [0.1, 0.2, 0.3, 1, 2, 3, 0.5]
    browser.evaluate("guide.pose(null).then(() => guide.set({parts: {[guide.summary.partNames[1]]: false}}))")
    assert browser.evaluate("[...guide.player.hidden, guide.player.held.size]") == [1, 0]
    assert 'received "tail"' in failure(browser, "guide.pose({joints: {tail: [0, 0, 0]}})")
    assert 'received "hat"' in failure(browser, "guide.set({parts: {hat: true}})")
    assert "colour" in failure(browser, "guide.set({background: 'blurple'})")
    assert "frames a second" in failure(browser, "guide.play({framesPerSecond: 0, rotations: [[]]})")
    # A motion of the page's own goes on from the pose before it, and ends.
    browser.evaluate(
        "guide.play({framesPerSecond: 20, rotations: [0, 1].map(() => [[0, 0.4, 0]])}, {loop: false})"
        ".then(() => new Promise(done => guide.on('end', done)))"
    )
    assert browser.evaluate("guide.player.motion.rotations[1] > 0.39 && !guide.player.playing")
    anybody_can_use(browser)
    assert browser.errors == []
    # Nothing is left running, however often.
    browser.evaluate(f"{other}.remove(), guide.dispose()")
    browser.evaluate(
        "(async () => { const { createAvatar } = await import('./player.js'); for (let k = 0; k < 3; ++k) {"
        " const it = createAvatar(guide.canvas, {url: 'me.avatar'}); if (k < 2) await it.ready;"
        " it.say([{viseme: 'aa', start: 0}]); it.set({background: 'red', view: 'chest'}); it.dispose(); } })()"
    )
    browser.until("running.size === 0", "a worker goes on")
    assert browser.errors == []


@NEEDS_BROWSER
def test_what_is_said_moves_the_mouth(browser, site):
    """By visemes, by a service's sound with them or without, by a browser's voice; the last one leads."""
    show(browser, site + "plain.html", "guide.summary")
    jaw = "guide.player.pose(0).rotations[3 * guide.summary.jointNames.indexOf('jaw')]"
    browser.evaluate(
        "window.told = []; window.jaws = []; guide.on('saying', () => told.push('saying'));"
        f"guide.on('said', ({{complete}}) => told.push(complete)); setInterval(() => jaws.push({jaw}), 15);"
        "guide.voice.tts = text => ({visemes: [...text].map((viseme, k) => ({viseme, start: 0.3 * k}))}); 0"
    )
    assert browser.evaluate("guide.say('apa')") is True
    assert browser.evaluate("Math.max(...jaws) > 0.05")
    assert abs(browser.evaluate(jaw)) < 1e-6
    browser.evaluate("window.one = guide.say([{viseme: 'aa', start: 0, end: 60}]); 0")
    browser.until("told.length === 3", "it does not begin")
    # The second never begins.
    more = "[one, guide.say([{viseme: 'aa', start: 0, end: 60}]), guide.say([{viseme: 21, start: 0}])]"
    assert browser.evaluate(f"Promise.all({more})") == [False, False, True]
    assert browser.evaluate("told.join()") == "saying,true,saying,false,saying,true"
    # Sound waits for a click.
    sound = json.dumps(list(wave_bytes(babble(1.2, 16_000))))
    browser.evaluate(f"window.sound = () => new Uint8Array({sound}).buffer; 0")
    browser.click("h1")
    assert browser.evaluate("jaws.length = 0, guide.say({audio: sound(), visemes: [{viseme: 'aa', start: 0}]})") is True
    assert browser.evaluate("Math.max(...jaws) > 0.05")
    assert browser.evaluate("jaws.length = 0, guide.say(sound())") is True
    assert browser.evaluate("Math.max(...jaws) > 0.02")
    # In the motion's place it stands, breathes, and its hands go with what it says.
    watched = "left_shoulder left_elbow right_elbow spine3".split()
    browser.evaluate(
        f"window.looks = []; window.at = {json.dumps(watched)}.map(name => 3 * guide.summary.jointNames.indexOf(name));"
        "window.looking = setInterval(() => { const {rotations} = guide.player.pose(0);"
        " looks.push(at.map(k => [...rotations.slice(k, k + 3)])); }, 50); guide.stand()"
    )
    assert browser.evaluate("guide.player.performer !== null && !guide.player.playing")
    browser.evaluate("new Promise(done => setTimeout(done, 1000)).then(() => { looks.length = 0; })")
    syllables = "Array.from({length: 16}, (_, k) => ({viseme: k % 2 ? 'aa' : 'PP', start: k / 4, end: k / 4 + 0.2}))"
    assert browser.evaluate(f"guide.say({syllables})") is True
    shoulder, *elbows, spine = np.ptp(np.array(browser.evaluate("looks")), axis=0)
    assert np.max([shoulder, *elbows]) > 0.3 and spine.max() > 1e-3
    browser.evaluate("clearInterval(looking); guide.play()")
    assert browser.evaluate("guide.player.performer === null && guide.player.playing")
    assert "damaged" in failure(browser, "guide.say(new ArrayBuffer(9))")
    assert "one of" in failure(browser, "guide.say([{viseme: 'QQ', start: 0}])")
    assert "neither" in failure(browser, "guide.say({})")
    # A browser's own voice, of which this one has none: first missing, then one that tells its words.
    browser.evaluate("guide.voice.tts = {}; 0")
    assert "no voice" in failure(browser, "guide.say('hello')")
    browser.evaluate(
        "Object.defineProperty(window, 'speechSynthesis', {value: {cancel() {},"
        " getVoices: () => [{name: 'x', lang: 'en'}], speak(it) { it.onstart();"
        " setTimeout(() => it.onboundary({name: 'word', charIndex: 4}), 200); setTimeout(() => it.onend(), 900); }}});"
        "jaws.length = 0"
    )
    assert browser.evaluate("guide.say('the aarhus')") is True
    assert browser.evaluate("Math.max(...jaws) > 0.05")
    assert browser.errors == []


AXE = WEB / "node_modules" / "axe-core" / "axe.min.js"
FINDINGS = """axe.run({runOnly: ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]})
  .then(({violations}) => violations.map(({id, nodes}) => [id, ...nodes.map(({html}) => html.slice(0, 100))]))"""
# What a finger is to hit and is lower than so many CSS pixels; a label is hit for its switch.
SMALL = """[...document.querySelectorAll("button, input, select")].filter(one => one.checkVisibility())
  .map(one => [one.ariaLabel || one.textContent, (one.closest("label") ?? one).getBoundingClientRect().height])
  .filter(([, height]) => height < LEAST)"""
# WCAG's contrast of an element's text on its own colour.
CONTRAST = """(one => {
  const linear = v => v > 0.04045 ? ((v + 0.055) / 1.055) ** 2.4 : v / 12.92;
  const light = text => text.match(/[0-9.]+/g).slice(0, 3).map(v => linear(v / 255))
    .reduce((sum, v, k) => sum + v * [0.2126, 0.7152, 0.0722][k], 0.05);
  const {color, backgroundColor} = getComputedStyle(one), [a, b] = [light(color), light(backgroundColor)];
  return Math.max(a, b) / Math.min(a, b);
})(document.querySelector(".speak"))"""


SIZES = [(1280, 800, 24), (390, 844, 44)]
"""CSS pixels of a window, and those that a finger needs."""


def anybody_can_use(page: Page, sizes: Sequence[tuple[int, int, int]] = SIZES) -> None:
    """Fail where axe-core, if it is there, finds something, or a finger misses, on a page as it is now."""
    if not AXE.exists():
        return
    page.evaluate(AXE.read_text() + ";0")
    for width, height, least in sizes:
        page.resize(width, height)
        assert page.evaluate(FINDINGS) == []
        assert page.evaluate(SMALL.replace("LEAST", str(least))) == []


@NEEDS_BROWSER
@pytest.mark.skipif(not AXE.exists(), reason="no axe-core: npm ci in web/")
@pytest.mark.parametrize(("width", "height", "least"), SIZES)
def test_the_players_page_is_for_keys_fingers_and_screen_readers(browser, avatar, width, height, least, tmp_path):
    """The first button was black on black, tabs knew no arrows, and a card lay below the settings.

    It looks as it did when it was last looked at.
    """
    files = page_files(
        avatar.read_bytes(), PageContent(name=NAME, sound=wave_bytes(babble(1.0, 16_000)), lips=dolls_lips(avatar))
    )
    with PageServer(files) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        browser.resize(width, height)
        browser.go(server.address)
        browser.errors.clear()
        browser.evaluate(AXE.read_text() + ";0")
        assert browser.evaluate(CONTRAST) > 4.5
        assert browser.evaluate("document.querySelector('.speak').offsetWidth") < 300
        browser.until("smplxppPlayer.player.pictures")
        browser.evaluate("document.querySelector('.rates').style.visibility = 'hidden'")  # they are never the same
        browser.looks_as_kept(f"player_{width}", tmp_path)
        assert browser.evaluate(FINDINGS) == []

        def press(key: str) -> None:
            for kind in ("keyDown", "keyUp"):
                browser.send("Input.dispatchKeyEvent", type=kind, key=key, code=key)

        browser.click(".menu")
        tabs = browser.evaluate("[...document.querySelectorAll('[role=tab]')].map(one => one.textContent)")
        assert tabs[:3] == ["Parts", "Face", "Voice"]
        browser.evaluate("document.querySelector('[role=tab]').focus()")
        chosen = "document.querySelector('[aria-selected=true]').textContent"
        browser.looks_as_kept(f"settings_{width}", tmp_path)
        for name in [*tabs[1:], tabs[0]]:
            press("ArrowRight")
            assert browser.evaluate(f"{chosen} === document.activeElement.textContent && {chosen}") == name
            assert browser.evaluate(FINDINGS) == [], name
            assert browser.evaluate(SMALL.replace("LEAST", str(least))) == [], name
        # A card is above the settings, and goes before they do.
        browser.evaluate("smplxppPlayer.open(new ArrayBuffer(9))")
        below = "(({x, width, bottom}) => document.elementFromPoint(x + width / 2, bottom - 4))"
        assert browser.evaluate(f"!!{below}(document.querySelector('.card').getBoundingClientRect()).closest('.card')")
        assert browser.evaluate(FINDINGS) == []
        for opened, gone in (("document.querySelector('.card')", 1), ("!document.querySelector('.panel').hidden", 2)):
            assert browser.evaluate(f"!!({opened})"), gone
            press("Escape")
            assert not browser.evaluate(f"!!({opened})"), gone
        assert browser.evaluate("document.activeElement.className") == "round menu"
        # Arrows turn the person where the canvas has the focus, and change nothing while a slider has it.
        turned = "smplxppPlayer.player.orbit.azimuth"
        browser.evaluate("document.querySelector('canvas').focus()")
        before = browser.evaluate(turned)
        press("ArrowRight")
        assert browser.evaluate(turned) > before
        assert browser.evaluate("document.querySelector('canvas').ariaLabel").startswith(NAME)
        assert browser.errors == []
        server.shutdown()


@NEEDS_BUILD
@NEEDS_BROWSER
def test_a_react_page_mounts_it_twice_and_keeps_one(browser, site):
    show(browser, site + "react.html", "document.querySelector('[role=status]')?.textContent.endsWith('is here')")
    assert browser.evaluate("running.size") == 1  # StrictMode mounts, unmounts and mounts
    canvas = browser.evaluate("document.querySelector('canvas').ariaLabel")
    assert canvas == NAME
    browser.click("button")
    browser.until("document.querySelector('[role=status]').textContent === 'Said'", "nothing is said")
    anybody_can_use(browser)
    assert browser.errors == []


@NEEDS_BUILD
@NEEDS_BROWSER
def test_in_a_scene_of_three_js_it_is_drawn_as_python_draws_it_with_depth(browser, site, avatar):
    show(browser, site + "three.html", "window.person?.avatar.player?.pictures > 1")
    width, height = 320, 240
    # Time stands still, and the window's size does not matter: pictures are drawn into a target of their own size.
    browser.evaluate(
        "renderer.setAnimationLoop(null); person.avatar.pause(); person.avatar.player.simulating = false;"
        f"camera.aspect = {width} / {height}; camera.updateProjectionMatrix(); renderer.setPixelRatio(1);"
        f"renderer.setSize({width}, {height}, false); person.avatar.player.seek(0);"
        "window.shot = async () => { for (let k = 0; person.material.visible && k < 3; ++k) {"
        " const before = person.avatar.player.pictures;"
        " do { renderer.render(scene, camera); await new Promise(done => setTimeout(done, 20)); }"
        " while (person.avatar.player.pictures === before); }"
        " renderer.render(scene, camera); renderer.render(scene, camera);"
        f"const gl = renderer.getContext(), out = new Uint8Array({4 * width * height});"
        f" gl.readPixels(0, 0, {width}, {height}, gl.RGBA, gl.UNSIGNED_BYTE, out); return out; }}; 0"
    )

    def inside(mask: np.ndarray) -> np.ndarray:
        return mask & np.roll(mask, 2, 1) & np.roll(mask, -2, 1) & np.roll(mask, 2, 0) & np.roll(mask, -2, 0)

    def shot(change: str) -> np.ndarray:
        browser.evaluate(f"{change}; 0")
        return pixels(browser, "shot()", (height, width))[::-1, :, :3].astype(int)

    thin = "for (const [one, x] of [[before, 0.05], [behind, -0.05]]) {"
    whole = shot(thin + " one.position.x = x; one.scale.x = one.scale.z = 0.25; }")
    gone = shot("person.material.visible = false")
    ghost = shot("person.material.visible = true; person.material.depthTest = false")
    # Edges are of both.
    red, blue = (inside(sign * (gone[..., 0] - gone[..., 2]) > 60) for sign in (1, -1))
    hers = np.abs(ghost - gone).max(axis=-1) > 40
    assert (red & hers).sum() > 20 and (blue & hers).sum() > 20  # she is behind one, and before the other
    assert np.abs(whole - gone)[red].max() <= 2
    assert np.abs(whole - ghost)[blue & ~red].max() <= 2
    # Alone before a colour she is what Python draws of the same camera.
    red_, green, blue_ = BACKGROUND
    alone = shot(
        "person.material.depthTest = true; scene.children.forEach(one => one.visible = one === person);"
        f"scene.background.setRGB({red_}, {green}, {blue_}, 'srgb')"
    )
    rows, scale, pinhole = browser.evaluate(
        "(({rows, scale, pinhole}) => [rows, scale, pinhole])(person.project(renderer, camera))"
    )
    view = np.eye(4)
    view[:3] = np.reshape(rows, (3, 4)) / scale
    K = np.array([[pinhole["fx"], 0, pinhole["cx"]], [0, pinhole["fy"], pinhole["cy"]], [0, 0, 1]])
    player = AvatarPlayer(avatar, threads=1)
    player.pose(motion().frame(0))
    seen = replace(camera(), K=K, cam_from_world=view, width=width, height=height)
    image, alpha = player.draw(seen, background=BACKGROUND)
    assert (alpha > 0.5).sum() > 200
    assert decibels(alone / 255.0, np.clip(image, 0.0, 1.0), alpha > 0.5) > 33.0  # eight bits after each splat
    anybody_can_use(browser)
    browser.evaluate("person.dispose()")
    assert browser.evaluate("[running.size, renderer.info.memory.geometries]") == [0, 3]
    assert browser.errors == []


@NEEDS_BUILD
def test_visemes_make_the_mouth_of_python():
    """Every phoneme, a diphthong, closures and gaps; names of other programs are phonemes of ours."""
    rng = np.random.default_rng(2)
    names = "SIL M AA P OW F IY CH S W UW B R AY TH ER K L V EH Y AO UH".split()
    names += "IH AE AH T JH Z HH NG D N G DH SH ZH EY AW OY".split()
    starts = np.cumsum(rng.uniform(0.05, 0.14, len(names)))
    ends = starts + np.where(rng.random(len(names)) < 0.2, 0.03, 0.05)
    times = np.arange(0.0, starts[-1] + 0.3, 1.0 / 30.0)
    phones = [{"name": n, "start": s, "end": e} for n, s, e in zip(names, starts, ends, strict=True)]
    script = """const names = ["PP", "viseme_aa", 21, "@", "DH"].map((viseme, k) => ({ viseme, start: 1 - k }));
      const ours = m.phonesOf(names).map(({ name, start, end }) => [name, start, end]);
      const spelt = m.spelt("Map, tomorrow", 0, 0, 1).map(({ name }) => name).join(" ");
      const result = { ours, spelt, mouth: given.times.map(t => [...m.articulate(given.phones, t)]) };"""
    found = node(script, given={"phones": phones, "times": times.tolist()})
    speech = Speech(tuple(Phoneme(**one) for one in phones), float(ends[-1]))
    np.testing.assert_allclose(found["mouth"], articulate(speech, times), atol=2e-5)
    assert found["ours"] == [["DH", -3, -2], ["AH", -2, -1], ["P", -1, 0], ["AA", 0, 1], ["P", 1, 1.12]]
    assert found["spelt"] == "M AE P T O M AO R R OW"


@NEEDS_BUILD
def test_a_face_with_names_of_arkit_needs_no_lips():
    """What the page knows of ARKit's expressions is what Python does, on a body with a jaw."""
    mouths = np.random.default_rng(1).random((4, 6))
    script = """const face = m.SpeakingFace.named(given.names, 1), zeros = count => new Float64Array(count);
      const pose = () => ({ rotations: zeros(6), translation: zeros(3), expression: zeros(given.names.length) });
      const posed = given.mouths.map(mouth => face.pose(mouth, pose()));
      const result = posed.map(({ expression, rotations }) => [...expression, rotations[3]]);"""
    found = np.array(node(script, given={"names": list(ARKIT), "mouths": mouths.tolist()}))
    expression, jaw = Face.of(ARKIT, ["pelvis", "jaw"]).pose(mouths, np.zeros(4))
    np.testing.assert_allclose(found, np.column_stack([expression, jaw[:, 0]]), atol=1e-9)
    assert np.ptp(expression) > 0.3


@NEEDS_BUILD
def test_hands_gesture_as_those_of_python(avatar, tmp_path):
    """With the middle of every draw, the same phonemes give the same arms; between speeches the body is Python's."""
    about, (lips, _) = load_bundle(avatar).about, unpack_tensors(dolls_lips(avatar), subject="lips")
    names = 3 * "AA T IY SIL S OW N D AH T AY SIL K EH T UW M AA L".split()
    lengths = [{"SIL": 0.5}.get(name, 0.09 + 0.03 * (k % 5)) for k, name in enumerate(names)]
    ends = np.cumsum(lengths)
    phones = [{"name": n, "start": e - d, "end": e} for n, e, d in zip(names, ends, lengths, strict=True)]
    times = np.arange(0.0, ends[-1] + 4.0, 0.05)
    script = """const lips = m.unpackTensors(Uint8Array.from(readFileSync(given.lips)), "lips");
      const middle = { uniform: (a, b) => (a + b) / 2, normal: () => 0, shuffled: n => [...Array(n).keys()] };
      const sound = new Float32Array(Uint8Array.from(readFileSync(given.sound)).buffer);
      const buffer = { sampleRate: 16000, length: sound.length, numberOfChannels: 1, getChannelData: () => sound };
      const names = given.joints, standing = m.Standing.of(lips, names, given.expressions);
      const arms = new m.Arms(standing.arms.lexicon, m.numbersOf(lips.about.gestures), middle);
      arms.plan(given.phones, 1);
      const all = given.times.map(t => arms.at(t + 1)), idle = given.frames.map(t => standing.poseAt(t));
      const result = { states: all.map(({ state }) => [...state]), beats: all.map(({ beat }) => beat),
        heard: m.syllablesOf(buffer),
        idle: idle.map(({ rotations, translation, expression }) => [...rotations, ...translation, ...expression]) };"""
    frames = [k / 15.0 for k in (0, 40, 200, 359)]
    (tmp_path / "lips").write_bytes(dolls_lips(avatar))
    given = {"lips": str(tmp_path / "lips"), "joints": about.joint_names, "expressions": len(about.expression_names)}
    given["sound"] = str(tmp_path / "sound")
    (tmp_path / "sound").write_bytes(babble(3.0, 16_000).samples.astype("<f4").tobytes())
    found = node(script, given={**given, "phones": phones, "times": times.tolist(), "frames": frames})
    middle = SimpleNamespace(
        uniform=lambda low, high: 0.5 * (low + high), normal=lambda size: np.zeros(size), permutation=np.arange
    )
    planner = GesturePlanner(standing_body())
    planner._rng = middle
    planner.plan(Speech(tuple(Phoneme(**one) for one in phones), float(ends[-1])), 1.0, more=False)
    assert len(planner.strokes) >= 2
    moved, beats = planner.at(planner.lexicon.body.standing, times + 1.0)
    rows = [SMPLX_JOINTS.index(f"{side}_{name}") - 1 for side in ("left", "right") for name in ARM_JOINTS]
    expected = np.asarray(moved.body_pose).reshape(len(times), -1, 3)[:, rows].reshape(len(times), -1)
    np.testing.assert_allclose(np.array(found["states"])[:, :18], expected, atol=1e-6)
    np.testing.assert_allclose(found["beats"], beats, atol=1e-9)
    assert np.ptp(expected, axis=0).max() > 0.5
    # Between speeches: the table's frames, arms hanging.
    whole = np.tile(lips["body.standing"].astype(float), (4, 1))
    whole[:, lips["body.columns"]] = lips["body.idle"][[0, 40, 200, 359]].astype(float)
    got = np.array(found["idle"])
    others = np.setdiff1d(np.arange(whole.shape[1]), np.add.outer(3 * np.array(rows) + 3, np.arange(3)).ravel())
    np.testing.assert_allclose(got[:, others], whole[:, others], atol=2e-3)
    assert np.ptp(got, axis=0).max() > 0.01
    # Of a sound alone syllables are heard: the babble has one every 0.4 s from 0.2 s on, 0.28 s long.
    heard = np.array([one["start"] + 0.04 for one in found["heard"] if one["name"] == "AH"])
    assert 6 <= len(heard) <= 8 and ((heard - 0.2) % 0.4 < 0.3).all()
