"""The page's server: who may ask for files, who may open its websocket, what it takes from there."""

from __future__ import annotations

import http.client
import json
import random
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from smplxpp.core.files.tensor_bytes import unpack_tensors
from tests.conversation.actors import Script, cast, doll

pytest.importorskip("websockets", reason="extra chat")

from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from pipelines.web.chat_server import MOST_BYTES, REPLACED, TAKEN, ChatServer

LIMIT = 900
ROOT = Path(__file__).resolve().parents[2]


@dataclass
class Served:
    server: ChatServer
    port: int
    secret: str

    def open(self, **changes: Any) -> Any:
        given = {"path": self.secret, "host": self.host, "origin": f"http://{self.host}"}
        given |= changes
        address = f"ws://{given['host']}/{given['path']}"
        stream = socket.create_connection(("127.0.0.1", self.port))
        return connect(address, sock=stream, origin=given["origin"], max_size=None, open_timeout=LIMIT)

    @property
    def host(self) -> str:
        return f"127.0.0.1:{self.port}"

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
    assert f"connect-src 'self' ws://127.0.0.1:{served.port}" in policy
    assert b"Doll &lt;b&gt;" in page.content and served.get("/me.avatar").status == 200
    assert served.get("/", host="evil.example").status == 403
    assert served.get("/../etc/passwd").status == 404
    assert served.get(f"/{served.secret}").status == 404


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


@pytest.mark.parametrize("forwarded", [None, "localhost:9000"])  # ssh -L 9000:localhost:8091
def test_a_page_talks_and_hears(served, forwarded):
    changes = {} if forwarded is None else {"host": forwarded, "origin": f"http://{forwarded}"}
    assert f"ws://{forwarded or served.host}".encode() in served.get("/", host=forwarded).content
    with served.open(**changes) as page:
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


@pytest.fixture
def serve(tmp_path) -> Iterator[Callable[..., Served]]:
    """Serve a conversation of changed parts."""
    begun = []

    def start(*, sessions: int = 1, **changes: Any) -> Served:
        data, body = doll(tmp_path)
        server = ChatServer(data, cast(body, **changes), name="Doll", sessions=sessions)
        begun.append(server)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        it = Served(server, server.server_address[1], "")
        it.secret = re.search('data-chat="([^"]+)"', it.get("/").content.decode())[1]
        return it

    yield start
    for server in begun:
        server.shutdown()
        assert server._ended.is_set()


def test_several_talk_at_once_and_one_more_is_told_to_wait(serve):
    partner = Script(("One. ", "...", "Two."))
    it = serve(sessions=2, partner=partner)
    with it.open() as first, it.open() as second:
        for page, words in ((first, "a"), (second, "b")):
            assert told(page, "hello")
            page.send(json.dumps({"kind": "say", "text": words}))
            assert told(page, "heard")["text"] == words
            # The first one that is asked waits in its answer: that has to be the first page.
            while not partner.asked:
                time.sleep(0.01)
        assert told(second, "answered")["turn"] == 1
        with it.open() as third, pytest.raises(ConnectionClosed) as closed:
            third.recv(timeout=LIMIT)
        assert closed.value.rcvd.code == TAKEN and "2 others" in closed.value.rcvd.reason


def test_a_page_that_does_not_read_holds_nobody_up(serve):
    it = serve(partner=Script(["x" * 200 + ". "] * 20))

    def deaf() -> socket.socket:
        """A page that asks and reads nothing, behind a narrow window."""
        stream = socket.socket()
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stream.connect(("127.0.0.1", it.port))
        host = f"127.0.0.1:{it.port}"
        headers = {"Host": host, "Origin": f"http://{host}", "Upgrade": "websocket", "Connection": "Upgrade"}
        headers |= {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==", "Sec-WebSocket-Version": "13"}
        lines = [f"GET /{it.secret} HTTP/1.1", *(f"{name}: {text}" for name, text in headers.items()), "", ""]
        stream.sendall("\r\n".join(lines).encode())
        assert b"101" in stream.recv(16)
        message = b'{"kind": "say", "text": "go"}'
        stream.sendall(b"\x81" + bytes([0x80 | len(message)]) + bytes(4) + message)  # masked by zeros
        return stream

    def sent() -> int:
        """Bytes that wait for the page, when the first sentences have been made."""
        while not it.server._pages or it.server._pages[0]._unsent < 1 << 18:
            time.sleep(0.01)
        return it.server._pages[0]._unsent

    with deaf():
        sent()
        time.sleep(0.3)
        assert sent() < 3 << 20  # of 9 MB: no further sentence is made for it
        with it.open() as page:
            assert told(page, "hello")
            page.send(json.dumps({"kind": "say", "text": "hello"}))
            assert told(page, "heard")["text"] == "hello"
    with deaf():
        sent()
        it.server.shutdown()
        assert it.server._ended.is_set()


@pytest.mark.parametrize("path", [b"/\xff\xfe", b"http://["])
def test_addresses_that_are_none_are_not_found(served, path):
    with socket.create_connection(("127.0.0.1", served.port), timeout=LIMIT) as stream:
        stream.sendall(b"GET " + path + b" HTTP/1.1\r\nHost: 127.0.0.1:" + str(served.port).encode() + b"\r\n\r\n")
        assert re.match(rb"HTTP/1.1 (404|400) ", stream.recv(64))
