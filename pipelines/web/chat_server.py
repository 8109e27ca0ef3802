"""Serve the page and its conversations: files, and a websocket for each page of the server's own."""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from http import HTTPStatus
from typing import Any

import numpy as np

from avatar.conversation.conversation import ChatParts, Conversation, Turn
from pipelines.web.access import Access
from pipelines.web.page import INDEX, chat_files
from pipelines.web.server import ENDING, PageServer, Request, write_all
from smplxpp.core.errors import InputError
from smplxpp.core.files.json_file import as_integer, as_object, as_text, parse_json
from smplxpp.core.lazy import import_extra

MOST_BYTES = 1 << 16
"""Bytes of a message from the page: two seconds of sound."""
REPLACED = 4001
"""Websocket code that closes a conversation because another page replaces it."""
TAKEN = 4002
"""Websocket code that refuses a page because all places are taken; it asks again by itself."""
_QUIET = 600.0
"""Seconds without a message after which a page gives its place up to another one; a person who reads needs minutes."""
_ROOM = 1 << 18
"""Bytes not yet taken by a page, above which no further sentence is made for it: three seconds of speech."""
_MOST_UNSENT = 8 << 20
"""Bytes not yet taken at which a page is cut off; the longest sentence has 3 MiB."""
_LISTENING = 20.0
"""Seconds of silence after which a page is asked whether it is there, below the 60 s of common proxies."""


class ChatServer(PageServer):
    """Serve a page and converse with those who open it, until shutdown.

    With one place a newer page replaces the older one; with more, a page that finds all taken waits.

    Args:
        bundle: bytes of the avatar's file.
        parts: engines of the conversations.
        name: title of the page.
        port: port to listen at, or the next free one; 0 for any.
        report: called with turns that were answered.
        access: who may ask.
        sessions: conversations at a time.

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
        access: Access | None = None,
        sessions: int = 1,
    ) -> None:
        import_extra("websockets.server", extra="chat", purpose="a conversation in a page")
        self._parts, self._report, self._sessions = parts, report, sessions
        self._secret = secrets.token_urlsafe(24)
        self._pages: list[_Page] = []
        self._leaving: set[threading.Thread] = set()
        self._pool = ThreadPoolExecutor(sessions + 1, thread_name_prefix="conversation")
        access = access or Access()

        def page(host: str) -> bytes:
            return chat_files(bundle, name=name, secret=self._secret, sockets=access.sockets(host))[INDEX]

        files = chat_files(bundle, name=name, secret=self._secret, sockets=())
        super().__init__({**files, INDEX: page}, access=access, port=port)

    async def _end(self) -> None:
        """Take leave of the pages, then end what still runs."""
        leaving = [asyncio.create_task(page.end(1001, "the server ends")) for page in self._pages]
        if leaving:
            await asyncio.wait(leaving, timeout=ENDING)
        await super()._end()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def shutdown(self) -> None:
        """End all conversations and the server, within a second of computation."""
        super().shutdown()
        # A voice is code that the end of the process must not find at work.
        for thread in list(self._leaving):
            thread.join(2.0)

    async def _upgrade(
        self, request: Request, name: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Converse with a page of this server; refuse all others."""
        host, origin = request.headers.get("host", ""), request.headers.get("origin", "")
        known = secrets.compare_digest(name.encode(errors="surrogateescape"), self._secret.encode())
        if not known or not self.access.own_page(host, origin):
            await self._respond(writer, HTTPStatus.FORBIDDEN, b"this conversation is of its own page alone\n")
            return
        page = _Page(reader, writer)
        if not await page.accept(request.raw):
            return
        if not self._make_room():
            words = (
                f"{self._sessions} others are talking here" if self._sessions > 1 else "another page is talking here"
            )
            await page.end(TAKEN, words)
            return
        self._pages.append(page)
        try:
            await self._converse(page)
        finally:
            page.leave()
            if page in self._pages:
                self._pages.remove(page)

    def _make_room(self) -> bool:
        """Return whether there is a place, after the page that has been quiet for longest has left its own."""
        if len(self._pages) < self._sessions:
            return True
        page = min(self._pages, key=lambda one: one.heard)
        if self._sessions > 1 and asyncio.get_running_loop().time() - page.heard < _QUIET:
            return False
        self._pages.remove(page)
        leaving = asyncio.create_task(page.end(REPLACED, "another page"))
        self._tasks.add(leaving)
        leaving.add_done_callback(self._tasks.discard)
        return True

    async def _converse(self, page: _Page) -> None:
        def tell(message: Mapping[str, Any]) -> None:
            page.send(json.dumps(message))

        writing = asyncio.create_task(page.write())
        parts = self._parts
        tell({"kind": "hello", "partner": parts.partner.name, "hears": parts.recognisers is not None})
        # What computes does so in a thread of the page's own; the next message waits for it.
        made = self._pool.submit(Conversation, parts, tell, page.send, self._report, page.wait_for_room)
        try:
            conversation = await asyncio.wrap_future(made)
            async for message in page.messages():
                await asyncio.wrap_future(self._pool.submit(_take, conversation, message, tell))
        finally:
            page.leave()
            writing.cancel()
            made.add_done_callback(self._close)

    def _close(self, made: Future[Conversation]) -> None:
        """End a conversation beside everything else: its voice may be within a sentence."""

        def close() -> None:
            made.result().close()
            self._leaving.discard(thread)

        if not made.cancelled() and made.exception() is None:
            thread = threading.Thread(target=close, daemon=True)
            self._leaving.add(thread)
            thread.start()


