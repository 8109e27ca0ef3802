"""Who may ask a server: names, pages and a token, for servers of this machine and for those exposed on purpose."""

from __future__ import annotations

import hmac
import ipaddress
import re
import secrets
import socket
from dataclasses import dataclass, field
from hashlib import sha256
from urllib.parse import parse_qs, urlsplit

from smplxpp.core.errors import InputError

HOST = "127.0.0.1"
_LOOPBACK = ("localhost", HOST, "::1")
_SHORTEST_TOKEN = 16
"""Characters: fewer can be guessed."""


@dataclass(frozen=True, kw_only=True)
class Access:
    """Who may ask a server: names under which it is asked (`Host`), pages that open sockets (`Origin`), a token.

    A server of this machine answers to its loopback names at any port, so that a forwarded port works; other names
    reach it by a trick (DNS rebinding). One that listens for other machines answers to IP addresses and its own name
    too, because no page of another site has these for its own, and to the name in `public_url`.

    Attributes:
        host: address to listen at.
        public_url: address under which a proxy offers it, `https://NAME/` with or without a path; "" for none.
        token: what a browser has to bring, at first as `?token=`, then in a cookie; "" lets everybody in.

    Raises:
        InputError: no address, another form of URL, a token that can be guessed.

    Example:
        >>> access = Access(public_url="https://example.org/me/")
        >>> access.knows("example.org"), access.knows("evil.example"), access.own_page("example.org", "https://example.org")
        (True, False, True)
    """

    host: str = HOST
    public_url: str = ""
    token: str = field(default="", repr=False)

    def __post_init__(self) -> None:
        if self.host != "localhost" and _ip(self.host) is None:
            raise InputError(
                "option host",
                expected="an IP address of this machine: 127.0.0.1, or 0.0.0.0 for all its networks",
                received=repr(self.host[:80]),
            )
        if self.public_url and (
            not re.fullmatch(r"https?://[A-Za-z0-9.\-]+(:[0-9]{1,5})?(/[A-Za-z0-9._~\-/]*)?", self.public_url)
        ):
            raise InputError(
                "option public-url", expected="https://NAME/, or with a path", received=repr(self.public_url[:200])
            )
        if self.token and not re.fullmatch(rf"[A-Za-z0-9_.~\-]{{{_SHORTEST_TOKEN},200}}", self.token):
            raise InputError(
                "token", expected=f"{_SHORTEST_TOKEN} to 200 letters, digits, - and _", received="another text"
            )

    @property
    def exposed(self) -> bool:
        """Whether other machines reach the server."""
        return self.host not in _LOOPBACK or bool(self.public_url)

    @property
    def path(self) -> str:
        """Path of the public address, with "/" at both ends."""
        return "/" + f"{urlsplit(self.public_url).path.strip('/')}/".lstrip("/")

    def knows(self, host: str) -> bool:
        """Return whether a request under this `Host` is meant for the server."""
        found = re.fullmatch(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9.\-]+)(?::[0-9]{1,5})?", host)
        if found is None:
            return False
        name = found[1].strip("[]").lower()
        if name in _LOOPBACK or (self.public_url and name == urlsplit(self.public_url).hostname):
            return True
        return self.host not in _LOOPBACK and (_ip(name) is not None or name == socket.gethostname().lower())

    def own_page(self, host: str, origin: str) -> bool:
        """Return whether a request under this `Host` comes from a page of the server, by its `Origin`."""
        public = urlsplit(self.public_url)
        return self.knows(host) and (
            origin == f"http://{host}" or (bool(self.public_url) and origin == f"{public.scheme}://{public.netloc}")
        )

    def sockets(self, host: str) -> list[str]:
        """Return the addresses of websockets that a page under this `Host` may open, for its content policy."""
        public = urlsplit(self.public_url)
        named = [f"ws{public.scheme.removeprefix('http')}://{public.netloc}"] if self.public_url else []
        return [f"ws://{host}", *named]

    def address(self, port: int) -> str:
        """Return the address for a browser, with the token."""
        name = "localhost" if self.host in ("0.0.0.0", "::") else self.host
        name = f"[{name}]" if ":" in name else name
        base = f"{self.public_url.rstrip('/')}/" if self.public_url else f"http://{name}:{port}/"
        return base + (f"?token={self.token}" if self.token else "")

    @property
    def cookie(self) -> str:
        """Name of the token's cookie; cookies of one host are shared by all ports, so that it differs by token."""
        return f"smplxpp-{sha256(self.token.encode()).hexdigest()[:12]}"

    def brings_token(self, cookies: str) -> bool:
        """Return whether a `Cookie` header has the token, or none is asked for."""
        pairs = (one.strip().partition("=") for one in cookies.split(";"))
        given = next((value for name, _, value in pairs if name == self.cookie), "")
        return not self.token or hmac.compare_digest(given.encode(), self.token.encode())

    def takes_token(self, query: str) -> bool:
        """Return whether a query has the token."""
        given = parse_qs(query).get("token", [""])[0]
        return bool(self.token) and hmac.compare_digest(given.encode(), self.token.encode())

    @property
    def set_cookie(self) -> str:
        """The header that gives a browser the token."""
        secure = "; Secure" if self.public_url.startswith("https:") else ""
        return f"{self.cookie}={self.token}; HttpOnly; SameSite=Lax; Path={self.path}{secure}"


def _ip(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


def new_token() -> str:
    """Return a random token of 192 bits."""
    return secrets.token_urlsafe(24)
