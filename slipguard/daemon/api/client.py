"""Synchronous client of a running daemon, over its Unix socket or TCP, for the command line and for scripts."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import httpx
from websockets.exceptions import InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect, unix_connect

from slipguard.daemon.api.paths import running_socket
from slipguard.daemon.api.requests import DaemonRequest
from slipguard.daemon.api.state import NewEstimates
from slipguard.errors import CommandRefused, InputError, SlipguardError

TIMEOUT_S = 5.0
NO_DAEMON = "no daemon is listening at {}: start it with `slipguard run`"


@dataclass(frozen=True, slots=True)
class SensorFrame:
    """A frame of one finger. captured_at_s: on this machine's monotonic clock."""

    png: bytes
    serial: str
    sequence: int
    captured_at_s: float


class DaemonNotRunning(SlipguardError):
    """No daemon is listening at the address."""


@dataclass(frozen=True, slots=True)
class TcpAddress:
    """A daemon's address, such as http://127.0.0.1:8470. token: needed for commands; None: read only."""

    url: str
    token: str | None = None

    def __post_init__(self) -> None:
        try:
            valid = httpx.URL(self.url).scheme == "http" and bool(httpx.URL(self.url).host)
        except httpx.InvalidURL:
            valid = False
        if not valid:
            raise InputError(f"{self.url!r} is not a daemon address; use the form http://127.0.0.1:8470")


