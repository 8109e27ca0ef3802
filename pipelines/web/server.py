"""A server of a few files held in memory: for browsers on this machine alone, or exposed on purpose (`Access`)."""

from __future__ import annotations

import asyncio
import errno
import os
import re
import signal
import socket
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from http import HTTPStatus
from pathlib import PurePosixPath
from typing import Any, Self
from urllib.parse import quote, unquote, urlsplit

from pipelines.web.access import Access
from smplxpp.core.errors import InputError

_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".wav": "audio/wav",
    ".txt": "text/plain; charset=utf-8",
}
_HEADERS = {
    # A page isolated from others may use threads and exact clocks.
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Embedder-Policy": "require-corp",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
    "Connection": "close",
}
_PATIENCE = 10.0
"""Seconds that a request may take to arrive, and a block of an answer to be taken; half requests end after it."""
_MOST_HEADER = 1 << 14
"""Bytes of a request with its headers, as common servers bound them."""
_MOST_CONNECTIONS = 256
"""Connections at a time, a quarter of the files that a process may open; more are closed at once."""
_BLOCK = 1 << 16
"""Bytes of an answer that are handed to the system at once."""
ENDING = 0.4
"""Seconds that a shutdown waits for connections, twice at most, so that it ends within a second."""


@dataclass(frozen=True)
class Request:
    """What a browser asks: method, target, headers by lower-case name, and the bytes as they came."""

    method: str
    target: str
    headers: Mapping[str, str]
    raw: bytes

    @property
    def upgrades(self) -> bool:
        """Whether it opens a websocket."""
        return self.headers.get("upgrade", "").lower() == "websocket"


def read_request(raw: bytes) -> Request | None:
    """Return the request in the bytes up to its empty line; None where they are none."""
    first, *lines = raw.decode("latin-1").removesuffix("\r\n\r\n").split("\r\n")
    found = re.fullmatch(r"([A-Z]{1,16}) (\S+) HTTP/1\.[01]", first)
    pairs = [line.partition(":") for line in lines]
    headers = {name.lower(): value.strip() for name, _, value in pairs}
    # A name twice could mean one thing to a proxy and another here.
    if found is None or len(headers) < len(pairs) or not all(re.fullmatch(r"[!-9;-~]+", name) for name, _, _ in pairs):
        return None
    return Request(found[1], found[2], headers, raw)


def _listen_at_free_port(access: Access, port: int) -> socket.socket:
    """Listen at a port, or at the next free one where only people look for it; 0: any.

    Raises:
        InputError: no port is free; the host is no address of this machine.
    """
    tries = 1 if access.exposed else 32
    for one in range(port, port + tries if port else 1):
        try:
            return _listen(access.host, one)
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
    taken = f"{port} taken, which a proxy asks" if access.exposed else f"{port} and those after it taken"
    raise InputError("option port", expected="a port that is free", received=taken)


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.socket(family, socket.SOCK_STREAM)
    try:
        if os.name == "posix":  # a server that is started again has its port at once; elsewhere two would share it
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind((host, port))
        listening.listen(128)
    except BaseException as error:
        listening.close()
        if isinstance(error, OSError) and error.errno == errno.EADDRNOTAVAIL:
            raise InputError("option host", expected="an address of this machine", received=host) from None
        raise
    return listening


async def write_all(writer: asyncio.StreamWriter, data: bytes) -> None:
    """Write as fast as the other side takes it.

    Raises:
        TimeoutError: it takes nothing for `_PATIENCE`.
        OSError: it is gone.
    """
    writer.transport.set_write_buffer_limits(0)
    view = memoryview(data)
    for start in range(0, len(view), _BLOCK):
        writer.write(view[start : start + _BLOCK])
        async with asyncio.timeout(_PATIENCE):
            await writer.drain()


