"""A server of a few files held in memory, for browsers on this machine alone."""

from __future__ import annotations

import errno
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import PurePosixPath
from urllib.parse import unquote, urlsplit

from smplxpp.core.errors import InputError

HOST = "127.0.0.1"
_TRIES = 32
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
        self.files = {f"/{name}": content for name, content in files.items()}
        if "index.html" in files:
            self.files["/"] = files["index.html"]
        for one in range(port, port + _TRIES if port else 1):
            try:
                super().__init__((HOST, one), _Handler)
                return
            except OSError as error:
                if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                    raise
        raise InputError("option port", expected="a port that is free", received=f"{port} and those after it taken")

    @property
    def address(self) -> str:
        """What to give a browser."""
        return f"http://{HOST}:{self.server_address[1]}/"

    @property
    def hosts(self) -> set[str]:
        """Names under which pages of this machine ask; others reach it by a trick (DNS rebinding)."""
        port = self.server_address[1]
        return {f"{name}:{port}" for name in (HOST, "localhost")}


class _Handler(BaseHTTPRequestHandler):
    server: PageServer
    server_version = "smplxpp"
    sys_version = ""

    def do_GET(self) -> None:
        self._answer(body=True)

    def do_HEAD(self) -> None:
        self._answer(body=False)

    def _answer(self, *, body: bool) -> None:
        path = unquote(urlsplit(self.path).path)
        content = self.server.files.get(path)
        if self.headers.get("Host", "") not in self.server.hosts:
            status, content = HTTPStatus.FORBIDDEN, b"this server answers this machine alone\n"
        elif content is None:
            status, content = HTTPStatus.NOT_FOUND, b"no such file here\n"
        else:
            status = HTTPStatus.OK
        suffix = ".html" if path == "/" else PurePosixPath(path).suffix
        plain = "text/plain; charset=utf-8"
        self.send_response(status)
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        kind = _TYPES.get(suffix, "application/octet-stream") if status == HTTPStatus.OK else plain
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        if body:
            self.wfile.write(content)

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing: the terminal is the command's."""
