"""A server of a few files held in memory, for browsers on this machine alone."""

from __future__ import annotations

import errno
import sys
from collections.abc import Callable, Collection, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import PurePosixPath
from typing import Any, TypeVar
from urllib.parse import unquote, urlsplit

from smplxpp.core.errors import InputError

T = TypeVar("T")
HOST = "127.0.0.1"
_TYPES = {".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".wav": "audio/wav"}
_HEADERS = {
    # A page isolated from others may use threads and exact clocks.
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Embedder-Policy": "require-corp",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


def own_hosts(port: int) -> set[str]:
    """Names under which pages of this machine ask; others reach it by a trick (DNS rebinding)."""
    return {f"{name}:{port}" for name in (HOST, "localhost")}


def at_free_port(make: Callable[[int], T], port: int) -> T:
    """Return what is made at a port, or at the next free one; 0: any.

    Raises:
        InputError: no port is free.
    """
    tries = 32
    for one in range(port, port + tries if port else 1):
        try:
            return make(one)
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
    raise InputError("option port", expected="a port that is free", received=f"{port} and those after it taken")


def answer(
    files: Mapping[str, bytes], hosts: Collection[str], address: str, host: str
) -> tuple[HTTPStatus, dict[str, str], bytes]:
    """Return the status, headers and body for what a browser asks.

    Args:
        files: contents by plain name; "index.html" is "/" too. hosts: names that may be asked for.
        address: path and query of the request. host: its header.
    """
    try:
        name = unquote(urlsplit(address).path).removeprefix("/") or "index.html"
    except ValueError:  # such as an unclosed bracket, which is no address
        name = address
    content = files.get(name)
    if host not in hosts:
        status, content = HTTPStatus.FORBIDDEN, b"this server answers this machine alone\n"
    elif content is None:
        status, content = HTTPStatus.NOT_FOUND, b"no such file here\n"
    else:
        status = HTTPStatus.OK
    kind = _TYPES.get(PurePosixPath(name).suffix, "application/octet-stream")
    kind = kind if status == HTTPStatus.OK else "text/plain; charset=utf-8"
    return status, {**_HEADERS, "Content-Type": kind, "Content-Length": str(len(content))}, content


class PageServer(ThreadingHTTPServer):
    """Serves files by name, and "index.html" as "/"; nothing of the disk can be asked for.

    Args:
        files: contents by plain name.
        port: to listen at, or the next free one; 0: any.

    Raises:
        InputError: no port is free.
    """

    daemon_threads = True
    allow_reuse_address = False

    def __init__(self, files: Mapping[str, bytes], *, port: int = 0) -> None:
        self.files = files
        at_free_port(lambda at: super(PageServer, self).__init__((HOST, at), _Handler), port)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of browsers that leave early or never finish a request; report other errors."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)

    @property
    def address(self) -> str:
        """Return the address for a browser."""
        return f"http://{HOST}:{self.server_address[1]}/"

    @property
    def hosts(self) -> set[str]:
        """Names of this server that pages of this machine ask for."""
        return own_hosts(self.server_address[1])


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    server_version = "smplxpp"
    sys_version = ""
    timeout = 30.0
    """Seconds that a request may take to arrive, so that half a one does not hold its thread for ever."""

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def _answer(self, *, body: bool) -> None:
        host = self.headers.get("Host", "")
        status, headers, content = answer(self.server.files, self.server.hosts, self.path, host)
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        if body:
            self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing: the terminal is the command's."""
