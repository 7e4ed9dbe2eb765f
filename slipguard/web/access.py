"""Access control over TCP: which clients may send commands, and which web pages may send requests.

Every user of this machine, and every page open in the operator's browser, can reach a loopback port. A command
therefore needs the token, or the cookie that a login link has set. Every request must be meant for this server: its
`Host` must be ours (another name that resolves here is refused), and its `Origin`, if present, must be our own page.

A browser sends a cookie to every port of a host, also to a server of another user. The page therefore sends a second
secret, the session key. It gets the key in the address fragment at login and keeps it where only its own origin can
read.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import re
import secrets
import socket
import time
from collections.abc import Callable

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from slipguard.web.middleware import refuse

COOKIE = "slipguard"
SESSION_HEADER = "x-slipguard-session"
"""Header in which the page sends the session key."""
LINK_VALID_S = 60.0
LINKS_MAX = 16
_TOKEN = re.compile(rb"(?i)\nauthorization:[ \t]*bearer[ \t]+(\S+)")
_COOKIE = re.compile(rb"\b" + COOKIE.encode() + rb"=([0-9a-f]+)")
CONTROL_KEY = "slipguard.control"
"""Key of the ASGI scope: whether this client may send commands."""


class Access:
    """token: the daemon's secret for this run. address: (host, port) of the server. clock: for the links' expiry."""

    def __init__(self, token: str, address: tuple[str, int], clock: Callable[[], float] = time.monotonic) -> None:
        self._token = token
        self._cookie = hmac.new(token.encode(), b"page", hashlib.sha256).hexdigest()
        self.session_key = hmac.new(token.encode(), b"session", hashlib.sha256).hexdigest()
        self._host, self._port = address
        self._clock = clock
        self._links: dict[str, float] = {}

    def make_link(self) -> str:
        """Return an address that gives the first browser that opens it control, within `LINK_VALID_S`."""
        code = secrets.token_urlsafe(32)
        self._links[code] = self._clock() + LINK_VALID_S
        while len(self._links) > LINKS_MAX:
            del self._links[next(iter(self._links))]
        return f"http://{self._shown_host()}:{self._port}/login?token={code}"

    def redeem(self, code: str) -> str | None:
        """Return the cookie's value for a link's code, and invalidate the code; None if the code is not valid."""
        expires_s = self._links.pop(code, None)
        return self._cookie if expires_s is not None and self._clock() < expires_s else None

    def is_known(self, headers: Headers) -> bool:
        """Return whether the request is for this server and has the token or the cookie."""
        return self._names_this_server(headers) and (self._has_token(headers) or self._has_cookie(headers))

    def may_be_known(self, head: bytes) -> bool:
        """Return whether a request line with its headers has the token or the cookie, wherever in it.

        Decides only which requests are handled first; fast, because any client may send any headers.
        """
        return any(
            hmac.compare_digest(found, secret.encode())
            for secret, pattern in ((self._token, _TOKEN), (self._cookie, _COOKIE))
            for found in pattern.findall(head)
        )

    def may_command(self, headers: Headers) -> bool:
        """Return whether the request has the token, or the cookie and the session key."""
        session = _equal(headers.get(SESSION_HEADER, ""), self.session_key)
        return self._has_token(headers) or (session and self._has_cookie(headers))

    def find_objection(self, scope: Scope, headers: Headers) -> str | None:
        """Return why a request is not meant for this server, or comes from another page; None if it is valid."""
        hosts = headers.getlist("host")
        if not self._names_this_server(headers):
            return f"Host {hosts[0] if hosts else ''!r} is not this server; use {self._shown_host()}:{self._port}"
        origins = headers.getlist("origin")
        if origins and origins != [f"http://{hosts[0]}"]:
            return f"Origin {origins[0]!r} is not the page of this server; only that page may send requests"
        site = headers.get("sec-fetch-site", "none")
        link_followed = scope.get("method") == "GET" and headers.get("sec-fetch-mode") == "navigate"
        if site not in ("none", "same-origin") and not (link_followed and headers.get("sec-fetch-dest") == "document"):
            return "the request comes from another web page; only the page of this server may send requests"
        return None

    def _shown_host(self) -> str:
        address = _ip_address(self._host)
        if address is not None and address.is_unspecified:
            return socket.gethostname()
        return f"[{self._host}]" if ":" in self._host else self._host

    def _has_token(self, headers: Headers) -> bool:
        kind, _, given = headers.get("authorization", "").partition(" ")
        return kind.lower() == "bearer" and _equal(given.strip(), self._token)

    def _has_cookie(self, headers: Headers) -> bool:
        # Not `http.cookies`: up to Python 3.12.5 it needs seconds for some cookies (CVE-2024-7592).
        pairs = (one.strip().partition("=") for one in headers.get("cookie", "").split(";"))
        return any(name == COOKIE and _equal(value, self._cookie) for name, _, value in pairs)

    def _names_this_server(self, headers: Headers) -> bool:
        hosts = headers.getlist("host")
        return len(hosts) == 1 and self._is_own_host(hosts[0].lower())

    def _is_own_host(self, host: str) -> bool:
        name, _, port = host.rpartition(":")
        if port != str(self._port):
            return False
        name = name.removeprefix("[").removesuffix("]")
        address = _ip_address(self._host)
        if address is not None and address.is_unspecified:
            # An address in numbers is safe: no other name can resolve to it.
            return name in ("localhost", socket.gethostname().lower()) or _ip_address(name) is not None
        if self._host == "localhost" or (address is not None and address.is_loopback):
            return name == "localhost" or name == self._host
        return name == self._host.lower()


class AccessMiddleware:
    """ASGI: refuses requests that are not meant for this server, and commands without the token."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        objection = self._access.find_objection(scope, headers)
        if objection is not None:
            await refuse(403, objection, scope, receive, send)
            return
        may_command = self._access.may_command(headers)
        if scope["type"] == "http" and scope["method"] not in ("GET", "HEAD") and not may_command:
            reason = "this request needs the token; `slipguard ctl page` prints a link that gives control"
            await refuse(401, reason, scope, receive, send)
        else:
            await self._app({**scope, CONTROL_KEY: may_command}, receive, send)


def _equal(given: str, secret: str) -> bool:
    return hmac.compare_digest(given.encode(), secret.encode())


def _ip_address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None
