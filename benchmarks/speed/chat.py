"""Time each part of an answer in a conversation with a synthetic voice, and the offset of sound and poses.

    python -m benchmarks chat --avatar me.avatar [--parts spoken typed long] [--minutes 60]

A Piper voice (extra `[chat]`) says short sentences into a websocket of `smplxpp chat`'s server, as a microphone would:
in pieces of 64 ms, in real time. Rules answer. The client is no browser: "heard" is when the message with the sound has
come, "seen" when a picture of 512 x 640 was drawn by `avatar.runtime` after it. Times count from the end of the speech,
which the server finds out only after a pause that it is set to wait for. How many words were recognised is counted too.

Then the same sentences are typed, by one page and by ten at a time, which all wait for their answer: seconds from a
message until the sound of its answer has come, and the memory of the process.

In a long talk a page of headless Chromium types 200 messages, each once the answer to the last begins to be heard:
seconds until it is, memory of the server's process, of the browser and of the page's objects after some and after all
of them. With `--minutes` it types for so long, each message once the last answer was said to its end; memory is looked
at every minute from the fifth on, and two pictures a second are drawn, because a CPU draws them. Parts that are left
out keep the figures of their last measurement.
"""

from __future__ import annotations

import datetime
import difflib
import gzip
import json
import os
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
import tyro

from avatar.conversation.conversation import ChatParts
from avatar.conversation.hearing import BLOCK, RATE
from avatar.runtime import AvatarPlayer
from avatar.speech.voice import PiperVoice
from benchmarks.support.results import RESULTS, store_results
from pipelines.commands.chat import Chat
from pipelines.web.chat_server import ChatServer
from pipelines.web.page import PLAYER
from smplxpp.core.files.sound_file import Sound
from smplxpp.core.files.tensor_bytes import unpack_tensors
from smplxpp.figures import fit_cameras
from tests.web.chromium import Page

SENTENCES = (
    "What is your name?",
    "I am tired today.",
    "Tell me a story about a little dog.",
    "I want to go home.",
    "Can you help me?",
    "My brother is a good cook.",
    "Why is the sky blue?",
    "Thank you, that was nice.",
)
T = TypeVar("T")
PIECE = 1024
"""Samples of a message: 64 ms."""
SILENCE = 2.0
"""Seconds between two sentences at least."""
PAGES = 10
"""Pages that type at a time: more than a small machine has cores, by far."""
EXCHANGES, SOME, EARLY = 200, 40, 5.0
"""Messages of a long talk, and those, or the minutes, after which everything that is kept for good should be there."""


@dataclass(frozen=True)
class ChatBenchmark:
    """Speak, wait for the answer, measure, store."""

    avatar: Path
    """A bundle, NAME.avatar."""

    parts: tuple[Literal["spoken", "typed", "long"], ...] = ("spoken", "typed", "long")
    """What is measured."""
    minutes: float = 0.0
    """Length of a lasting talk, minutes; 0: none."""

    def run(self) -> None:
        """Print and store the figures."""
        import avatar

        kept = RESULTS / "chat.json"
        figures: dict[str, Any] = json.loads(kept.read_text())["figures"] if kept.exists() else {}
        figures.setdefault("a long talk", {})
        bundle = avatar.open_bundle(self.avatar)
        if self.minutes:
            figures["a long talk"] |= {"to the end": _long_talk(self.avatar, self.minutes)}
        if {"spoken", "typed"} & set(self.parts):
            command = Chat(self.avatar)
            cast = command.engines(bundle, command.partner())
            cast.voice.say("Hello.")
        if "spoken" in self.parts:
            figures |= _spoken(self.avatar, cast)
        if "typed" in self.parts:
            figures["typed"] = {f"{pages} at a time": _typed(self.avatar, cast, pages) for pages in (1, PAGES)}
        if "long" in self.parts:
            figures["a long talk"] |= {"interrupted": _long_talk(self.avatar)}
        measured = (*self.parts, *(["lasting"] if self.minutes else []))
        today = datetime.date.today().isoformat()
        figures["dates"] = {**figures.get("dates", {}), **dict.fromkeys(measured, today)}
        figures["gaussians"] = bundle.sizes["N"]
        for name, value in figures.items():
            print(f"{name:38s} {value}")
        print(f"stored {store_results('chat', 'python -m benchmarks chat --avatar me.avatar', figures).name}")


def _spoken(avatar: Path, cast: ChatParts) -> dict[str, Any]:
    """Speak the sentences and wait for the answers; return seconds by part, words recognised and seconds of CPU."""
    turns: list[dict[str, float]] = []
    server = ChatServer(avatar.read_bytes(), cast, name="benchmark", report=lambda turn: turns.append(turn.marks))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    page = _Page(server, avatar)
    right = words = 0
    for sentence in SENTENCES:
        heard = page.speak(PiperVoice(threads=1).say(sentence).sound)
        wanted = re.findall(r"[a-z']+", sentence.lower())
        matcher = difflib.SequenceMatcher(None, wanted, heard.split(), autojunk=False)
        right += sum(block.size for block in matcher.get_matching_blocks())
        words += len(wanted)
        print(f"{sentence:40s} {heard:40s} {turns[-1]}")
    page.close()
    server.shutdown()
    return {
        "sentences": len(SENTENCES),
        "words recognised": f"{right} of {words}",
        "seconds from the end of the speech": {
            part: {
                "median": round(float(np.median([turn[part] for turn in turns])), 3),
                "worst": round(max(turn[part] for turn in turns), 3),
            }
            for part in turns[0]
        },
        "seconds of CPU": _cpu(cast, page),
    }


