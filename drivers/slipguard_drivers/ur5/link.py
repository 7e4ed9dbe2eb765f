"""Calls into the process that hosts ur-rtde, each with a deadline: what does not answer is killed."""

from __future__ import annotations

import asyncio
import json
from typing import Any

from slipguard.errors import CommandRefused, DeviceLost
from slipguard_drivers.child import PACKET_BYTES, Child

WORKER = "slipguard_drivers.ur5.worker"
PORTS = {30004: "RTDE", 29999: "dashboard", 30003: "script"}
CONNECT_S = 2.0
START_S = 15.0
"""Interpreter, two ur-rtde constructors and the script's start: 0.4 s with an emulator, seconds with a controller."""


class WorkerLink:
    """One worker process, from `start` to `kill`. Calls are made one at a time."""

    def __init__(self, name: str, host: str) -> None:
        self._name = name
        self._host = host
        self._child: Child | None = None
        self._turn = asyncio.Lock()

    @property
    def up(self) -> bool:
        """Whether a worker is there to be called."""
        return self._child is not None

    async def start(self, watchdog_hz: float, deceleration_m_s2: float) -> None:
        """Look whether a controller answers, then let ur-rtde connect to it. Raises DeviceLost."""
        self.kill()
        for port, what in PORTS.items():
            await self._check_port(port, what)
        self._child = Child(WORKER, self._host, str(watchdog_hz), str(deceleration_m_s2))
        try:
            await self._receive(START_S)
        except BaseException:
            self.kill()
            raise

    async def call(self, request: str, *arguments: float, deadline_s: float) -> Any:
        """Make one call and return its result.

        Raises CommandRefused, or DeviceLost where the worker is dead, hangs, or has lost the controller.
        """
        async with self._turn:
            if self._child is None:
                raise DeviceLost(f"{self._name}: the connection is not open; open it first")
            # A request once sent is answered to its end, whoever stops waiting: answers carry no number.
            work = asyncio.create_task(self._exchange(json.dumps([request, *arguments]).encode(), deadline_s))
            try:
                return await asyncio.shield(work)
            except asyncio.CancelledError:
                await asyncio.wait([work])
                if not work.cancelled():
                    work.exception()
                raise

    def kill(self) -> None:
        """End the worker at once; the robot's watchdog then stops the arm. Idempotent."""
        if self._child is not None:
            self._child.kill()
            self._child = None

    async def _exchange(self, packet: bytes, deadline_s: float) -> Any:
        assert self._child is not None
        try:
            await asyncio.get_running_loop().sock_sendall(self._child.link, packet)
        except OSError:
            self.kill()
            raise DeviceLost(f"{self._name}: the process that talks to the controller has ended") from None
        return await self._receive(deadline_s)

    async def _receive(self, deadline_s: float) -> Any:
        assert self._child is not None
        try:
            async with asyncio.timeout(deadline_s):
                packet = await asyncio.get_running_loop().sock_recv(self._child.link, PACKET_BYTES)
        except TimeoutError:
            self.kill()
            raise DeviceLost(
                f"{self._name}: the controller at {self._host} did not answer in {deadline_s:g} s"
            ) from None
        except OSError:
            packet = b""
        if not packet:
            self.kill()
            raise DeviceLost(f"{self._name}: the process that talks to the controller has ended; open the arm again")
        reply = json.loads(packet)
        if "refused" in reply:
            raise CommandRefused(f"{self._name}: {reply['refused']}")
        if "lost" in reply:
            self.kill()
            raise DeviceLost(f"{self._name}: {self._host}: {reply['lost']}")
        return reply["ok"]

    async def _check_port(self, port: int, what: str) -> None:
        """A constructor of ur-rtde would wait without end where this fails in two seconds."""
        try:
            async with asyncio.timeout(CONNECT_S):
                _, writer = await asyncio.open_connection(self._host, port)
        except (OSError, TimeoutError) as error:
            raise DeviceLost(
                f"{self._name}: no answer from {self._host}:{port} ({what}): {error or 'timed out'}; "
                "check the controller's power, its address and that remote control is on"
            ) from None
        writer.close()
        await asyncio.wait([asyncio.ensure_future(writer.wait_closed())], timeout=CONNECT_S)
