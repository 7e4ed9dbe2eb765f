"""The RS-485 forwarder of the emulated robot controller.

It is Universal Robots' URCap rs485, or tool-comm-forwarder on PolyScope X (their repositories
Universal_Robots_ToolComm_Forwarder_URCap and ..._URCapX): TCP port 54321 carries the bytes of the tool connector. Its
daemon runs `socat tcp-l:54321,reuseaddr,fork file:/dev/ttyTool,nonblock,raw,waitlock=/var/run/tty`. So every client is
connected, but only one has the lock on the device; the others wait, unanswered, until it leaves. Without 24 V at the
tool nothing answers. Delays in the network, in socat and on the controller are assumptions.
"""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable
from functools import partial

from slipguard.cancellation import TimerGroup
from slipguard_emulators.stream_server import Client, StreamServer


class ForwarderPort(StreamServer):
    """The bytes of the tool connector on TCP. on_bytes: called with the bytes that reach the gripper.

    relay_s, jitter_s: delay of bytes in each direction, and the largest random addition.
    """

    def __init__(
        self, host: str, port: int, on_bytes: Callable[[bytes], None], relay_s: float, jitter_s: float, seed: int
    ) -> None:
        super().__init__((host, port), self._relay)
        self._on_bytes = on_bytes
        self._relay_s, self._jitter_s = relay_s, jitter_s
        self._rng = random.Random(seed)
        self._lock = asyncio.Lock()
        self._client: asyncio.StreamWriter | None = None
        self._timers = TimerGroup()
        self._due_s = {"in": 0.0, "out": 0.0}

    def unplug(self) -> None:
        """Close the port and all connections; bytes under way are lost. Idempotent."""
        super().unplug()
        self._timers.cancel_all()

    def send(self, data: bytes, plug: int) -> None:
        """Send bytes of the gripper to the client that has the device, if there is one.

        plug: the value of `plugs` at the request; bytes that were on their way when the port disappeared are lost.
        """
        if plug == self.plugs and self.plugged:
            self._later("out", partial(self._write, data))

    async def _relay(self, client: Client) -> None:
        async with self._lock:
            reader, self._client = client
            try:
                while data := await reader.read(4096):
                    self._later("in", partial(self._on_bytes, data))
            finally:
                self._client = None

    def _write(self, data: bytes) -> None:
        if self._client is not None and not self._client.is_closing():
            self._client.write(data)

    def _later(self, direction: str, act: Callable[[], None]) -> None:
        """Act after the relay's delay; bytes stay in order."""
        delay_s = self._relay_s + self._rng.uniform(0.0, self._jitter_s)
        due_s = max(asyncio.get_running_loop().time() + delay_s, self._due_s[direction])
        self._due_s[direction] = due_s
        self._timers.call_at(due_s, act)
