"""Talks to a running daemon, over its Unix socket or over TCP: synchronous, for the command line and for scripts."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import httpx

from slipguard.daemon.api.paths import running_socket
from slipguard.errors import CommandRefused, InputError, SlipguardError

TIMEOUT_S = 5.0
CALIBRATE_TIMEOUT_S = 30.0
NO_DAEMON = "no daemon is listening at {}: start it with `slipguard run`"


@dataclass(frozen=True, slots=True)
class SensorFrame:
    """A finger's picture as the daemon has it. captured_at_s: of this machine's monotonic clock."""

    png: bytes
    serial: str
    sequence: int
    captured_at_s: float


class DaemonNotRunning(SlipguardError):
    """Nothing listens there."""


@dataclass(frozen=True, slots=True)
class TcpAddress:
    """A daemon's address, such as http://127.0.0.1:8470, and the token that its commands need; None: look only."""

    url: str
    token: str | None = None

    def __post_init__(self) -> None:
        try:
            good = httpx.URL(self.url).scheme == "http" and bool(httpx.URL(self.url).host)
        except httpx.InvalidURL:
            good = False
        if not good:
            raise InputError(f"{self.url!r} is no address of a daemon; such as http://127.0.0.1:8470 is needed")


class Client:
    """One daemon. Every command returns the daemon's answer as a dict (`said`: one line).

    Raises NoDaemon, CommandRefused with the daemon's reason, or SlipguardError.
    """

    def __init__(self, at: Path | TcpAddress | None = None, timeout_s: float = TIMEOUT_S) -> None:
        """at: the Unix socket, or a TCP address; None: the socket of the daemon that runs on this machine."""
        at = running_socket() if at is None else at
        self._unix: Path | None = None
        if isinstance(at, TcpAddress):
            self._where = at.url
            headers = {} if at.token is None else {"authorization": f"Bearer {at.token}"}
            self._http = httpx.Client(base_url=at.url, headers=headers, timeout=timeout_s, trust_env=False)
        else:
            self._where, self._unix = str(at), at
            transport = httpx.HTTPTransport(uds=str(at))
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
        """Everything the daemon knows now."""
        return self._ask("GET", "/state")

    def healthz(self) -> dict[str, Any]:
        """{"status": "ok"}; raises SlipguardError with the reason where the daemon is not well."""
        return self._ask("GET", "/healthz")

    def frame(self, finger: str) -> SensorFrame:
        """The newest frame of `left` or `right`; the sensor stays the daemon's."""
        return self._picture(f"/frame/{finger}")

    def no_contacts(self) -> dict[str, Any]:
        """What no-contact images are stored, by finger."""
        return self._ask("GET", "/no-contact")

    def no_contact(self, finger: str, number: int | None = None) -> SensorFrame:
        """A stored no-contact image of `left` or `right`, the newest if not told which; `sequence` is its number."""
        return self._picture(f"/no-contact/{finger}" + ("" if number is None else f"?number={number}"))

    def _picture(self, path: str) -> SensorFrame:
        response = self._respond("GET", path)
        if response.is_error or response.headers.get("content-type") != "image/png":
            _answer(response, self._where)
            raise SlipguardError(f"what listens at {self._where} does not know {path}; is it an older slipguard?")
        told = response.headers
        return SensorFrame(response.content, told["x-serial"], int(told["x-sequence"]), float(told["x-captured-at-s"]))

    def grasp(self, force_n: float | None = None) -> dict[str, Any]:
        """Close on what is between the jaws."""
        return self._post("/grasp", force_n=force_n)

    def lift(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> dict[str, Any]:
        """Lift what is held; does not wait for the end."""
        return self._post("/lift", height_mm=height_mm, speed_mm_s=speed_mm_s)

    def lower(self, height_mm: float | None = None, speed_mm_s: float | None = None) -> dict[str, Any]:
        """Lower what is held; does not wait for the end."""
        return self._post("/lower", height_mm=height_mm, speed_mm_s=speed_mm_s)

    def guard(self, on: bool) -> dict[str, Any]:
        """Act on slip, or only watch."""
        return self._post("/guard", on=on)

    def gripper(self, width_mm: float | None = None, force_n: float | None = None) -> dict[str, Any]:
        """Move the jaws; never opens a held object."""
        return self._post("/gripper", width_mm=width_mm, force_n=force_n)

    def release(self, width_mm: float | None = None) -> dict[str, Any]:
        """Open the jaws: whatever is held drops."""
        return self._post("/release", confirm=True, width_mm=width_mm)

    def clear(self) -> dict[str, Any]:
        """Leave a fault whose cause is gone."""
        return self._post("/clear")

    def page_link(self) -> dict[str, Any]:
        """`url`: a link that gives the browser that opens it first control of the page."""
        return self._post("/page-link")

    def calibrate(self, *, force: bool = False, new_gel: bool = False) -> dict[str, Any]:
        """Take and store both fingers' no-contact images."""
        return self._ask("POST", "/calibrate", {"force": force, "new_gel": new_gel}, timeout_s=CALIBRATE_TIMEOUT_S)

    def go_back(self, finger: str, number: int) -> dict[str, Any]:
        """Put an older no-contact image to use again."""
        told: dict[str, object] = {"finger": finger, "number": number}
        return self._ask("POST", "/no-contact", told, timeout_s=CALIBRATE_TIMEOUT_S)

    def _knock(self) -> None:
        """Raise NoDaemon where nothing listens; httpx leaves a socket open when it finds that out itself."""
        if self._unix is None:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.settimeout(TIMEOUT_S)
            try:
                probe.connect(str(self._unix))
            except PermissionError:
                raise SlipguardError(
                    f"{self._where} belongs to another user; ask as that user or as root, with sudo"
                ) from None
            except OSError:
                raise DaemonNotRunning(NO_DAEMON.format(self._where)) from None

    def _post(self, path: str, **body: object) -> dict[str, Any]:
        return self._ask("POST", path, {key: value for key, value in body.items() if value is not None})

    def _ask(
        self, method: str, path: str, body: dict[str, object] | None = None, timeout_s: float | None = None
    ) -> dict[str, Any]:
        return _answer(self._respond(method, path, body, timeout_s), self._where)

    def _respond(
        self, method: str, path: str, body: dict[str, object] | None = None, timeout_s: float | None = None
    ) -> httpx.Response:
        self._knock()
        timeout: Any = httpx.USE_CLIENT_DEFAULT if timeout_s is None else timeout_s
        try:
            return self._http.request(method, path, json=body, timeout=timeout)
        except httpx.TimeoutException:
            raise SlipguardError(f"the daemon at {self._where} did not answer {path} in time") from None
        except httpx.ConnectError:
            raise DaemonNotRunning(NO_DAEMON.format(self._where)) from None
        except httpx.TransportError as error:
            raise SlipguardError(f"the daemon at {self._where} broke off: {error}") from None


def _answer(response: httpx.Response, where: str) -> dict[str, Any]:
    """The answer's object; its `error` as an exception."""
    try:
        answer = response.json()
    except ValueError:
        answer = None
    if not isinstance(answer, dict):
        raise SlipguardError(f"what listens at {where} is no slipguard daemon (HTTP {response.status_code})")
    if response.status_code == 409:
        raise CommandRefused(str(answer.get("error")))
    if response.is_error:
        raise SlipguardError(str(answer.get("error", f"HTTP {response.status_code}")))
    return answer
