"""The conversation in a real browser: typed and spoken, sound and poses on one clock, interruptions, a lost socket."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np
import pytest

from smplxpp.core.files.sound_file import Sound, wave_bytes
from tests.conversation.actors import A_CHARACTER, Script, Words, cast, doll
from tests.conversation.test_listening import sound
from tests.web.chromium import Page, find_chromium
from tests.web.ear import LISTEN
from tests.web.modules import NEEDS_BUILD, node
from tests.web.test_deploy import NEEDS_NGINX, PROXIED, behind_nginx
from tests.web.test_embed import SIZES, anybody_can_use, react_files, show
from tests.web.test_lips import dolls_lips

pytest.importorskip("websockets", reason="extra chat")

from pipelines.web.chat_server import ChatServer

pytestmark = pytest.mark.skipif(find_chromium() is None, reason="no Chromium here (apt-get install chromium)")
STAGE = "window.conversation.stage"
SENTENCE = (
    2 * "This sentence is long enough that there is time to look at poses on the busiest machine, " + "isn't it? "
)
SIZE = (320, 400)
MARKUP = "<img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Page]:
    """One whose microphone hears half a second of tone after three of silence."""
    folder = tmp_path_factory.mktemp("browser")
    samples = sound(("quiet", 3.0), ("tone", 0.6), ("quiet", 120.0)).astype(np.float32) / 32768
    (folder / "said.wav").write_bytes(wave_bytes(Sound(samples, 16_000).at_rate(48_000)))
    flags = [
        *("--use-fake-device-for-media-stream", "--use-fake-ui-for-media-stream"),
        f"--use-file-for-fake-audio-capture={folder / 'said.wav'}%noloop",
    ]
    with Page(folder / "profile", size=SIZE, flags=flags) as page:
        yield page


@pytest.fixture
def talking(request, browser, tmp_path_factory) -> Iterator[tuple[Page, ChatServer]]:
    data, body = doll(tmp_path_factory.getbasetemp())
    changes = getattr(request, "param", {})
    server = ChatServer(data, cast(body, **changes), name="Doll")
    threading.Thread(target=server.serve_forever, daemon=True).start()
    browser.errors.clear()
    browser.go(server.address)
    browser.evaluate("smplxppPlayer.talking.then(it => { window.conversation = it; })")
    browser.until("document.querySelector('.times').textContent", "the server says nothing")
    yield browser, server
    server.shutdown()


def type_in(page: Page, text: str, where: str = ".talk input") -> None:
    page.evaluate(f"document.querySelector('{where}').focus()")
    page.send("Input.insertText", text=text)
    for kind in ("keyDown", "keyUp"):
        page.send("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", windowsVirtualKeyCode=13, text="\r")


def said(page: Page) -> list[str]:
    return page.evaluate("[...document.querySelectorAll('.said p')].map(one => one.textContent)")


@pytest.mark.parametrize("talking", [{"partner": Script((f"Well, {MARKUP}. ", "Yes."))}], indirect=True)
def test_what_is_typed_is_answered_and_nothing_becomes_markup(talking, tmp_path):
    page, _ = talking
    type_in(page, MARKUP)
    page.until(
        "document.querySelectorAll('.said p').length == 2 && /Yes/.test(document.querySelector('.theirs').textContent)"
    )
    assert said(page) == [MARKUP, f"Well, {MARKUP}. Yes."]
    assert page.evaluate("document.querySelectorAll('.chat img').length") == 0
    page.until("/picture [0-9.]+ s/.test(document.querySelector('.times').textContent)", "no latency is shown")
    assert page.evaluate("conversation.microphone.on") is False  # Enter is no click on it
    anybody_can_use(page)
    # Times of answers are never the same, and the avatar moves.
    page.evaluate("for (const one of ['canvas', '.times', '.rates']) document.querySelector(one).style.opacity = 0")
    for width, height, _ in SIZES:
        page.resize(width, height)
        page.looks_as_kept(f"talk_{width}", tmp_path)
    page.resize(*SIZE)
    assert page.errors == []


@pytest.mark.parametrize("talking", [{"partner": Script(("...", "Done."))}], indirect=True)
def test_a_sign_shows_that_an_answer_is_awaited(talking):
    page, _ = talking
    type_in(page, "think")
    page.until("document.querySelector('.thinking')?.getBoundingClientRect().height > 10", "no sign")
    page.evaluate("conversation.connection.send({ kind: 'stop' })")
    page.until("!document.querySelector('.thinking')", "it stays")
    type_in(page, "again")
    page.until("/Done/.test(document.querySelector('.theirs')?.textContent)")
    assert page.evaluate("document.querySelector('.thinking')") is None and page.errors == []


@pytest.mark.parametrize("talking", [{"partner": Script((SENTENCE,) * 20)}], indirect=True)
def test_sound_and_poses_are_on_one_clock_and_typing_stops_both(talking):
    """When the hum begins by the audio's time, the pose is that of the frame that it was sent with.

    All times are the audio's own, which stands still where its thread waits for a core, and the hum goes on for minutes
    until it is stopped: nothing has to happen in time. Sentences were heard that were on their way when it was stopped.
    """
    page, _ = talking
    page.click(".talk input")
    page.evaluate(
        f"""{LISTEN} window.poses = []; window.started = null;
        smplxppPlayer.player.unseen = true; // pictures take cores
        const stage = {STAGE}, pose = stage.pose.bind(stage), take = stage.take.bind(stage);
        stage.take = frames => {{ take(frames); if (frames.line) started ??= frames.first / frames.fps; }};
        stage.pose = () => {{
          const out = pose();
          const before = stage.context.currentTime, at = stage.now, after = stage.context.currentTime;
          if (after - before < 0.005) poses.push([before, at]); // else another process had the core between them
          return out;
        }};
        setInterval(() => stage.pose(), 20); // as if pictures were fast on every machine
        stage.unlock(); listen(stage.context, stage.output)"""
    )
    type_in(page, "go")
    page.until("begins.length", "nothing is heard")
    page.until("poses.filter(([now]) => now > begins[0]).length > 2")
    heard, started = page.evaluate("[begins[0], started]")
    now, stage = np.array(page.evaluate("poses"), float).T
    during = (now > heard) & (now < heard + A_CHARACTER * len(SENTENCE.strip()) - 0.1)
    # The sound's sample that leaves now, against the time that the pose is looked up at.
    apart = np.abs((now - heard) - (stage - started))[during]
    assert len(apart) > 2 and apart.max() < 0.02
    assert page.evaluate(f"{STAGE}.speaking") is True
    page.send("Input.insertText", text="w")
    page.evaluate(f"window.again = []; quiet = 0; setInterval(() => again.push({STAGE}.speaking), 5); 0")
    page.until("quiet > 0.3 && again.length > 20", "typing does not stop it")
    assert not any(page.evaluate("again"))
    assert page.errors == []


@pytest.mark.parametrize(
    "talking", [{"partner": Script(("I heard that.",)), "recogniser": Words("are you there")}], indirect=True
)
def test_what_is_spoken_into_the_microphone_is_answered(talking):
    page, _ = talking
    page.click(".microphone")
    page.until("document.querySelector('.theirs')?.textContent == 'I heard that.'", "no answer")
    assert said(page)[0] == "are you there"
    times = page.evaluate("document.querySelector('.times').textContent")
    page.until("/pause/.test(document.querySelector('.times').textContent)", times)
    page.click(".microphone")
    page.until("!conversation.microphone.on")
    assert page.errors == []


@pytest.mark.slow
@NEEDS_NGINX
def test_behind_https_it_hears_who_lets_it(tmp_path):
    """The page, its socket and its microphone behind the proxy of the examples: refused first, then allowed."""
    samples = sound(("quiet", 1.0), ("tone", 0.6), ("quiet", 120.0)).astype(np.float32) / 32768
    (tmp_path / "said.wav").write_bytes(wave_bytes(Sound(samples, 16_000).at_rate(48_000)))
    flags = [
        *(f"--host-resolver-rules=MAP {PROXIED} 127.0.0.1", "--ignore-certificate-errors"),
        *("--use-fake-device-for-media-stream", f"--use-file-for-fake-audio-capture={tmp_path / 'said.wav'}%noloop"),
    ]
    partner, words = Script(("I heard that.",)), Words("are you there")
    with (
        behind_nginx(tmp_path, partner=partner, recogniser=words) as it,
        Page(tmp_path / "profile", size=(390, 844), flags=flags) as page,
    ):

        def allow(setting: str) -> None:
            permission = {"permission": {"name": "microphone"}, "setting": setting, "origin": it.base}
            page.send("Browser.setPermission", **permission)

        page.go(f"{it.base}/talk/?token={it.token}")
        page.evaluate("smplxppPlayer.talking.then(it => { window.conversation = it; })")
        page.until("document.querySelector('.times').textContent", "the server says nothing")
        secure = page.evaluate("[location.href, isSecureContext, crossOriginIsolated]")
        assert secure == [f"{it.base}/talk/", True, True]
        assert page.evaluate("conversation.connection.socket.url").startswith(f"wss://{PROXIED}:{it.port}/talk/")
        allow("denied")
        page.click(".microphone")
        page.until("/cannot be used/.test(document.querySelector('.note').textContent)", "nothing is said")
        type_in(page, "hello")
        page.until("document.querySelector('.theirs')?.textContent == 'I heard that.'", "no answer to what is typed")
        allow("granted")
        page.click(".microphone")
        page.until("[...document.querySelectorAll('.mine')].at(-1)?.textContent == 'are you there'", "it hears nothing")
        assert page.errors == []


@pytest.mark.slow
@NEEDS_NGINX
@NEEDS_BUILD
def test_in_a_react_page_behind_https_it_answers_what_is_typed(tmp_path):
    """As somebody puts it into a page of her own: the package, the examples, nginx, a certificate."""
    flags = [f"--host-resolver-rules=MAP {PROXIED} 127.0.0.1", "--ignore-certificate-errors"]
    with (
        behind_nginx(tmp_path, token="", partner=Script(("You are in React.",))) as it,
        Page(tmp_path / "profile", size=(390, 844), flags=flags) as page,
    ):
        (tmp_path / "me.avatar").write_bytes(it.data)
        files = {**react_files(tmp_path / "package"), "me.avatar": it.data}
        files["lips.safetensors"] = dolls_lips(tmp_path / "me.avatar")
        files["index.html"] = files.pop("react.html")
        (tmp_path / "www").mkdir()
        for name, data in files.items():
            (tmp_path / "www" / name).write_bytes(data)
        show(page, f"{it.base}/", "document.querySelector('[role=status]')?.textContent.endsWith('is here')")
        page.click("button:nth-of-type(3)")
        page.until("/answers/.test(document.querySelector('output')?.textContent)", "nobody is there")
        type_in(page, "hello", "form input")
        page.until("document.querySelectorAll('li').length === 2", "no answer")
        told = page.evaluate("[...document.querySelectorAll('li')].map(one => one.textContent)")
        assert told == ["You: hello", "Avatar: You are in React."]
        assert page.errors == []


def test_a_lost_server_is_said(talking):
    page, server = talking
    server.shutdown()
    page.until("/lost/.test(document.querySelector('.note').textContent)", "nothing is said")
    type_in(page, "hello")
    assert "Nobody" in page.evaluate("document.querySelector('.note').textContent")
    # A card of its own: notes were light letters on whatever the avatar wears.
    ground, width = page.evaluate(
        "(look => [look.backgroundColor, look.width])(getComputedStyle(document.querySelector('.note')))"
    )
    assert float(ground.rsplit(",", 1)[1].rstrip(")")) > 0.85 and float(width.rstrip("px")) < SIZE[0]


def test_a_dropped_connection_comes_back(talking):
    page, _ = talking
    page.evaluate("conversation.connection.socket.close()")
    page.until("/lost/.test(document.querySelector('.note').textContent)")
    page.until("conversation.connection.open && document.querySelector('.note').textContent == ''", "it stays lost")
    type_in(page, "hello")
    page.until("/How are you/.test(document.querySelector('.theirs')?.textContent)")
    assert page.errors == []


def test_a_server_that_was_started_anew_is_found_by_pages_that_stay_open(talking, tmp_path_factory):
    """Its socket has another secret then: pages asked the old one for ever, and told people to reload them."""
    page, server = talking
    server.shutdown()
    page.until("/lost/.test(document.querySelector('.note').textContent)", "nothing is said")
    data, body = doll(tmp_path_factory.getbasetemp())
    again = ChatServer(data, cast(body, partner=Script(("I am back.",))), name="Doll", port=server.server_address[1])
    threading.Thread(target=again.serve_forever, daemon=True).start()
    page.until("conversation.connection.open && document.querySelector('.note').textContent == ''", "it stays lost")
    type_in(page, "hello")
    page.until("/back/.test(document.querySelector('.theirs')?.textContent)")
    again.shutdown()


def test_an_avatar_in_a_page_of_the_same_site_talks_with_the_server(talking):
    """Without any of the player's page: events tell what is said, and closing gives the avatar back."""
    page, _ = talking
    page.evaluate(
        "import('./player.js').then(async ({createAvatar}) => { const canvas = document.createElement('canvas');"
        " canvas.style.cssText = 'width: 100px; height: 100px'; document.body.append(canvas); window.told = [];"
        " window.guest = createAvatar(canvas, {url: 'me.avatar'}); window.dialogue = await guest.converse('./');"
        " window.early = [dialogue.connection.open, dialogue.type('hello')];"
        " for (const event of ['hello', 'heard', 'answer']) dialogue.on(event, it => told.push([event, it])); })"
    )
    page.until("window.dialogue?.stage.shown && told.length", "the server shows nobody")
    assert page.evaluate("early") == [False, True]  # what is said at once is said when somebody is there
    page.until("told.some(([event, {text}]) => event === 'answer' && /How are you/.test(text))")
    assert page.evaluate("told.map(([event]) => event).join().startsWith('hello,heard,answer')")
    assert page.evaluate("guest.player.performer !== null && (dialogue.close(), guest.player.performer === null)")
    assert "expected the page" in page.evaluate("guest.converse('player.js').catch(error => error.message)")
    page.evaluate("guest.dispose()")
    assert page.errors == []


@NEEDS_BUILD
def test_a_lower_rate_keeps_what_it_can_hold_and_no_more():
    tones = [(48_000, 1000.0), (44_100, 3000.0), (48_000, 11_000.0)]  # samples a second, Hz
    script = """const wave = (rate, hz) => (_, k) => Math.sin(2 * Math.PI * hz * k / rate);
      const tone = (rate, hz) => Float32Array.from({ length: rate }, wave(rate, hz));
      const result = given.map(([rate, hz]) => {
        const it = new m.Resampler(rate, 16000), all = tone(rate, hz), out = [];
        for (let k = 0; k < all.length; k += 128) out.push(...it.push(all.subarray(k, k + 128)));
        return out;
      });"""
    for (_, hz), got in zip(tones, node(script, given=tones), strict=True):
        middle = np.array(got)[200:-200]
        assert abs(len(got) - 16_000) < 40
        if hz > 8000:
            assert np.abs(middle).max() < 0.02
            continue
        spectrum = np.abs(np.fft.rfft(middle * np.hanning(len(middle))))
        assert np.argmax(spectrum) * 16_000 / len(middle) == pytest.approx(hz, abs=2)
        assert np.abs(middle).max() == pytest.approx(1.0, abs=0.02)
