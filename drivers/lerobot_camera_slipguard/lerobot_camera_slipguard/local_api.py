"""Client of slipguard's local API on its Unix socket, for the camera and the robot."""

from __future__ import annotations

import os
import struct
from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import httpx
import numpy as np
from numpy.typing import NDArray
from websockets.exceptions import WebSocketException
from websockets.sync.client import ClientConnection, unix_connect

SYSTEM_SOCKET = Path("/run/slipguard/slipguard.sock")
"""Of the daemon that systemd runs."""
TIMEOUT_S = 2.0
FRAME_HEADER = struct.Struct("<4sHHIdQ")
"""Magic, width, height, bytes of pixels, capture time on the monotonic clock, sequence number."""
FRAME_MAGIC = b"SGF1"


class DaemonUnreachable(ConnectionError):
    """No daemon responds at the socket; str() says what to do."""


class RequestRefused(RuntimeError):
    """The daemon refused a request; str() is the daemon's reason."""


@dataclass(frozen=True)
class GelImage:
    """One gel image. rgb: (320, 240, 3) uint8. captured_at_s: on this machine's monotonic clock."""

    rgb: NDArray[np.uint8]
    captured_at_s: float
    sequence: int


class LocalApi:
    """One daemon. socket: path of its Unix socket; empty for the daemon that runs on this machine."""

    def __init__(self, socket: str = "") -> None:
        self.socket = socket or default_socket()
        self._http = httpx.Client(
            transport=httpx.HTTPTransport(uds=self.socket),
            base_url="http://slipguard",
            trust_env=False,
        )

    def __enter__(self) -> LocalApi:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def state(self) -> dict[str, Any]:
        """Return the complete state; it is at most 0.1 s old. Raises DaemonUnreachable."""
        return dict(self._response("GET", "/state").json())

    def submit(self, kind: str, fields: dict[str, Any], timeout_s: float = TIMEOUT_S) -> str:
        """Send one request, such as `gripper`; return the daemon's message.

        Raises:
            RequestRefused: with the daemon's reason.
            DaemonUnreachable: if no daemon responds in time.
        """
        return str(self._response("POST", f"/{kind}", fields, timeout_s).json().get("message", ""))

    def overlay(self, finger: str) -> GelImage:
        """Return the newest processed frame with the contact drawn over it. Raises RequestRefused if there is none."""
        response = self._response("GET", f"/image/{finger}")
        bgr = cv2.imdecode(np.frombuffer(response.content, np.uint8), cv2.IMREAD_COLOR)
        if bgr is None:
            raise RequestRefused(f"the image of the {finger} finger cannot be decoded ({len(response.content)} bytes)")
        captured_at_s, sequence = float(response.headers["x-captured-at-s"]), int(response.headers["x-sequence"])
        return GelImage(np.ascontiguousarray(bgr[..., ::-1]), captured_at_s, sequence)

    def frames(self, finger: str, wait_s: float) -> Generator[GelImage | None]:
        """Yield each new frame of a finger, and None after each `wait_s` without one. Raises DaemonUnreachable."""
        try:
            with unix_connect(
                self.socket,
                f"ws://slipguard/frames/{finger}",
                compression=None,
                open_timeout=TIMEOUT_S,
                close_timeout=TIMEOUT_S,
                max_queue=1,  # the newest frame counts: the daemon skips what a slow client does not read
            ) as stream:
                while True:
                    yield _received(stream, wait_s)
        except (OSError, EOFError, ValueError, WebSocketException) as error:
            raise self._unreachable(error) from None

    def _response(
        self, method: str, path: str, fields: dict[str, Any] | None = None, timeout_s: float = TIMEOUT_S
    ) -> httpx.Response:
        try:
            response = self._http.request(method, path, json=fields, timeout=timeout_s)
        except httpx.TransportError as error:
            raise self._unreachable(error) from None
        if response.is_error:
            try:
                reason = str(response.json()["error"])
            except (ValueError, KeyError, TypeError):
                reason = f"HTTP {response.status_code}"
            raise RequestRefused(reason)
        return response

    def _unreachable(self, error: Exception) -> DaemonUnreachable:
        hint = "start it with `slipguard run`, or set `socket` to the socket that `slipguard ctl` uses"
        if not os.access(self.socket, os.W_OK) and os.path.exists(self.socket):
            hint = "run this program as root, as the daemon's user, or as a member of the group dialout"
        reason = str(error) or type(error).__name__
        return DaemonUnreachable(f"no slipguard daemon responds at {self.socket} ({reason}); {hint}")


def _received(stream: ClientConnection, wait_s: float) -> GelImage | None:
    try:
        message = stream.recv(wait_s)
    except TimeoutError:
        return None
    if not isinstance(message, bytes) or message[:4] != FRAME_MAGIC:
        raise ValueError(f"the stream sent {message[:16]!r}, not a frame; is it another version of slipguard?")
    _, width_px, height_px, _, captured_at_s, sequence = FRAME_HEADER.unpack_from(message)
    bgr = np.frombuffer(message, np.uint8, offset=FRAME_HEADER.size).reshape(height_px, width_px, 3)
    return GelImage(np.ascontiguousarray(bgr[..., ::-1]), captured_at_s, sequence)


def default_socket() -> str:
    """Return the socket of this user's daemon if it exists, else that of the system's."""
    state = os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"
    own = Path(state) / "slipguard" / SYSTEM_SOCKET.name
    return str(own if own.exists() else SYSTEM_SOCKET)