class PageServer:
    """Serves files by name, and "index.html" as "/"; nothing of the disk can be asked for.

    One thread serves all connections, so that those that send or read nothing hold none.

    Args:
        files: contents by plain name, or a function that makes them for the `Host` under which they are asked.
        access: who may ask.
        port: to listen at, or the next free one where other machines do not ask it; 0: any.

    Raises:
        InputError: no port is free, no such host.
    """

    def __init__(
        self, files: Mapping[str, bytes | Callable[[str], bytes]], *, access: Access | None = None, port: int = 0
    ) -> None:
        self.files, self.access = files, access or Access()
        self._socket = _listen_at_free_port(self.access, port)
        self.server_address: tuple[str, int] = self._socket.getsockname()[:2]
        self._tasks: set[asyncio.Task[Any]] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ending, self._ended = asyncio.Event(), threading.Event()
        self._lock, self._stopped = threading.Lock(), False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.shutdown()

    @property
    def address(self) -> str:
        """Return the address for a browser, with the token."""
        return self.access.address(self.server_address[1])

    def serve_forever(self) -> None:
        """Answer requests until `shutdown`; in the main thread until Ctrl-C or SIGTERM, too."""
        try:
            asyncio.run(self._serve())
        finally:
            self._ended.set()

    def shutdown(self) -> None:
        """End all connections and the server, within a second; it may be called again and from any thread."""
        with self._lock:
            self._stopped, loop = True, self._loop
        if loop is None:
            self._socket.close()
            return
        with suppress(RuntimeError):  # the loop has ended already
            loop.call_soon_threadsafe(self._ending.set)
        self._ended.wait(4 * ENDING)

    async def _serve(self) -> None:
        with self._lock:
            if self._stopped:
                return
            self._loop = asyncio.get_running_loop()
        # The first process of a container ignores what it does not ask for.
        if threading.current_thread() is threading.main_thread():
            with suppress(NotImplementedError):  # Windows
                self._loop.add_signal_handler(signal.SIGTERM, self._ending.set)
        server = await asyncio.start_server(self._connected, sock=self._socket, limit=_MOST_HEADER)
        try:
            await self._ending.wait()
        finally:
            server.close()
            await self._end()

    async def _end(self) -> None:
        """End what still runs."""
        for task in self._tasks:
            task.cancel()
        if self._tasks:
            await asyncio.wait(self._tasks, timeout=ENDING)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one request, or hold one websocket; browsers that leave early or say nothing are no error."""
        task = asyncio.current_task()
        assert task is not None
        if len(self._tasks) >= _MOST_CONNECTIONS:
            writer.transport.abort()
            return
        self._tasks.add(task)
        try:
            async with asyncio.timeout(_PATIENCE):
                raw = await reader.readuntil(b"\r\n\r\n")
            request = read_request(raw)
            if request is None:
                await self._respond(writer, HTTPStatus.BAD_REQUEST, b"this is no request\n")
            else:
                await self._answer(request, reader, writer)
        except asyncio.LimitOverrunError:
            with suppress(OSError):
                await self._respond(writer, HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, b"the request is too long\n")
        except (asyncio.IncompleteReadError, asyncio.CancelledError, TimeoutError, OSError):
            writer.transport.abort()
        finally:
            writer.close()
            self._tasks.discard(task)

    async def _answer(self, request: Request, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer a request: a file, where it comes under a name of the server and with the token."""
        host, access = request.headers.get("host", ""), self.access
        try:
            parts = urlsplit(request.target)
            path, query = unquote(parts.path), parts.query
        except ValueError:  # such as an unclosed bracket, which is no address
            path, query = request.target, ""
        # Proxies pass the path of the public address on, or leave it out.
        name = path.removeprefix(access.path if path.startswith(access.path) else "/")
        more: dict[str, str] = {}
        if not access.knows(host):
            status, body = HTTPStatus.FORBIDDEN, b"not a name of this server; --public-url NAME gives it another\n"
        elif request.method not in ("GET", "HEAD"):
            status, body = HTTPStatus.METHOD_NOT_ALLOWED, b"this server gives files alone\n"
            more["Allow"] = "GET, HEAD"
        elif access.takes_token(query):
            # The token goes from the address, which is shown and kept, into a cookie.
            status, body = HTTPStatus.SEE_OTHER, b""
            more |= {"Location": f"./{quote(name.rpartition('/')[2])}", "Set-Cookie": access.set_cookie}
        elif not access.brings_token(request.headers.get("cookie", "")):
            status, body = HTTPStatus.FORBIDDEN, b"open the address that the server has printed, with its token\n"
        elif request.upgrades:
            await self._upgrade(request, name, reader, writer)
            return
        else:
            content = self.files.get(name or "index.html")
            status = HTTPStatus.NOT_FOUND if content is None else HTTPStatus.OK
            body = b"no such file here\n" if content is None else content(host) if callable(content) else content
        kind = PurePosixPath(name or "index.html").suffix if status == HTTPStatus.OK else ".txt"
        more["Content-Type"] = _TYPES.get(kind, "application/octet-stream")
        await self._respond(writer, status, body, more=more, whole=request.method != "HEAD")

    async def _upgrade(
        self, request: Request, name: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Answer a request for a websocket."""
        await self._respond(writer, HTTPStatus.NOT_FOUND, b"no conversation here\n")

    async def _respond(
        self,
        writer: asyncio.StreamWriter,
        status: HTTPStatus,
        body: bytes,
        *,
        more: Mapping[str, str] | None = None,
        whole: bool = True,
    ) -> None:
        headers: Iterable[tuple[str, str]] = (
            {"Content-Type": _TYPES[".txt"], "Content-Length": str(len(body)), **_HEADERS, **(more or {})}
        ).items()
        head = f"HTTP/1.1 {status.value} {status.phrase}\r\n" + "".join(f"{name}: {text}\r\n" for name, text in headers)
        await write_all(writer, f"{head}\r\n".encode("latin-1", errors="replace"))
        if whole:
            await write_all(writer, body)
