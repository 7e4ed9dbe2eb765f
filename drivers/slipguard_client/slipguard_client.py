"""Client of slipguard's local API, for programs that cannot import slipguard: ROS 2 and LeRobot bring their own Python
and their own OpenCV. Standard library only, Python 3.10 or newer.

    api = LocalApi()                                 # the daemon that runs on this machine
    print(api.submit("grasp", {"force_n": 40}))      # requests: `slipguard ctl --help`
    stream = StreamThread(api, "/estimates", lambda message: print(json.loads(message)), print)
"""

from __future__ import annotations

import base64
import contextlib
import http.client
import json
import os
import socket
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

SYSTEM_SOCKET = "/run/slipguard/slipguard.sock"
"""Of the daemon that systemd runs."""
FINGERS = ("left", "right")
REQUEST_TIMEOUT_S = 6.0
SLOW_REQUESTS_S = {"calibrate": 35.0, "activate": 25.0}
CONNECT_TIMEOUT_S = 5.0
STREAM_TIMEOUT_S = 45.0
"""The daemon sends a ping every 20 s."""
RETRY_S = 0.5
MESSAGE_MAX_BYTES = 4 * 1024 * 1024
TEXT, BINARY, CLOSE, PING, PONG = 1, 2, 8, 9, 10
FRAME_HEADER = struct.Struct("<4sHHIdQ")
FRAME_MAGIC = b"SGF1"


class DaemonUnreachable(ConnectionError):
    """No daemon responds at the socket; str() says what to do."""


class RequestRefused(RuntimeError):
    """The daemon refused a request; str() is the daemon's reason."""


@dataclass(frozen=True)
class GelImage:
    """One captured frame.

    pixels: rows from top to bottom, B, G, R for each pixel. captured_at_s: on this machine's monotonic clock.
    """

    width_px: int
    height_px: int
    captured_at_s: float
    sequence: int
    pixels: memoryview


def parse_frame(message: bytearray) -> GelImage:
    """Return the frame in a message of the stream `/frames/{finger}`. Raises ValueError if it is not one."""
    if len(message) < FRAME_HEADER.size:
        raise ValueError(f"a message of {len(message)} bytes is not a frame")
    magic, width, height, size, captured_at_s, sequence = FRAME_HEADER.unpack_from(message)
    pixels = memoryview(message)[FRAME_HEADER.size :]
    if magic != FRAME_MAGIC or len(pixels) != size or size != 3 * width * height:
        raise ValueError(f"{magic!r}, {width} x {height} pixels in {len(pixels)} bytes is not a frame")
    return GelImage(width, height, captured_at_s, sequence, pixels)


def default_sockets() -> tuple[str, ...]:
    """Return the sockets of this user's daemon and of the system's, in the order in which they are tried."""
    state = os.environ.get("XDG_STATE_HOME") or os.path.expanduser("~/.local/state")
    return os.path.join(state, "slipguard", os.path.basename(SYSTEM_SOCKET)), SYSTEM_SOCKET


class LocalApi:
    """Requests to one daemon; usable from several threads.

    socket_path: the daemon's Unix socket; empty: the first of `default_sockets` that responds, from then on.
    Methods raise DaemonUnreachable, or RequestRefused with the daemon's reason.
    """

    def __init__(self, socket_path: str = "") -> None:
        self._candidates = (socket_path,) if socket_path else default_sockets()
        self.socket_path = self._candidates[-1]

    def state(self, timeout_s: float = REQUEST_TIMEOUT_S) -> dict[str, Any]:
        """Return the complete state; it is at most 0.1 s old."""
        state: dict[str, Any] = json.loads(self.get("/state", timeout_s)[0])
        return state

    def submit(self, kind: str, fields: dict[str, Any] | None = None) -> str:
        """Send one request, such as `lift`; return the daemon's message. A field that is None is left out."""
        body = json.dumps({key: value for key, value in (fields or {}).items() if value is not None})
        content, _ = self._request("POST", f"/{kind}", body, SLOW_REQUESTS_S.get(kind, REQUEST_TIMEOUT_S))
        return str(json.loads(content).get("message", ""))

    def get(self, path: str, timeout_s: float = REQUEST_TIMEOUT_S) -> tuple[bytes, http.client.HTTPMessage]:
        """Return content and headers of a path, such as `/image/left`."""
        return self._request("GET", path, None, timeout_s)

    def open_stream(self, path: str) -> MessageStream:
        """Open a stream: `/live`, `/estimates` or `/frames/{finger}`."""
        return MessageStream(self._connect(CONNECT_TIMEOUT_S), path)

    def _request(
        self, method: str, path: str, body: str | None, timeout_s: float
    ) -> tuple[bytes, http.client.HTTPMessage]:
        connection = http.client.HTTPConnection("slipguard")
        connection.sock = self._connect(timeout_s)
        try:
            connection.request(method, path, body, {"content-type": "application/json"})
            response = connection.getresponse()
            content = response.read()
        except (OSError, http.client.HTTPException) as error:
            raise DaemonUnreachable(
                f"no response to {path} from the daemon at {self.socket_path} within {timeout_s:g} s ({error!r})"
            ) from None
        finally:
            connection.close()
        if response.status != 200:
            reason = f"HTTP {response.status}"
            with contextlib.suppress(ValueError, KeyError, TypeError):
                reason = str(json.loads(content)["error"])
            raise RequestRefused(reason)
        return content, response.headers

    def _connect(self, timeout_s: float) -> socket.socket:
        for path in self._candidates[:-1]:
            with contextlib.suppress(DaemonUnreachable):
                return self._connect_to(path, timeout_s)
        return self._connect_to(self._candidates[-1], timeout_s)

    def _connect_to(self, path: str, timeout_s: float) -> socket.socket:
        made = socket.socket(socket.AF_UNIX)
        made.settimeout(timeout_s)
        try:
            made.connect(path)
        except OSError as error:
            made.close()
            hint = "start it with `slipguard run`, or set `socket` to the path that `slipguard ctl` uses"
            if isinstance(error, PermissionError):
                hint = "run this program as root, as the daemon's user, or as a member of the group dialout"
            raise DaemonUnreachable(f"no slipguard daemon at {path} ({error.strerror or error}); {hint}") from None
        # No request may reach another daemon later, such as a real cell's after a simulated one has ended.
        self.socket_path, self._candidates = path, (path,)
        return made


