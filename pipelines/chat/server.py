"""Serve the page and its conversation at one port of this machine: files, and a websocket for this page alone."""

from __future__ import annotations

import json
import logging
import secrets
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus
from typing import Any

import numpy as np

from pipelines.chat.conversation import ChatParts, Conversation, Turn
from pipelines.web.page import chat_files
from pipelines.web.server import HOST, answer, at_free_port, own_hosts
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_integer, as_object, as_text, parse_json
from smplxpp.core.lazy import import_extra

MOST_BYTES = 1 << 16
"""Bytes of a message from the page: two seconds of sound."""
_PATIENCE = 1.0
"""Seconds that a page has to answer a closing message before it is cut off."""
REPLACED = 4001
"""Websocket code that closes a conversation because another page replaces it."""


class ChatServer:
    """Serve a page and converse with it until shutdown; a newer page replaces the older one.

    Args:
        bundle: bytes of the avatar's file.
        parts: engines of the conversation.
        name: title of the page.
        port: port to listen at, or the next free one; 0 for any.
        report: called with turns that were answered.

    Raises:
        InputError: no port is free.
        MissingExtraError: websockets is not installed.
    """

    def __init__(
        self,
        bundle: bytes,
        parts: ChatParts,
        *,
        name: str,
        port: int = 0,
        report: Callable[[Turn], None] = lambda _: None,
    ) -> None:
        serve = import_extra("websockets.sync.server", extra="chat", purpose="a conversation in a page").serve
        self._parts, self._report = parts, report
        self._secret = secrets.token_urlsafe(24)
        self._connection: Any = None
        log = logging.getLogger("smplxpp.chat")
        log.setLevel(logging.CRITICAL)  # disconnecting pages and plain file requests are no errors here
        options: dict[str, Any] = {"max_size": MOST_BYTES, "compression": None, "logger": log, "server_header": None}
        options["process_request"] = self._process
        options["close_timeout"] = _PATIENCE
        self._server = at_free_port(lambda at: serve(self._converse, HOST, at, **options), port)
        self._port = self._server.socket.getsockname()[1]
        sockets = [f"ws://{host}" for host in sorted(own_hosts(self._port))]
        self._files = chat_files(bundle, name=name, secret=self._secret, sockets=sockets)

    @property
    def address(self) -> str:
        """Return the address for a browser."""
        return f"http://{HOST}:{self._port}/"

    def serve_forever(self) -> None:
        """Answer requests until `shutdown`."""
        self._server.serve_forever()

    def shutdown(self) -> None:
        """End the server and the conversation."""
        if self._connection is not None:
            _end(self._connection)
        self._server.shutdown()

    def _process(self, connection: Any, request: Any) -> Any:
        """Answer a file request, or accept a websocket of this server's own page; refuse all others."""
        from websockets.datastructures import Headers
        from websockets.http11 import Response

        hosts = own_hosts(self._port)
        upgrade = request.headers.get("Upgrade", "").lower() == "websocket"
        known = secrets.compare_digest(request.path.encode(errors="surrogateescape"), f"/{self._secret}".encode())
        ours = request.headers.get("Origin", "") in {f"http://{host}" for host in hosts}
        if upgrade and known and ours and request.headers.get("Host", "") in hosts:
            return None
        if upgrade or known:
            return connection.respond(HTTPStatus.FORBIDDEN, "this conversation is of its own page alone\n")
        status, headers, body = answer(self._files, hosts, request.path, request.headers.get("Host", ""))
        return Response(status.value, status.phrase, Headers([*headers.items(), ("Connection", "close")]), body)

    def _converse(self, connection: Any) -> None:
        from websockets.exceptions import ConnectionClosed

        before, self._connection = self._connection, connection
        if before is not None:
            _end(before, REPLACED, "another page")

        def send(message: str | bytes) -> None:
            with suppress(ConnectionClosed):  # the loop that reads messages ends by itself when the page is gone
                connection.send(message)

        def tell(message: Mapping[str, Any]) -> None:
            send(json.dumps(message))

        tell({"kind": "hello", "partner": self._parts.partner.name, "hears": self._parts.recogniser is not None})
        conversation = Conversation(self._parts, tell, send, self._report)
        try:
            for message in connection:
                try:
                    _take(conversation, message)
                except InputError as error:
                    tell({"kind": "note", "text": str(error)})
        except ConnectionClosed:
            pass  # the page closed the connection, or sent a message that is too large
        finally:
            conversation.close()
            if self._connection is connection:
                self._connection = None


def _end(connection: Any, code: int = 1000, reason: str = "") -> None:
    """Close a connection; one whose page does not read is cut off after a second, because its sender blocks."""
    closing = threading.Thread(target=connection.close, args=(code, reason), daemon=True)
    closing.start()
    closing.join(_PATIENCE)
    if closing.is_alive():
        with suppress(OSError):
            connection.socket.shutdown(socket.SHUT_RDWR)


def _take(conversation: Conversation, message: str | bytes) -> None:
    """Handle one message of the page: sound, or an object with `kind`.

    Raises:
        InputError: any other message.
    """
    # Sound is 16-bit little-endian PCM; an odd last byte is half a sample and is dropped.
    if isinstance(message, bytes):
        conversation.heard(np.frombuffer(message[: len(message) // 2 * 2], "<i2").astype(np.int16))
        return
    content = as_object(parse_json(message, subject="message"), subject="message")
    kind = as_text(content.get("kind"), subject="message: kind")
    if kind == "say":
        conversation.typed(as_text(content.get("text"), subject="message: text"))
    elif kind == "stop":
        conversation.stop()
    elif kind == "mute":
        conversation.mute()
    elif kind == "began":
        turn = as_integer(content.get("turn"), subject="message: turn")
        conversation.began(turn, as_text(content.get("what"), subject="message: what"))
    else:
        raise InputError("message", expected="say, stop, mute or began", received=repr(kind[:40]))
