"""Talks to a running daemon over its Unix socket: synchronous, for the command line and for scripts."""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import httpx

from slipguard.daemon.state_dir import SOCKET_NAME, StateDir
from slipguard.errors import CommandRefused, SlipguardError

TIMEOUT_S = 5.0
CALIBRATE_TIMEOUT_S = 30.0
SYSTEM_SOCKET = Path("/run/slipguard") / SOCKET_NAME


@dataclass(frozen=True, slots=True)
class SensorFrame:
    """A finger's picture as the daemon has it. captured_at_s: of this machine's monotonic clock."""

    png: bytes
    serial: str
    sequence: int
    captured_at_s: float


class NoDaemon(SlipguardError):
    """Nothing listens at the socket."""


def find_socket(environ: Mapping[str, str] = os.environ) -> Path:
    """The socket of the daemon on this machine: the user's own, else the system's, else where the own would be."""
    own = StateDir(environ=environ).runtime_path / SOCKET_NAME
    return SYSTEM_SOCKET if SYSTEM_SOCKET.exists() and not own.exists() else own


class Client:
    """One daemon. Every command returns the daemon's answer as a dict (`said`: one line).

    Raises NoDaemon, CommandRefused with the daemon's reason, or SlipguardError.
    """

    def __init__(self, socket_path: Path | None = None, timeout_s: float = TIMEOUT_S) -> None:
        self.socket_path = socket_path if socket_path is not None else find_socket()
        transport = httpx.HTTPTransport(uds=str(self.socket_path))
        self._http = httpx.Client(transport=transport, base_url="http://slipguard", timeout=timeout_s, trust_env=False)

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
        response = self._respond("GET", f"/frame/{finger}")
        if response.is_error or response.headers.get("content-type") != "image/png":
            _answer(response, self.socket_path)
            raise SlipguardError(f"what listens at {self.socket_path} does not know /frame; is it an older slipguard?")
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

    def calibrate(self, *, force: bool = False) -> dict[str, Any]:
        """Take and store both fingers' no-contact images."""
        return self._ask("POST", "/calibrate", {"force": force}, timeout_s=CALIBRATE_TIMEOUT_S)

    def _knock(self) -> None:
        """Raise NoDaemon where nothing listens; httpx leaves a socket open when it finds that out itself."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.settimeout(TIMEOUT_S)
            try:
                probe.connect(str(self.socket_path))
            except PermissionError:
                raise SlipguardError(
                    f"{self.socket_path} belongs to another user; join its group or become that user"
                ) from None
            except OSError:
                raise NoDaemon(f"no daemon is listening at {self.socket_path}: start it with `slipguard run`") from None

    def _post(self, path: str, **body: object) -> dict[str, Any]:
        return self._ask("POST", path, {key: value for key, value in body.items() if value is not None})

    def _ask(
        self, method: str, path: str, body: dict[str, object] | None = None, timeout_s: float | None = None
    ) -> dict[str, Any]:
        return _answer(self._respond(method, path, body, timeout_s), self.socket_path)

    def _respond(
        self, method: str, path: str, body: dict[str, object] | None = None, timeout_s: float | None = None
    ) -> httpx.Response:
        self._knock()
        timeout: Any = httpx.USE_CLIENT_DEFAULT if timeout_s is None else timeout_s
        try:
            return self._http.request(method, path, json=body, timeout=timeout)
        except httpx.TimeoutException:
            raise SlipguardError(f"the daemon at {self.socket_path} did not answer {path} in time") from None
        except httpx.TransportError as error:
            raise SlipguardError(f"the daemon at {self.socket_path} broke off: {error}") from None


def _answer(response: httpx.Response, socket_path: Path) -> dict[str, Any]:
    """The answer's object; its `error` as an exception."""
    try:
        answer = response.json()
    except ValueError:
        answer = None
    if not isinstance(answer, dict):
        raise SlipguardError(f"what listens at {socket_path} is no slipguard daemon (HTTP {response.status_code})")
    if response.status_code == 409:
        raise CommandRefused(str(answer.get("error")))
    if response.is_error:
        raise SlipguardError(str(answer.get("error", f"HTTP {response.status_code}")))
    return answer