class MessageStream:
    """A WebSocket on a connected socket; reads messages, and responds to pings."""

    def __init__(self, connected: socket.socket, path: str) -> None:
        self._socket = connected
        self._file = connected.makefile("rb", buffering=64 * 1024)
        try:
            self._open(path)
        except (OSError, ValueError) as error:
            self.close()
            raise DaemonUnreachable(f"the stream {path} was not opened ({error})") from None

    def _open(self, path: str) -> None:
        key = base64.b64encode(os.urandom(16)).decode()
        self._socket.sendall(
            f"GET {path} HTTP/1.1\r\nHost: slipguard\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        status = self._file.readline(1024).decode(errors="replace").strip()
        while self._file.readline(8192) not in (b"\r\n", b""):
            pass
        if " 101 " not in f"{status} ":
            raise ValueError(status or "the daemon closed the connection")
        self._socket.settimeout(STREAM_TIMEOUT_S)

    def next(self) -> bytearray:
        """Wait for the next message, text or binary. Raises OSError or EOFError when the stream has ended."""
        while True:
            first, length = self._read(2)
            if length == 126:
                (length,) = struct.unpack(">H", self._read(2))
            elif length == 127:
                (length,) = struct.unpack(">Q", self._read(8))
            if length > MESSAGE_MAX_BYTES:
                raise EOFError(f"a message of {length} bytes; the limit is {MESSAGE_MAX_BYTES}")
            payload, kind = self._read(length), first & 0x0F
            if kind in (TEXT, BINARY):
                return payload
            if kind == PING:
                self._pong(payload)
            elif kind == CLOSE:
                raise EOFError("the daemon closed the stream")

    def _read(self, size: int) -> bytearray:
        data = bytearray(size)
        if self._file.readinto(data) != size:
            raise EOFError("the daemon closed the connection")
        return data

    def _pong(self, payload: bytearray) -> None:
        mask = os.urandom(4)
        masked = bytes(byte ^ mask[index % 4] for index, byte in enumerate(payload))
        self._socket.sendall(bytes((0x80 | PONG, 0x80 | len(payload))) + mask + masked)

    def close(self) -> None:
        """End the stream; a `next` that waits in another thread raises."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()


class StreamThread:
    """Reads one stream in a thread, and opens it again after a loss.

    on_message: called in the thread with each message. on_lost: called in the thread with the reason of each loss.
    """

    def __init__(
        self, api: LocalApi, path: str, on_message: Callable[[bytearray], object], on_lost: Callable[[str], object]
    ) -> None:
        self._api, self._path = api, path
        self._on_message, self._on_lost = on_message, on_lost
        self._stopped = threading.Event()
        self._stream: MessageStream | None = None
        self._thread = threading.Thread(target=self._run, name=f"slipguard {path}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the stream and wait for the thread."""
        self._stopped.set()
        stream = self._stream
        if stream is not None:
            stream.close()
        if self._thread is not threading.current_thread():
            self._thread.join(timeout=2 * CONNECT_TIMEOUT_S)

    def _run(self) -> None:
        while not self._stopped.is_set():
            why = self._read_until_lost()
            if not self._stopped.is_set():
                self._on_lost(why)
                self._stopped.wait(RETRY_S)

    def _read_until_lost(self) -> str:
        """Pass on messages until the stream ends; return the reason."""
        try:
            self._stream = self._api.open_stream(self._path)
            while not self._stopped.is_set():
                self._on_message(self._stream.next())
        except Exception as error:  # no message may end the thread
            return str(error) or repr(error)
        finally:
            if self._stream is not None:
                self._stream.close()
                self._stream = None
        return "stopped"
