"""Calls into the process that runs ur-rtde. Each call has a deadline; a process that misses it is killed."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
from collections.abc import Sequence
from typing import Any

from slipguard.errors import CommandRefused, DeviceLost
from slipguard_drivers.child_process import PACKET_BYTES, ChildProcess

WORKER = "slipguard_drivers.ur5.motion_worker"
CONNECT_TIMEOUT_S = 10.0
"""ur-rtde's constructor, the script's start and the watchdog: 0.1 s with an emulator, seconds with a controller."""


class MotionWorkerClient:
    """One worker process from `connect` to `kill`, and a started spare, because starting one can take a second.

    Calls are made one at a time.
    """

    def __init__(self, name: str, host: str) -> None:
        self._name = name
        self._host = host
        self._worker: ChildProcess | None = None
        self._spare: ChildProcess | None = None
        self._called: ChildProcess | None = None
        self._lock = asyncio.Lock()
        self.connected = False
        """Whether the worker controls the arm."""

    @property
    def pid(self) -> int | None:
        """Process id of the worker that controls the arm, or is about to; None if there is no such process."""
        return self._worker.pid if self._worker is not None else None

    def start_spare(self) -> None:
        """Start a process that imports what it needs and waits; it connects to nothing. Idempotent."""
        if self._spare is not None and not self._spare.alive:
            self._spare.kill()
            self._spare = None
        if self._spare is None:
            self._spare = ChildProcess(WORKER, self._host)

    async def connect(
        self, watchdog_hz: float, deceleration_m_s2: float, mark: Sequence[float], *, upper_registers: bool
    ) -> None:
        """Let ur-rtde take control of the arm, start the robot's watchdog and mark the script. Raises DeviceLost."""
        self.kill()
        self.start_spare()
        self._worker, self._spare = self._spare, None
        arguments = (watchdog_hz, deceleration_m_s2, list(mark), upper_registers)
        await self.call("connect", *arguments, timeout_s=CONNECT_TIMEOUT_S)
        self.connected = True
        self.start_spare()

    async def call(self, request: str, *arguments: object, timeout_s: float) -> Any:
        """Make one call and return its result.

        Raises:
            CommandRefused: if the robot refuses it.
            DeviceLost: if the worker is dead, hangs, or has lost the controller.
        """
        async with self._lock:
            if self._worker is None:
                raise DeviceLost(f"{self._name}: the connection is not open; open it first")
            # Responses carry no number, so a request is completed even if the caller is cancelled.
            packet = json.dumps([request, *arguments]).encode()
            exchange = asyncio.create_task(self._exchange(self._worker, packet, timeout_s))
            try:
                return await asyncio.shield(exchange)
            except asyncio.CancelledError:
                await asyncio.wait([exchange])
                if not exchange.cancelled():
                    exchange.exception()
                raise

    def kill(self) -> None:
        """End the worker at once; the robot's watchdog then stops the arm. Idempotent."""
        worker, self._worker, self.connected = self._worker, None, False
        if worker is None:
            return
        if self._called is worker:  # the running call receives the end of file and frees the rest
            with contextlib.suppress(ProcessLookupError):
                os.kill(worker.pid, signal.SIGKILL)
        else:
            worker.kill()

    def close(self) -> None:
        """End the worker and the spare. Idempotent."""
        self.kill()
        if self._spare is not None:
            self._spare.kill()
            self._spare = None

    async def _exchange(self, worker: ChildProcess, packet: bytes, timeout_s: float) -> Any:
        reply: dict[str, Any] = {}
        failure: str | None = None
        if self._worker is worker:
            self._called = worker
            try:
                reply, failure = await self._send(worker, packet, timeout_s)
            finally:
                self._called = None
        if self._worker is not worker:  # killed during the call
            worker.kill()
            raise DeviceLost(f"{self._name}: the connection was closed; open the arm again")
        if failure is not None:
            self._worker, self.connected = None, False
            worker.kill()
            raise DeviceLost(f"{self._name}: {failure}")
        if "refused" in reply:
            raise CommandRefused(f"{self._name}: {reply['refused']}")
        return reply["ok"]

    async def _send(self, worker: ChildProcess, packet: bytes, timeout_s: float) -> tuple[dict[str, Any], str | None]:
        """Return the reply, and why the worker cannot be used any more (None if it can)."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(timeout_s):
                await loop.sock_sendall(worker.link, packet)
                received = await loop.sock_recv(worker.link, PACKET_BYTES)
        except TimeoutError:
            return {}, f"{self._host} did not answer within {timeout_s * 1000:.0f} ms; open the arm again"
        except OSError:
            received = b""
        if not received:
            return {}, "the process that controls the arm has ended; open the arm again"
        reply = json.loads(received)
        return reply, f"{self._host}: {reply['lost']}" if "lost" in reply else None
