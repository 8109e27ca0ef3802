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

from pipelines.web.access import HOST, Access, new_token
from smplxpp.core.errors import InputError
from smplxpp.core.lazy import import_extra

log = logging.getLogger(__name__)
_STARTING = Lock()


def start_server(label: str, *, host: str, port: int) -> Any:
    """Start viser's server, which only browsers with the token of `address_of` may ask; the next free port if taken.

    Raises:
        MissingExtraError: viser is not installed.
        InputError: the host is no address.
    """
    access = Access(host=host, token=new_token())
    viser = import_extra("viser", extra="viewer", purpose="the viewer")
    logging.getLogger("websockets").setLevel(logging.WARNING)  # it tells of every connection
    # viser answers every page of every site; it takes its server from this module by name, when it starts.
    server_module = import_extra("websockets.asyncio.server", extra="viewer", purpose="the viewer")
    with _STARTING, redirect_stdout(StringIO()):  # viser tells its address, whatever it is asked for
        serve = server_module.serve
        server_module.serve = _for_own_pages(serve, access)  # type: ignore[attr-defined]
        try:
            server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
            server.access = access
            return server
        finally:
            server_module.serve = serve  # type: ignore[attr-defined]


def _for_own_pages(serve: Callable[..., Any], access: Access) -> Callable[..., Any]:
    """Return a `serve` of websockets that answers its own pages alone, because the window shows a person's data.

    A connection must come under a name of the server, from a page of the address that it asks (`Origin` against
    `Host`), and with the token, because other users of this machine reach its ports too.
    """

    def guarded(handler: Any, host: Any, port: Any, *, process_request: Any = None, **options: Any) -> Any:
        async def process(connection: Any, request: Any) -> Any:
            asked, origin = request.headers.get("Host", ""), request.headers.get("Origin")
            if not access.knows(asked) or (origin is not None and not access.own_page(asked, origin)):
                return connection.respond(HTTPStatus.FORBIDDEN, "this window is of its own page alone\n")
            if access.takes_token(urlsplit(request.path).query):
                moved = connection.respond(HTTPStatus.SEE_OTHER, "")
                moved.headers["Location"], moved.headers["Set-Cookie"] = "./", access.set_cookie
                return moved
            if not access.brings_token("; ".join(request.headers.get_all("Cookie"))):
                words = "open the address that the command has printed, with its token\n"
                return connection.respond(HTTPStatus.FORBIDDEN, words)
            answer = None if process_request is None else process_request(connection, request)
            return await answer if isawaitable(answer) else answer

        return serve(handler, host, port, process_request=process, **options)

    return guarded


def address_of(server: Any) -> str:
    """Return the address of a server for a browser, with its token."""
    address: str = server.access.address(server.get_port())
    return address.replace(f"//{HOST}:", "//localhost:")


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
