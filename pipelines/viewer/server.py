"""The server of a window, and how its callbacks wait for each other."""

from __future__ import annotations

import html
import logging
import re
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import wraps
from http import HTTPStatus
from inspect import isawaitable
from io import StringIO
from threading import Lock
from typing import Any
from urllib.parse import urlsplit

from smplxpp.core.errors import InputError
from smplxpp.core.lazy import import_extra

log = logging.getLogger(__name__)
_THIS_MACHINE = ("127.0.0.1", "localhost")
_STARTING = Lock()


def start_server(label: str, *, host: str, port: int) -> Any:
    """Start viser's server; the next free port where this one is taken.

    Raises:
        MissingExtraError: viser is not installed.
    """
    viser = import_extra("viser", extra="viewer", purpose="the viewer")
    logging.getLogger("websockets").setLevel(logging.WARNING)  # it tells of every connection
    # viser answers every page of every site; it takes its server from this module by name, when it starts.
    server_module = import_extra("websockets.asyncio.server", extra="viewer", purpose="the viewer")
    with _STARTING, redirect_stdout(StringIO()):  # viser tells its address, whatever it is asked for
        serve = server_module.serve
        server_module.serve = _for_own_pages(serve, host)  # type: ignore[attr-defined]
        try:
            return viser.ViserServer(host=host, port=port, label=label, verbose=False)
        finally:
            server_module.serve = serve  # type: ignore[attr-defined]


def _for_own_pages(serve: Callable[..., Any], bound: str) -> Callable[..., Any]:
    """Return a `serve` of websockets that answers its own pages alone, because the window shows a person's data.

    A connection must come from a page of the address that it asks (`Origin` against `Host`). A server of this machine
    must also be asked by one of its names, because others reach it by a trick (DNS rebinding).
    """

    def guarded(handler: Any, host: Any, port: Any, *, process_request: Any = None, **options: Any) -> Any:
        async def process(connection: Any, request: Any) -> Any:
            asked, origin = request.headers.get("Host", ""), request.headers.get("Origin")
            foreign = origin is not None and urlsplit(origin).netloc != asked
            name = asked.rpartition(":")[0] or asked
            if foreign or (bound in _THIS_MACHINE and name not in _THIS_MACHINE):
                return connection.respond(HTTPStatus.FORBIDDEN, "this window is of its own page alone\n")
            answer = None if process_request is None else process_request(connection, request)
            return await answer if isawaitable(answer) else answer

        return serve(handler, host, port, process_request=process, **options)

    return guarded


def address_of(server: Any) -> str:
    """Return the address of a server for a browser."""
    host = server.get_host()
    return f"http://{'localhost' if host in ('0.0.0.0', '127.0.0.1') else host}:{server.get_port()}"


def plain_markdown(text: str) -> str:
    r"""Return markdown that shows a text as it is: names of files and errors must not become markup, or a script.

    Example:
        >>> plain_markdown("<b> *run* _1_")
        '&lt;b&gt; \\*run\\* \\_1\\_'
    """
    return re.sub(r"([\\`*_{}\[\]()#+!|~])", r"\\\1", html.escape(text, quote=False))


def stop_server(server: Any) -> None:
    """Stop a server without its messages."""
    with redirect_stdout(StringIO()):
        server.stop()


def one_at_a_time(method: Callable[..., None]) -> Callable[..., None]:
    """Serialise the callbacks of a window, which come from several threads, and show their errors.

    The window has a `lock` and a method `say`.
    """

    @wraps(method)
    def held(self: Any, *args: Any, **options: Any) -> None:
        with self.lock:
            try:
                method(self, *args, **options)
            except (InputError, OSError) as error:
                self.say(f"**error:** {plain_markdown(str(error))}")
            except Exception:  # a callback's error would end in the server's log alone
                log.exception("the viewer could not do that")
                self.say("**error:** that went wrong; the terminal says how")

    return held