class _Page:
    """The websocket of a page: what waits to be taken by it, and the messages that it sends."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        from websockets.server import ServerProtocol

        log = logging.getLogger("smplxpp.chat")
        log.setLevel(logging.CRITICAL)  # pages that disconnect are no errors here
        self._protocol = ServerProtocol(max_size=MOST_BYTES, logger=log)
        self._reader, self._writer, self._loop = reader, writer, asyncio.get_running_loop()
        self._outbox: deque[str | bytes] = deque()
        self._unsent, self._pings, self._gone = 0, 0, False
        self._room = threading.Condition()
        self._wake, self._writing, self._left = asyncio.Event(), asyncio.Lock(), asyncio.Event()
        self._reads = False
        self.heard = self._loop.time()

    @property
    def open(self) -> bool:
        """Whether messages go both ways."""
        from websockets.protocol import State

        return self._protocol.state is State.OPEN

    async def accept(self, raw: bytes) -> bool:
        """Answer the opening request; return whether it was one."""
        self._protocol.receive_data(raw)
        for request in self._protocol.events_received():
            self._protocol.send_response(self._protocol.accept(request))  # type: ignore[arg-type]
        await self._flush()
        return self.open

    def send(self, message: str | bytes) -> None:
        """Queue a message; it is dropped where the page is gone. From any thread."""
        with self._room:
            if self._gone:
                return
            self._outbox.append(message)
            self._unsent += len(message)
            too_much = self._unsent > _MOST_UNSENT
        with suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(self._cut if too_much else self._wake.set)

    def wait_for_room(self, wanted: Callable[[], bool]) -> None:
        """Wait until the page has taken most of what was sent, as long as more is wanted."""
        with self._room:
            while self._unsent > _ROOM and not self._gone and wanted():
                self._room.wait(0.1)

    def leave(self) -> None:
        """Send nothing more, and let go of those who wait."""
        with self._room:
            self._gone, self._unsent = True, 0
            self._outbox.clear()
            self._room.notify_all()

    def _cut(self) -> None:
        self.leave()
        self._writer.transport.abort()

    async def write(self) -> None:
        """Send what is queued, as fast as the page takes it; one that takes nothing is cut off."""
        try:
            while True:
                await self._wake.wait()
                self._wake.clear()
                message: str | bytes | None = ""
                while message is not None:
                    async with self._writing:
                        message = self._outbox.popleft() if self._outbox and self.open else None
                        if isinstance(message, str):
                            self._protocol.send_text(message.encode())
                        elif message is not None:
                            self._protocol.send_binary(message)
                        self._pings = 0
                        await self._flush()
                    with self._room:
                        self._unsent = max(0, self._unsent - len(message or ""))
                        self._room.notify_all()
        except OSError:
            self._cut()

    async def messages(self) -> AsyncIterator[str | bytes]:
        """Yield what the page sends, until it leaves."""
        from websockets.frames import Opcode

        kind, whole, asked = Opcode.BINARY, bytearray(), False
        self._reads = True
        while True:
            try:
                # What comes after a closing is read too, because unread bytes would take the closing with them.
                async with asyncio.timeout(_LISTENING if self.open else 2 * ENDING):
                    data = await self._reader.read(MOST_BYTES)
            except TimeoutError:
                if asked or not self.open:
                    break
                asked = True
                self._protocol.send_ping(b"")
                self._wake.set()
                continue
            if not data:
                break
            asked = False
            self._protocol.receive_data(data)
            self._wake.set()  # answers to pings, and to messages that are none
            for frame in self._protocol.events_received():
                opcode = frame.opcode  # type: ignore[union-attr]
                if opcode == Opcode.PING:
                    self._pings += 1
                    if self._pings > 100:  # a client that reads the answers sends fewer
                        self._cut()
                if opcode not in (Opcode.TEXT, Opcode.BINARY, Opcode.CONT):
                    continue
                kind, whole = (kind, whole) if opcode == Opcode.CONT else (opcode, bytearray())
                whole += frame.data  # type: ignore[union-attr]
                if frame.fin:  # type: ignore[union-attr]
                    self.heard = self._loop.time()
                    yield bytes(whole) if kind == Opcode.BINARY else whole.decode(errors="replace")
        self._reads = False
        self._left.set()
        await self.end(1000)

    async def end(self, code: int, reason: str = "") -> None:
        """Close the websocket; a page that does not read is cut off."""
        self.leave()
        with suppress(OSError):
            async with asyncio.timeout(2 * ENDING):
                async with self._writing:
                    if self.open:
                        self._protocol.send_close(code, reason)
                    await self._flush()
                if self._reads:
                    await self._left.wait()
                while await self._reader.read(MOST_BYTES):
                    pass
        self._writer.transport.abort()

    async def _flush(self) -> None:
        for data in self._protocol.data_to_send():
            if data:
                await write_all(self._writer, data)
            elif self._writer.can_write_eof():
                self._writer.write_eof()


def _take(conversation: Conversation, message: str | bytes, tell: Callable[[Mapping[str, Any]], None]) -> None:
    """Handle one message of the page: sound, or an object with `kind`; tell what is wrong with any other."""
    try:
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
    except InputError as error:
        tell({"kind": "note", "text": str(error)})
