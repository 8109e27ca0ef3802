"""A language model's address: what it may answer, and what is said when it does not."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import ClassVar

import pytest

from avatar.conversation.answers import Endpoint
from smplxpp.core.errors import InputError

HISTORY = [("user", "hello"), ("assistant", "hi"), ("user", "and?")]


def event(content: str | None) -> bytes:
    return b"data: " + json.dumps({"choices": [{"delta": {"content": content}}]}).encode() + b"\n\n"


def stream(*pieces: str | None) -> bytes:
    return b"".join(map(event, pieces)) + b"data: [DONE]\n\n"


THOUGHT = ("Okay, I must", " not tell. </b> 1 < 2.", "\n")
STREAMS = {
    "tags": ["<think>", *THOUGHT, "</think>", "\n\nGood. 1 < 2."],
    "cut": ["<thi", "nk>\n", *THOUGHT, "</th", "ink>Good. 1 < 2."],
    "unopened": [*THOUGHT, "</think>\nGood. ", "1 < 2."],
    "brackets": ["[THINK]", *THOUGHT, "[/THINK]Good. 1 < 2."],
    "triangles": ["\u25c1think\u25b7", *THOUGHT, "\u25c1/think\u25b7Good. 1 < 2."],
    "channels": [
        "<|channel|>analysis<|message|>",
        *THOUGHT,
        "<|end|><|start|>assistant<|channel|>final<|message|>Good. 1 < 2.",
    ],
    "twice": ["<thinking>a</thinking>Good. ", "<Thinking>b</Thinking>1 < 2."],
    "none": ["Good. ", "1 <", " 2."],
}


class _Model(BaseHTTPRequestHandler):
    asked: ClassVar[dict] = {}

    def do_POST(self) -> None:
        body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        _Model.asked = {"path": self.path, "key": self.headers.get("Authorization"), **body}
        kind = self.path.split("/")[1]
        whole = {"choices": [{"message": {"content": "Good. Bye."}}]}
        answers = {
            "sse": event(None)
            + b": comment\n\n"
            + event("Good")
            + event(". Bye.")
            + b'data: {"choices": []}\n\ndata: [DONE]\n\n',
            "whole": json.dumps(whole).encode(),
            "garbage": b"<html>not found</html>",
            "list": b"[1, 2]",
            "empty": b"data: [DONE]\n\n",
            "error": b'data: {"error": {"message": "out of memory"}}\n\n',
            "number": b'{"choices": [{"message": {"content": 7}}]}',
            "long": b"data: " + b"x" * (1 << 19),
            "hang": event("So"),
            "breaks": event("One. ") + event("Two"),
            "thoughts": stream("<think>", *THOUGHT),
            "emoji": b'data: {"choices": [{"delta": {"content": "Hi \\ud83d"}}]}\n\n'
            b'data: {"choices": [{"delta": {"content": "\\ude00!"}, "finish_reason": "stop"}]}\n\n',
            "nulls": b'data: {"choices": [{"delta": null}], "error": null}\n\ndata: {"choices": null}\n\n'
            + stream("Hi"),
            "new_names": stream("Hi"),
            "no_names": stream("Hi"),
        }
        answers |= {name: stream(*pieces) for name, pieces in STREAMS.items()}
        known = {"new_names": ("max_completion_tokens",), "no_names": ()}.get(kind, ("max_tokens",))
        unknown = [name for name in body if name.endswith("_tokens") and name not in known]
        if unknown:
            self.send_response(400)
            self.end_headers()
            advice = f" Use '{known[0]}' instead." if known else ""
            self.wfile.write(f'{{"error": {{"message": "Unsupported parameter: \'{unknown[0]}\'.{advice}"}}}}'.encode())
            return
        self.send_response(503 if kind == "status" else 200)
        streamed = kind not in ("status", "whole", "garbage", "list", "number")
        self.send_header("Content-Type", "text/event-stream" if streamed else "application/json")
        self.end_headers()
        self.wfile.write(answers.get(kind, b"busy <b>now</b>"))
        if kind == "hang":
            self.wfile.flush()
            time.sleep(3.0)

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    with ThreadingHTTPServer(("127.0.0.1", 0), _Model) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


@pytest.mark.parametrize("kind", ["sse", "whole"])
def test_it_is_asked_with_the_conversation_and_answers(address, kind):
    partner = Endpoint(f"{address}/{kind}/v1", model="small", key="secret")
    # The first answer is held back, because only its end tells that it began without thoughts.
    for count in (1, 2 if kind == "sse" else 1):
        pieces = list(partner.answer(HISTORY))
        assert "".join(pieces) == "Good. Bye." and len(pieces) == count
    asked = _Model.asked
    assert asked["path"] == f"/{kind}/v1/chat/completions" and asked["model"] == "small"
    assert asked["messages"][0]["role"] == "system"
    assert [(one["role"], one["content"]) for one in asked["messages"][1:]] == HISTORY
    assert asked["key"] == "Bearer secret" and "secret" not in repr(partner)
    list(Endpoint(f"{address}/{kind}/v1/chat/completions").answer(HISTORY))
    assert _Model.asked["path"] == f"/{kind}/v1/chat/completions" and _Model.asked["key"] is None


@pytest.mark.parametrize(
    ("kind", "word"),
    [
        ("status", "503 busy"),
        ("garbage", "JSON"),
        ("list", "object"),
        ("empty", "none"),
        ("error", "out of memory"),
        ("number", "a text"),
        ("long", "MiB"),
    ],
)
def test_what_is_no_answer_is_said(address, kind, word):
    with pytest.raises(InputError, match=word):
        list(Endpoint(f"{address}/{kind}").answer(HISTORY))


@pytest.mark.parametrize("kind", list(STREAMS))
def test_thoughts_are_no_words(address, kind):
    partner = Endpoint(f"{address}/{kind}/v1")
    for _ in range(2):  # the second answer is no longer held back
        assert "".join(partner.answer(HISTORY)).strip() == "Good. 1 < 2."
    with pytest.raises(InputError, match="thoughts alone"):
        list(Endpoint(f"{address}/thoughts/v1").answer(HISTORY))


@pytest.mark.parametrize(
    ("kind", "words"), [("emoji", "Hi \U0001f600!"), ("nulls", "Hi"), ("new_names", "Hi"), ("no_names", "Hi")]
)
def test_answers_of_other_servers_are_understood(address, kind, words):
    partner = Endpoint(f"{address}/{kind}/v1")
    assert ["".join(partner.answer(HISTORY)) for _ in range(2)] == [words, words]
    bounds = {"new_names": {"max_completion_tokens"}, "no_names": set()}.get(kind, {"max_tokens"})
    assert {name for name in _Model.asked if name.endswith("_tokens")} == bounds


def test_an_answer_that_breaks_off_keeps_what_came(address):
    words = []
    with pytest.raises(InputError, match="breaks off"):
        words.extend(Endpoint(f"{address}/breaks").answer(HISTORY))
    with closing(Endpoint(f"{address}/breaks").answer(HISTORY)) as came:
        assert next(came) == "One. Two"


def test_one_that_hangs_is_left(address):
    words = []
    with pytest.raises(InputError, match="silence"):
        words.extend(Endpoint(f"{address}/hang", silent=0.2).answer(HISTORY))
    with pytest.raises(InputError, match="an answer"):
        list(Endpoint("http://127.0.0.1:9").answer(HISTORY))


def test_a_cancelled_answer_ends_at_once(address):
    partner, ended = Endpoint(f"{address}/hang", silent=900.0), threading.Event()
    partner._thoughts.opened_before = False  # as after an answer without thoughts: nothing is held back
    first = threading.Event()

    def ask() -> None:
        try:
            for _ in partner.answer(HISTORY):
                first.set()
        except InputError:
            pass
        ended.set()

    threading.Thread(target=ask, daemon=True).start()
    assert first.wait(900)
    partner.another().cancel()  # of another conversation
    assert not ended.wait(0.1)
    began = time.monotonic()
    partner.cancel()
    assert ended.wait(900) and time.monotonic() - began < 2.5  # it would be silent for longer


@pytest.mark.parametrize(
    "url", ["", "localhost:80", "ftp://a/b", "http://", "http://a b/", "http://a:99999/", "file:///etc"]
)
def test_what_is_no_address_is_refused(url):
    with pytest.raises(InputError, match="llm"):
        Endpoint(url)
