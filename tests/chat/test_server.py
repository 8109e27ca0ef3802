"""The page's server: who may ask for files, who may open its websocket, what it takes from there."""

from __future__ import annotations

import http.client
import json
import random
import re
import socket
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

from smplxpp.core.files.tensor_bytes import unpack_tensors
from tests.chat.actors import cast, doll

pytest.importorskip("websockets", reason="extra chat")

from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from pipelines.chat.server import MOST_BYTES, REPLACED, ChatServer, _end

LIMIT = 900


@dataclass
class Served:
    server: ChatServer
    port: int
    secret: str

    def open(self, **changes: Any) -> Any:
        given = {"path": self.secret, "host": f"127.0.0.1:{self.port}", "origin": f"http://127.0.0.1:{self.port}"}
        given |= changes
        address = f"ws://{given['host']}/{given['path']}"
        stream = socket.create_connection(("127.0.0.1", self.port))
        return connect(address, sock=stream, origin=given["origin"], max_size=None, open_timeout=LIMIT)

    def get(self, path: str, host: str | None = None) -> http.client.HTTPResponse:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=LIMIT)
        connection.request("GET", path, headers={} if host is None else {"Host": host})
        reply = connection.getresponse()
        reply.content = reply.read()
        connection.close()
        return reply


@pytest.fixture(scope="module")
def served(tmp_path_factory) -> Iterator[Served]:
    data, body = doll(tmp_path_factory.mktemp("doll"))
    server = ChatServer(data, cast(body), name="Doll <b>")
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    port = int(server.address.split(":")[2].strip("/"))
    it = Served(server, port, "")
    page = it.get("/").content.decode()
    it.secret = re.search('data-chat="([^"]+)"', page)[1]
    yield it
    server.shutdown()
    thread.join(LIMIT)


def told(connection: Any, kind: str) -> dict:
    """The next message of a kind."""
    while True:
        message = connection.recv(timeout=LIMIT)
        if isinstance(message, str) and json.loads(message)["kind"] == kind:
            return json.loads(message)


def test_it_gives_its_page_to_this_machine_alone(served):
    page = served.get("/")
    assert page.status == 200 and page.headers["Cross-Origin-Resource-Policy"] == "same-origin"
    policy = re.search('Content-Security-Policy" content="([^"]+)"', page.content.decode())[1]
    assert f"connect-src 'self' ws://127.0.0.1:{served.port} ws://localhost:{served.port}" in policy
    assert b"Doll &lt;b&gt;" in page.content and served.get("/me.avatar").status == 200
    assert served.get("/", host="evil.example").status == 403
    assert served.get("/../etc/passwd").status == 404
    assert served.get(f"/{served.secret}").status == 403


@pytest.mark.parametrize(
    "changes",
    [
        {"origin": "https://evil.example"},
        {"origin": "null"},
        {"origin": None},
        {"path": "wrong"},
        {"path": ""},
        {"host": "evil.example", "origin": "http://evil.example"},
    ],
)
def test_no_other_page_may_talk(served, changes):
    with pytest.raises(InvalidStatus) as refused:
        served.open(**changes)
    assert refused.value.response.status_code == 403


def test_a_page_talks_and_hears(served):
    with served.open() as page:
        assert told(page, "hello")["hears"] is True
        page.send(json.dumps({"kind": "say", "text": "hello"}))
        assert told(page, "heard")["text"] == "hello"
        while True:
            message = page.recv(timeout=LIMIT)
            if isinstance(message, bytes) and "sound" in (got := unpack_tensors(message, subject="message"))[0]:
                break
        assert got[1]["text"] == "Hello there." and got[0]["rows"].dtype == "f4"


@pytest.mark.parametrize(
    ("message", "word"),
    [
        ("no json", "JSON"),
        ("[]", "object"),
        ("{}", "text"),
        ('{"kind": "shout"}', "shout"),
        ('{"kind": "say", "text": 7}', "text"),
        ('{"kind": "say", "text": "' + "x" * 3000 + '"}', "characters"),
        ('{"kind": "began", "turn": "one", "what": "sound"}', "turn"),
    ],
)
def test_what_makes_no_sense_is_said_and_the_conversation_goes_on(served, message, word):
    with served.open() as page:
        page.send(message)
        assert word in told(page, "note")["text"]
        page.send(b"\x01")
        page.send(json.dumps({"kind": "stop"}))
        page.send(json.dumps({"kind": "say", "text": "hello"}))
        assert told(page, "heard")["text"] == "hello"


def test_random_messages_do_no_harm(served):
    draw = random.Random(0)
    with served.open() as page:
        told(page, "hello")
        for _ in range(200):
            data = draw.randbytes(draw.randrange(200))
            page.send(data if draw.random() < 0.5 else data.decode("latin-1"))
        page.send(json.dumps({"kind": "say", "text": "still there"}))
        while told(page, "heard")["text"] != "still there":
            pass


def test_a_large_message_ends_the_conversation(served):
    with served.open() as page:
        page.send(b"\0" * (MOST_BYTES + 1))
        with pytest.raises(ConnectionClosed) as closed:
            while True:
                page.recv(timeout=LIMIT)
        assert closed.value.rcvd.code == 1009


def test_the_newest_page_takes_over(served):
    with served.open() as first:
        told(first, "hello")  # else the second one's thread may come first, and it is the older page
        with served.open() as second:
            with pytest.raises(ConnectionClosed) as closed:
                while True:
                    first.recv(timeout=LIMIT)
            assert closed.value.rcvd.code == REPLACED
            second.send(json.dumps({"kind": "say", "text": "mine"}))
            assert told(second, "heard")["text"] == "mine"


@pytest.mark.parametrize("path", [b"/\xff\xfe", b"http://["])
def test_addresses_that_are_none_are_not_found(served, path):
    with socket.create_connection(("127.0.0.1", served.port), timeout=LIMIT) as stream:
        stream.sendall(b"GET " + path + b" HTTP/1.1\r\nHost: 127.0.0.1:" + str(served.port).encode() + b"\r\n\r\n")
        assert re.match(rb"HTTP/1.1 (404|400) ", stream.recv(64))


def test_a_connection_that_does_not_close_is_cut_off():
    class Stuck:
        """A connection whose closing blocks until its socket is shut."""

        def __init__(self) -> None:
            self.shut = threading.Event()
            self.socket = SimpleNamespace(shutdown=lambda _: self.shut.set())

        def close(self, code: int, reason: str) -> None:
            self.shut.wait(LIMIT)

    stuck = Stuck()
    _end(stuck)
    assert stuck.shut.is_set()
