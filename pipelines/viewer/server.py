"""The server of a window, and how its callbacks wait for each other."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import redirect_stdout
from functools import wraps
from io import StringIO
from typing import Any

from smplxpp.core.errors import InputError
from smplxpp.core.lazy import import_extra

log = logging.getLogger(__name__)


def start_server(label: str, *, host: str, port: int) -> Any:
    """Start viser's server; the next free port where this one is taken.

    Raises:
        MissingExtraError: viser is not installed.
    """
    viser = import_extra("viser", extra="viewer", purpose="the viewer")
    logging.getLogger("websockets").setLevel(logging.WARNING)  # it tells of every connection
    with redirect_stdout(StringIO()):  # and viser of its address, whatever it is asked for
        return viser.ViserServer(host=host, port=port, label=label, verbose=False)


def address_of(server: Any) -> str:
    """Return the address of a server for a browser."""
    host = server.get_host()
    return f"http://{'localhost' if host in ('0.0.0.0', '127.0.0.1') else host}:{server.get_port()}"


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
                self.say(f"**error:** {error}")
            except Exception:  # a callback's error would end in the server's log alone
                log.exception("the viewer could not do that")
                self.say("**error:** that went wrong; the terminal says how")

    return held