def _connect(server: ChatServer) -> Any:
    """Open the websocket of a page."""
    from urllib.request import urlopen

    from websockets.sync.client import connect

    with urlopen(server.address) as reply:
        secret = re.search('data-chat="([^"]+)"', reply.read().decode())
    assert secret is not None
    origin = server.address.rstrip("/")
    return connect(f"{origin.replace('http', 'ws')}/{secret[1]}", origin=origin, max_size=None)


def _typed(avatar: Path, cast: ChatParts, pages: int) -> dict[str, Any]:
    """Type all sentences in each of some pages, each once the last is answered; return the seconds and the memory."""
    server = ChatServer(avatar.read_bytes(), cast, name="benchmark", sessions=pages)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    began, seconds = time.process_time(), list[float]()

    def talk() -> None:
        page = _connect(server)
        for sentence in SENTENCES:
            page.send(json.dumps({"kind": "say", "text": sentence}))
            sent, heard = time.monotonic(), 0.0
            for message in page:
                if isinstance(message, bytes):
                    heard = heard or (time.monotonic() if b'"sound"' in message[:4096] else 0.0)
                elif json.loads(message)["kind"] == "answered":
                    break
            seconds.append(heard - sent)
        page.close()

    threads = [threading.Thread(target=talk) for _ in range(pages)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    used = time.process_time() - began
    resident = _resident(os.getpid())
    server.shutdown()
    assert len(seconds) == pages * len(SENTENCES)
    return {
        "messages": len(seconds),
        "median": round(float(np.median(seconds)), 3),
        "worst": round(max(seconds), 3),
        "CPU seconds a message": round(used / len(seconds), 3),
        "resident MB": resident,
        "load of the machine": round(os.getloadavg()[0], 1),
    }


def _long_talk(avatar: Path, minutes: float = 0.0) -> dict[str, Any]:
    """Let a page of Chromium type to a server of its own process; return latencies, memory and the page's sizes.

    Args:
        avatar: the bundle. minutes: how long; 0: as many messages as are asked for, each interrupting the last answer.
    """
    command = [sys.executable, "-m", "pipelines.cli", "chat", str(avatar), "--serve", "--no-browser", "--no-token"]
    script = (
        "setInterval(() => { if (window.smplxppPlayer?.player?.pictures) window.first ??= performance.now(); }, 5);"
    )
    script += "window.requestAnimationFrame = (draw) => setTimeout(() => draw(performance.now()), 500);" * (minutes > 0)
    memory, seconds, early = list[dict[str, float]](), list[float](), min(EARLY, minutes / 2)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        address = next(found[0] for line in server.stdout if (found := re.search(r"http://\S+", line)))
        threading.Thread(target=server.stdout.read, daemon=True).start()
        try:
            with _page_at(address, script, (240, 300) if minutes else (320, 400)) as page:
                began, passed = time.monotonic(), 0.0
                while passed < minutes if minutes else len(seconds) < EXCHANGES:
                    seconds.append(page.evaluate(_TYPE % json.dumps(SENTENCES[len(seconds) % len(SENTENCES)])))
                    if minutes:
                        page.until("answered && !dialogue.stage.speaking")
                    passed = (time.monotonic() - began) / 60
                    if passed >= early + len(memory) if minutes else len(seconds) % SOME == 0:
                        memory.append({"minute": round(passed, 1), **_memory(page, server.pid)})
                        print(f"{len(seconds)} messages: {memory[-1]}", flush=True)
                shown = page.evaluate("window.first / 1000")
        finally:
            server.terminate()
    # A browser frees memory when it likes: the least of a while is what is really held.
    while_, parts = max(1, len(memory) // 6), ("server", "browser", "objects")
    return {
        "messages": len(seconds),
        "minutes": round(passed, 1),
        "median": round(float(np.median(seconds)), 3),
        "worst": round(max(seconds), 3),
        "MB at first": {part: min(row[part] for row in memory[:while_]) for part in parts},
        "MB at last": {part: min(row[part] for row in memory[-while_:]) for part in parts},
        "MB at most": {part: max(row[part] for row in memory) for part in parts},
        "seconds to the first picture": round(shown, 2),
        "kB of the player": len(PLAYER.read_bytes()) // 1000,
        "kB of it compressed": len(gzip.compress(PLAYER.read_bytes())) // 1000,
        "load of the machine": round(os.getloadavg()[0], 1),
    }


_TYPE = """new Promise(done => {
  const from = performance.now(), once = (event, act) => { const end = dialogue.on(event, () => { end(); act(); }); };
  window.answered = false;
  once("answer", () => done((performance.now() - from) / 1000));
  once("answered", () => (window.answered = true));
  dialogue.type(%s);
})"""


@contextmanager
def _page_at(address: str, script: str, size: tuple[int, int] = (320, 400)) -> Iterator[Page]:
    """Open a conversation's page with a script before its own; nothing may go wrong in it."""
    with (
        tempfile.TemporaryDirectory() as folder,
        Page(Path(folder), size=size, flags=["--enable-precise-memory-info"]) as page,
    ):
        page.send("Page.addScriptToEvaluateOnNewDocument", source=script)
        page.go(address)
        page.until("smplxppPlayer.player.pictures && document.querySelector('.times').textContent")
        page.click(".talk input")
        page.evaluate("smplxppPlayer.talking.then(({dialogue}) => { window.dialogue = dialogue; })")
        yield page
        assert not page.errors, page.errors


def _memory(page: Page, server: int) -> dict[str, float]:
    """Return MB of the server, of the browser's processes and of the page's objects."""
    page.send("HeapProfiler.collectGarbage")
    objects = page.evaluate("performance.memory.usedJSHeapSize / 1e6")
    browser = sum(_resident(process) for process in page.processes())
    return {"server": _resident(server), "browser": browser, "objects": round(objects, 1)}


def _resident(process: int) -> int:
    """Return the memory of a process, MB, without what it shares with others."""
    found = re.search(r"Pss:\s+(\d+)", Path(f"/proc/{process}/smaps_rollup").read_text())
    assert found is not None
    return int(found[1]) // 1024


class _Page:
    """A client that speaks, listens and draws."""

    def __init__(self, server: ChatServer, avatar: Path) -> None:
        self._socket = _connect(server)
        self._player = AvatarPlayer(avatar)
        motion = self._player.motion
        assert motion is not None
        points = self._player.pose(motion.frame(0)).means.astype(np.float64)
        (self._camera,) = fit_cameras(points, directions=[(0.0, 0.0, 1.0)], height=640, width=512)
        self._pose = motion.frame(0)
        self._done, self._heard = threading.Event(), list[str]()
        threading.Thread(target=self._listen, daemon=True).start()

    def speak(self, sound: Sound) -> str:
        """Say a sentence in real time; return the words that were heard, when the answer has come and is drawn."""
        samples = sound.at_rate(RATE).integers()
        quiet = np.zeros(int(SILENCE * RATE), np.int16)
        self._done.clear()
        self._heard.clear()
        whole = np.concatenate([quiet[: RATE // 2], samples, quiet])
        began = time.monotonic()
        for k in range(0, len(whole), PIECE):
            time.sleep(max(0.0, began + k / RATE - time.monotonic()))
            self._socket.send(whole[k : k + PIECE].tobytes())
        assert self._done.wait(900)
        time.sleep(SILENCE)
        return " ".join(self._heard)

    def _listen(self) -> None:
        """Take whatever comes, until the end."""
        for message in self._socket:
            if isinstance(message, str):
                told = json.loads(message)
                self._heard.extend([told["text"]] if told["kind"] == "heard" else [])
                if told["kind"] in ("latency", "note"):
                    self._done.set()
            else:
                tensors, about = unpack_tensors(message, subject="message")
                if "sound" in tensors:
                    self._tell(about["turn"], "sound")
                    self.draw()
                    self._tell(about["turn"], "picture")

    def draw(self) -> None:
        """Draw one picture."""
        self._player.pose(self._pose)
        self._player.draw(self._camera)

    def close(self) -> None:
        """Hang up."""
        self._socket.close()

    def _tell(self, turn: Any, what: str) -> None:
        self._socket.send(json.dumps({"kind": "began", "turn": turn, "what": what}))


def _cpu(cast: ChatParts, page: _Page) -> dict[str, float]:
    """Seconds of CPU of the parts on their own, means over the sentences; a block is 32 ms of sound."""
    out: dict[str, list[float]] = {}
    assert cast.recognisers is not None
    activity, animator, recogniser = cast.activity(), cast.animator(), cast.recognisers.take()

    def timed(part: str, do: Callable[[], T]) -> T:
        began = time.process_time()
        result = do()
        out.setdefault(part, []).append(time.process_time() - began)
        return result

    for sentence in SENTENCES:
        spoken = timed("voice, a sentence", lambda text=sentence: cast.voice.say(text))
        samples = spoken.sound.at_rate(RATE).integers()
        recogniser.begin()
        timed("words, while they are spoken", lambda heard=samples: recogniser.hear(heard))
        timed("words, at the end", recogniser.end)
        block = samples[RATE // 2 : RATE // 2 + BLOCK].astype(np.float32) / np.float32(32768.0)
        timed("voice activity, a block", lambda heard=block: activity(heard))
        timed("frames, a sentence", lambda speech=spoken.speech: animator.talk(speech))
        timed("picture", page.draw)
    return {part: round(float(np.mean(seconds)), 4) for part, seconds in out.items()}


if __name__ == "__main__":
    tyro.cli(ChatBenchmark, prog="python -m benchmarks chat").run()
