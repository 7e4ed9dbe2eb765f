"""Robotiq's URCap on the robot: it owns the gripper's RS-485 line and serves named variables on TCP port 63352.

`SET POS 255 GTO 1` is acknowledged by `ack`, `GET POS` is answered by `POS 255`; requests end with a newline, responses
need not. What is known of it, as the URCap is not documented for this use:

* The variables ACT, GTO, ATR, ARD, FOR, SPE, POS, OBJ, STA, FLT, PRE, and SID, which selects a gripper by its Modbus
  address for this connection: the script that the URCap adds to each program of the panel (`rq_script`).
* POS is written as the requested position and read as the actual one; PRE is the gripper's echo of the request. Several
  variables fit into one SET: ur_rtde's example `robotiq_gripper.py`.
* The direction of the automatic release is ARD in the script, but ADR in that example. A name that is wrong would leave
  the direction at closing. So it counts as set only once it was read back.
* The values are a copy that the URCap refreshes, and it is not documented how often, nor whether ACT and GTO are the
  gripper's or those last set. So a stop is followed by a pause, `settle_s`, before it is trusted.
* Several clients are served at the same time. Programs of the panel are such clients, and command the same gripper.

A response does not say which request it answers, and a number has no end mark. Therefore only one request is under way
at a time, and a response must begin where the previous one ended. After anything else, a probe is sent, a variable that
no status contains, and everything that precedes its response is discarded. Responses come in the order of the requests,
so a late value is never taken for a new one.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import Iterator
from itertools import cycle

from slipguard.diagnosis import CheckResult, note
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout
from slipguard_drivers.robotiq.byte_line import ByteLine, host_and_port
from slipguard_drivers.robotiq.registers import SLAVE_ID, FingerMotion, RobotiqCommand, RobotiqStatus
from slipguard_drivers.robotiq.transport import UNMEASURED_TIMEOUT_S, GripperTransport

READ_ORDER = ("PRE", "POS", "FLT", "ACT", "GTO", "STA", "OBJ")
"""Numbers of several digits come first: responses need no end mark, so the rest of a torn one is noticed by what
follows it. OBJ comes last, so that it is never older than the echo of the command."""
LARGEST = {"PRE": 255, "POS": 255, "FLT": 15, "ACT": 1, "GTO": 1, "STA": 3, "OBJ": 3}
RELEASE_DIRECTIONS = ("ARD", "ADR")
SETTLE_S = 0.06
"""Published clients wait 8 ms after each SET; several refreshes of a slow copy fit into this."""
PROBES = ("SPE", "FOR")
RECEIVED_MAX = 4096
VALUE = rb"\s*%s\s+(\d+|\?+)"
ACK = re.compile(rb"\s*ack")
NO_DIRECTION = (
    "not released: the URCap does not take the direction of an automatic release, and the gripper might close instead. "
    "Support what it holds, and open the gripper at the robot's panel"
)


class UrcapConnection(GripperTransport):
    """The gripper behind Robotiq's URCap. address: HOST:PORT of the robot."""

    requests_per_read = len(READ_ORDER)
    settle_s = SETTLE_S

    def __init__(self, name: str, address: str, slave_id: int, timeout_s: float) -> None:
        super().__init__(timeout_s)
        self._name = name
        self._address = address
        self._slave_id = slave_id
        host, port = host_and_port(address)
        self._line = ByteLine(f"socket://{host}:{port}", self._on_bytes, self._on_lost)
        self._lock = asyncio.Lock()
        self._probes = cycle(PROBES)
        self._in_step = True
        """Whether every response has been received and belonged to its request."""
        self._received = b""
        self._expected: re.Pattern[bytes] | None = None
        self._response: asyncio.Future[re.Match[bytes]] | None = None

    @property
    def connected(self) -> bool:
        """Whether the connection is open."""
        return self._line.is_open

    async def connect(self) -> None:
        """Connect and select the gripper. Raises DeviceLost."""
        self.close()
        try:
            await self._line.open()
        except OSError as error:
            raise DeviceLost(
                f"{self._name}: {self._address} does not accept connections ({error.strerror or 'no answer'}); check "
                "the robot's address and power, and that Robotiq's URCap is installed and has found the gripper"
            ) from None
        self._received, self._in_step = b"", True
        if self._slave_id == SLAVE_ID:
            return
        self.timeout_s = max(self.timeout_s, UNMEASURED_TIMEOUT_S)
        try:
            async with self._lock:
                await self._set({"SID": self._slave_id}, asyncio.get_running_loop().time() + 2.0 * self.timeout_s)
        except DeviceError:
            self.close()
            raise DeviceLost(f"{self._name}: the URCap knows no gripper {self._slave_id}; check slave_id") from None

    def close(self) -> None:
        """Begin to disconnect. Idempotent."""
        self._line.close()

    async def closed(self) -> None:
        """Wait until disconnected."""
        await self._line.settled()

    async def read_status(self, deadline_s: float) -> RobotiqStatus:
        """Read the variables one after the other; they are not of the same instant."""
        async with self._lock:
            values = {name: await self._get(name, deadline_s) for name in READ_ORDER}
        return RobotiqStatus(
            activated=bool(values["ACT"]),
            going=bool(values["GTO"]),
            ready=values["STA"] == 3,
            motion=FingerMotion(values["OBJ"]),
            fault_code=values["FLT"],
            position_echo=values["PRE"],
            position=values["POS"],
            activating=values["STA"] == 1,
        )

    async def write_command(self, command: RobotiqCommand, deadline_s: float) -> None:
        """Set the variables; GTO first if it is to stop the fingers, and last if it is to start them."""
        async with self._lock:
            try:
                await self._write(command, deadline_s)
            except DeviceError as error:
                raise type(error)(f"{error}; the gripper may have executed the command") from None

    def diagnose(self) -> Iterator[CheckResult]:
        """Name what slipguard cannot prevent: other commands to the same gripper."""
        yield note(
            "URCap",
            f"the gripper is commanded through Robotiq's URCap at {self._address}",
            "use the gripper in no program of the panel while slipguard guards: the URCap executes both",
        )

    async def _write(self, command: RobotiqCommand, deadline_s: float) -> None:
        values = {"POS": command.position, "SPE": command.speed, "FOR": command.force}
        if command.auto_release:
            await self._set_direction(deadline_s)
            values = {"ATR": 1}
        elif not command.activate:
            values = {"GTO": 0, "ATR": 0, "POS": 0, "ACT": 0}
        elif command.go:
            values = {"ACT": 1, **values, "GTO": 1}
        else:
            values = {"GTO": 0, "ACT": 1, **values}
        await self._set(values, deadline_s)

    async def _set_direction(self, deadline_s: float) -> None:
        """Let an automatic release open. Raises CommandRefused if that cannot be verified."""
        for name in RELEASE_DIRECTIONS:
            try:
                await self._set({name: 1}, deadline_s)
                if await self._get(name, deadline_s) == 1:
                    return
            except DeviceTimeout:  # an unknown name
                continue
        raise CommandRefused(f"{self._name}: {NO_DIRECTION}")

    async def _set(self, values: dict[str, int], deadline_s: float) -> None:
        words = " ".join(f"{name} {value}" for name, value in values.items())
        await self._exchange(f"SET {words}\n", ACK, deadline_s)

    async def _get(self, name: str, deadline_s: float) -> int:
        match = await self._exchange(f"GET {name}\n", re.compile(VALUE % name.encode()), deadline_s)
        if not match[1].isdigit():
            raise DeviceTimeout(
                f"{self._name}: the URCap has no value of {name}; check the gripper's 24 V and its cable, and that the "
                "URCap shows it as connected"
            )
        if (value := int(match[1])) > LARGEST.get(name, 255):
            raise DeviceTimeout(f"{self._name}: the URCap answers {name} {value}, which no gripper reports; try again")
        return value

    async def _exchange(self, request: str, expected: re.Pattern[bytes], deadline_s: float) -> re.Match[bytes]:
        """Send a request and return its response, after a probe if an earlier response is missing or left over."""
        self._line.receive()
        if not self._in_step or self._received.strip():
            probe = next(self._probes)
            await self._send(f"GET {probe}\n", re.compile(b"(?s:.*)" + VALUE % probe.encode()), deadline_s)
            self._in_step = True
        return await self._send(request, expected, deadline_s)

    async def _send(self, request: str, expected: re.Pattern[bytes], deadline_s: float) -> re.Match[bytes]:
        loop = asyncio.get_running_loop()
        if not self.connected:
            raise self._connection_lost()
        if loop.time() + self.timeout_s > deadline_s:
            raise DeviceTimeout(f"{self._name}: {self._address} is too slow for another request; try again")
        response: asyncio.Future[re.Match[bytes]] = loop.create_future()
        self._expected, self._response = expected, response
        try:
            self._line.write(request.encode())
            await asyncio.wait([response], timeout=self.timeout_s)
            if not response.done():
                self._line.receive()  # what arrived during a late cycle of the loop
            if response.done():
                return response.result()
            self._in_step = False
            raise DeviceTimeout(f"{self._name}: {self._problem()}")
        except OSError:
            raise self._connection_lost() from None
        finally:
            self._expected = self._response = None

    def _on_bytes(self, data: bytes) -> None:
        self._received = (self._received + data)[-RECEIVED_MAX:]
        if self._expected is None or self._response is None or self._response.done():
            return
        if match := self._expected.match(self._received):
            self._received = self._received[match.end() :]
            self._response.set_result(match)

    def _on_lost(self) -> None:
        if self._response is not None and not self._response.done():
            self._response.set_exception(self._connection_lost())

    def _problem(self) -> str:
        if self._received.strip():
            return f"{self._received[:32]!r} is not the expected response of the URCap; check what listens on its port"
        return (
            f"no response within {self.timeout_s * 1000:.0f} ms from {self._address}; check the robot's power and "
            "network, and that Robotiq's URCap runs"
        )

    def _connection_lost(self) -> DeviceLost:
        self.close()
        return DeviceLost(f"{self._name}: the connection to {self._address} is gone; open it again")