class EstimateStream:
    """Yields `NewEstimates` until the daemon ends or `close` is called, which any thread may do.

    A program that reads too slowly misses the oldest estimates: then `number` has a gap.
    """

    def __init__(self, connection: ClientConnection, address: str) -> None:
        self._connection, self._address, self._closed = connection, address, False

    def __iter__(self) -> Iterator[NewEstimates]:
        """Yield each message. Raises SlipguardError when the daemon ends the stream."""
        while True:
            try:
                message = self._connection.recv()
            except WebSocketException as error:
                if self._closed:
                    return
                raise SlipguardError(f"the daemon at {self._address} ended the stream: {error}") from None
            yield NewEstimates.model_validate_json(message)

    def __enter__(self) -> EstimateStream:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the stream."""
        self._closed = True
        self._connection.close()


class Client:
    """A connection to one daemon.

    Raises:
        DaemonNotRunning: No daemon is listening.
        CommandRefused: The daemon refused a request; the text is its reason.
        SlipguardError: Any other failure.
    """

    def __init__(self, address: Path | TcpAddress | None = None, timeout_s: float = TIMEOUT_S) -> None:
        """address: a Unix socket or a TCP address; None: the socket of the daemon that runs on this machine."""
        address = running_socket() if address is None else address
        self._timeout_s = timeout_s
        self._unix: Path | None = None
        self._authorization: dict[str, str] = {}
        if isinstance(address, TcpAddress):
            self._shown = address.url
            if address.token is not None:
                self._authorization = {"authorization": f"Bearer {address.token}"}
            self._http = httpx.Client(
                base_url=address.url, headers=self._authorization, timeout=timeout_s, trust_env=False
            )
        else:
            self._shown, self._unix = str(address), address
            transport = httpx.HTTPTransport(uds=str(address))
            self._http = httpx.Client(
                transport=transport, base_url="http://slipguard", timeout=timeout_s, trust_env=False
            )

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def state(self) -> dict[str, Any]:
        """Return the daemon's complete state."""
        return self._json("GET", "/state")

    def healthz(self) -> dict[str, Any]:
        """Return {"status": "ok"}. Raises SlipguardError with the reason if the daemon is not healthy."""
        return self._json("GET", "/healthz")

    def submit(self, request: DaemonRequest) -> dict[str, Any]:
        """Submit a request, such as `LiftRequest(height_mm=120)`; return the response, which has a `message`."""
        fields = request.model_dump(mode="json", exclude_none=True)
        return self._json("POST", f"/{request.kind}", fields, max(self._timeout_s, request.response_timeout_s))

    def page_link(self) -> dict[str, Any]:
        """Return `url`: the link gives control over the operator page to the first browser that opens it."""
        return self._json("POST", "/page-link", {})

    def frame(self, finger: str) -> SensorFrame:
        """Return the newest frame of `left` or `right`."""
        return self._image(f"/frame/{finger}")

    def estimates(self) -> EstimateStream:
        """Open the stream of estimates: every new estimate as soon as the control loop has used it."""
        return EstimateStream(self._open_stream("/estimates"), self._shown)

    def backgrounds(self) -> dict[str, Any]:
        """Return the list of stored background images, by finger."""
        return self._json("GET", "/background")

    def background(self, finger: str, number: int | None = None) -> SensorFrame:
        """Return a stored background image of `left` or `right`, by default the newest; `sequence` is its number."""
        return self._image(f"/background/{finger}" + ("" if number is None else f"?number={number}"))

    def _open_stream(self, path: str) -> ClientConnection:
        self._check_listening()
        try:
            if self._unix is not None:
                return unix_connect(str(self._unix), f"ws://slipguard{path}", compression=None).__enter__()
            url = self._http.base_url.copy_with(scheme="ws", path=path)
            return connect(str(url), additional_headers=self._authorization, compression=None, proxy=None).__enter__()
        except InvalidStatus as refused:
            reason = refused.response.body.decode(errors="replace") or f"HTTP {refused.response.status_code}"
            raise SlipguardError(f"the daemon at {self._shown} refused {path}: {reason}") from None
        except TimeoutError:
            raise SlipguardError(f"the daemon at {self._shown} did not respond to {path} in time") from None
        except (OSError, WebSocketException) as error:
            raise DaemonNotRunning(f"{NO_DAEMON.format(self._shown)} ({error})") from None

    def _image(self, path: str) -> SensorFrame:
        response = self._response("GET", path)
        if response.is_error or response.headers.get("content-type") != "image/png":
            _parse_json(response, self._shown)
            raise SlipguardError(f"the daemon at {self._shown} sent no image for {path}; is it an older slipguard?")
        headers = response.headers
        return SensorFrame(
            response.content, headers["x-serial"], int(headers["x-sequence"]), float(headers["x-captured-at-s"])
        )

    def _json(
        self, method: str, path: str, body: dict[str, object] | None = None, timeout_s: float | None = None
    ) -> dict[str, Any]:
        return _parse_json(self._response(method, path, body, timeout_s), self._shown)

    def _response(
        self, method: str, path: str, body: dict[str, object] | None = None, timeout_s: float | None = None
    ) -> httpx.Response:
        self._check_listening()
        try:
            return self._http.request(method, path, json=body, timeout=timeout_s or self._timeout_s)
        except httpx.TimeoutException:
            raise SlipguardError(f"the daemon at {self._shown} did not respond to {path} in time") from None
        except httpx.ConnectError:
            raise DaemonNotRunning(NO_DAEMON.format(self._shown)) from None
        except httpx.TransportError as error:
            raise SlipguardError(f"the daemon at {self._shown} closed the connection: {error}") from None

    def _check_listening(self) -> None:
        """Raise DaemonNotRunning if no daemon listens; httpx would leave a socket open when it finds out."""
        if self._unix is None:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.settimeout(TIMEOUT_S)
            try:
                probe.connect(str(self._unix))
            except PermissionError:
                raise SlipguardError(
                    f"{self._shown} belongs to another user; run the command as that user or as root, with sudo"
                ) from None
            except OSError:
                raise DaemonNotRunning(NO_DAEMON.format(self._shown)) from None


def _parse_json(response: httpx.Response, address: str) -> dict[str, Any]:
    """Return the response's object; raise its `error` as an exception."""
    try:
        content = response.json()
    except ValueError:
        content = None
    if not isinstance(content, dict):
        raise SlipguardError(f"the server at {address} is not a slipguard daemon (HTTP {response.status_code})")
    if response.status_code == 409:
        raise CommandRefused(str(content.get("error")))
    if response.is_error:
        raise SlipguardError(str(content.get("error", f"HTTP {response.status_code}")))
    return content
