"""Calls into the process that hosts ur-rtde, each with a deadline: what does not answer is killed."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
from typing import Any

from slipguard.errors import CommandRefused, DeviceLost
from slipguard_drivers.child_process import PACKET_BYTES, ChildProcess

WORKER = "slipguard_drivers.ur5.motion_worker"
CONNECT_S = 10.0
"""ur-rtde's constructor, the script's start and the watchdog: 0.1 s with an emulator, seconds with a controller."""


class MotionWorkerClient:
    """One worker process, from `connect` to `kill`, and one that waits to be the next: starting one can take a second.

    Calls are made one at a time.
    """

    def __init__(self, name: str, host: str) -> None:
        self._name = name
        self._host = host
        self._child: ChildProcess | None = None
        self._spare: ChildProcess | None = None
        self._asking: ChildProcess | None = None
        self._rotation = asyncio.Lock()
        self.connected = False
        """Whether it has the arm in hand."""

    @property
    def pid(self) -> int | None:
        """Of the process that has the arm, or is about to; None if there is none."""
        return self._child.pid if self._child is not None else None

    def prepare(self) -> None:
        """Let a process start and wait; it imports what it needs and connects to nothing. Idempotent."""
        if self._spare is not None and not self._spare.alive:
            self._spare.kill()
            self._spare = None
        if self._spare is None:
            self._spare = ChildProcess(WORKER, self._host)

    async def connect(self, watchdog_hz: float, deceleration_m_s2: float, *, upper: bool) -> None:
        """Let ur-rtde take the arm and arm the watchdog. Raises DeviceLost."""
        self.kill()
        self.prepare()
        self._child, self._spare = self._spare, None
        await self.call("connect", watchdog_hz, deceleration_m_s2, upper, deadline_s=CONNECT_S)
        self.connected = True
        self.prepare()

    async def call(self, request: str, *arguments: object, deadline_s: float) -> Any:
        """Make one call and return its result.

        Raises CommandRefused, or DeviceLost where the worker is dead, hangs, or has lost the controller.
        """
        async with self._rotation:
            if self._child is None:
                raise DeviceLost(f"{self._name}: the connection is not open; open it first")
            # A request once sent is answered to its end, whoever stops waiting: answers carry no number.
            packet = json.dumps([request, *arguments]).encode()
            work = asyncio.create_task(self._exchange(self._child, packet, deadline_s))
            try:
                return await asyncio.shield(work)
            except asyncio.CancelledError:
                await asyncio.wait([work])
                if not work.cancelled():
                    work.exception()
                raise

    def kill(self) -> None:
        """End the worker at once; the robot's watchdog then stops the arm. Idempotent."""
        child, self._child, self.connected = self._child, None, False
        if child is None:
            return
        if self._asking is child:  # the call that is under way sees the end, and puts the rest away
            with contextlib.suppress(ProcessLookupError):
                os.kill(child.pid, signal.SIGKILL)
        else:
            child.kill()

    def close(self) -> None:
        """`kill`, and let go of the one that waits. Idempotent."""
        self.kill()
        if self._spare is not None:
            self._spare.kill()
            self._spare = None

    async def _exchange(self, child: ChildProcess, packet: bytes, deadline_s: float) -> Any:
        reply: dict[str, Any] = {}
        why: str | None = None
        if self._child is child:
            self._asking = child
            try:
                reply, why = await self._ask(child, packet, deadline_s)
            finally:
                self._asking = None
        if self._child is not child:  # killed meanwhile: what is left of it is put away here
            child.kill()
            raise DeviceLost(f"{self._name}: the connection was given up; open the arm again")
        if why is not None:
            self._child, self.connected = None, False
            child.kill()
            raise DeviceLost(f"{self._name}: {why}")
        if "refused" in reply:
            raise CommandRefused(f"{self._name}: {reply['refused']}")
        return reply["ok"]

    async def _ask(self, child: ChildProcess, packet: bytes, deadline_s: float) -> tuple[dict[str, Any], str | None]:
        """The answer, and why the worker is of no use any more."""
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(deadline_s):
                await loop.sock_sendall(child.link, packet)
                answer = await loop.sock_recv(child.link, PACKET_BYTES)
        except TimeoutError:
            return {}, f"{self._host} did not answer in {deadline_s * 1000:.0f} ms"
        except OSError:
            answer = b""
        if not answer:
            return {}, "the process that talks to the controller has ended; open the arm again"
        reply = json.loads(answer)
        return reply, f"{self._host}: {reply['lost']}" if "lost" in reply else None
