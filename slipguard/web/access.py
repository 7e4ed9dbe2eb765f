"""Who may command over TCP, and which web pages may ask at all.

Every user of this machine, and every page open in the operator's browser, can reach a loopback port. So a command
needs the token (or the cookie that a link made with it has set), and each request must be meant for this server: its
`Host` is one of ours (a foreign name that points here is refused) and its `Origin`, where a browser tells one, is that
of our own page.

A browser sends a cookie to every port of a host, so to whatever another user has put on one. The page therefore has a
second secret, which the login hands it in the address's fragment and which it keeps where only its own origin can read.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import secrets
import socket
import time
from collections.abc import Callable
from http.cookies import CookieError, SimpleCookie
from typing import Any

from starlette.datastructures import Headers
from starlette.types import ASGIApp, Receive, Scope, Send

from slipguard.web.middleware import refuse

COOKIE = "slipguard"
SESSION = "x-slipguard-session"
"""The header in which the page sends the second secret."""
CODE_S = 60.0
"""How long a link to the page is good."""
CODES_MAX = 16
CONTROL_KEY = "slipguard.control"
"""Where the scope says whether this client may command."""


class Access:
    """token: the daemon's secret for this run. address: (host, port) it listens at.

    clock: seconds, for the links' ends.
    """

    def __init__(self, token: str, address: tuple[str, int], clock: Callable[[], float] = time.monotonic) -> None:
        self._token = token
        self._cookie = hmac.new(token.encode(), b"page", hashlib.sha256).hexdigest()
        self.session = hmac.new(token.encode(), b"session", hashlib.sha256).hexdigest()
        """The page's second secret; the cookie alone commands nothing."""
        self._host, self._port = address
        self._clock = clock
        self._codes: dict[str, float] = {}

    # --- the page's way in ---

    def link(self) -> str:
        """An address that gives the browser that opens it first control; good once, for `CODE_S`."""
        code = secrets.token_urlsafe(32)
        self._codes[code] = self._clock() + CODE_S
        while len(self._codes) > CODES_MAX:
            del self._codes[next(iter(self._codes))]
        return f"http://{self._shown_host()}:{self._port}/login?token={code}"

    def redeem(self, code: str) -> str | None:
        """The cookie's value for a link's code, which is used up by it; None for any other."""
        ends_s = self._codes.pop(code, None)
        return self._cookie if ends_s is not None and self._clock() < ends_s else None

    def _shown_host(self) -> str:
        if _is_any(self._host):
            return socket.gethostname()
        return f"[{self._host}]" if ":" in self._host else self._host

    # --- each request ---

    def knows(self, headers: Headers) -> bool:
        """Whether the token or the cookie came with it: enough to be no stranger."""
        return self._has_token(headers) or self._has_cookie(headers)

    def may_command(self, headers: Headers) -> bool:
        """Whether the token came with it, or the cookie and the page's second secret."""
        session = _same(headers.get(SESSION, ""), self.session)
        return self._has_token(headers) or (session and self._has_cookie(headers))

    def _has_token(self, headers: Headers) -> bool:
        kind, _, given = headers.get("authorization", "").partition(" ")
        return kind.lower() == "bearer" and _same(given.strip(), self._token)

    def _has_cookie(self, headers: Headers) -> bool:
        try:
            cookies = SimpleCookie(headers.get("cookie", ""))
        except CookieError:
            return False
        return COOKIE in cookies and _same(cookies[COOKIE].value, self._cookie)

    def objection(self, scope: Scope, headers: Headers) -> str | None:
        """Why a request is not meant for this server, or comes from a foreign page; None if all is well."""
        hosts = headers.getlist("host")
        if len(hosts) != 1 or not self._is_ours(hosts[0].lower()):
            return f"Host {hosts[0] if hosts else ''!r} is not this server; ask for {self._shown_host()}:{self._port}"
        origins = headers.getlist("origin")
        if origins and origins != [f"http://{hosts[0]}"]:
            return f"Origin {origins[0]!r} is a foreign page; only the page of this server may ask"
        site = headers.get("sec-fetch-site", "none")
        followed = scope.get("method") == "GET" and headers.get("sec-fetch-mode") == "navigate"
        if site not in ("none", "same-origin") and not (followed and headers.get("sec-fetch-dest") == "document"):
            return "the request comes from a foreign page; only the page of this server may ask"
        return None

    def _is_ours(self, host: str) -> bool:
        name, _, port = host.rpartition(":")
        if port != str(self._port):
            return False
        name = name.removeprefix("[").removesuffix("]")
        if _is_any(self._host):  # by number, no foreign name can point here
            return name in ("localhost", socket.gethostname().lower()) or _number(name) is not None
        if _is_loopback(self._host):
            return name == "localhost" or name == self._host
        return name == self._host.lower()


class AccessMiddleware:
    """ASGI: lets through what `access` has no objection to, and commands only with the token."""

    def __init__(self, app: ASGIApp, access: Access) -> None:
        self._app, self._access = app, access

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        refusal: tuple[int, str] | None = None
        objection = self._access.objection(scope, headers)
        may = self._access.may_command(headers)
        if objection is not None:
            refusal = 403, objection
        elif scope["type"] == "http" and scope["method"] not in ("GET", "HEAD") and not may:
            refusal = 401, "this needs the token; `slipguard ctl page` makes a link that gives control"
        if refusal is None:
            await self._app({**scope, CONTROL_KEY: may}, receive, send)
            return
        await refuse(*refusal, scope, receive, send)


def _same(given: str, secret: str) -> bool:
    return hmac.compare_digest(given.encode(), secret.encode())


def _number(host: str) -> Any:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _is_any(host: str) -> bool:
    number = _number(host)
    return number is not None and number.is_unspecified


def _is_loopback(host: str) -> bool:
    number = _number(host)
    return host == "localhost" or (number is not None and number.is_loopback)
