"""Modbus RTU to the gripper's registers: the one user of pymodbus.

Modbus RTU has no transaction number, and pymodbus compares neither function nor size: after a time-out, a late answer
would be taken for the answer to the next request, and stay one behind for as long as the other side is slow. So one
request is on the line at a time, only bytes that begin like its answer are handed on, and a new line is in doubt, as
is one after anything but a good answer: it is kept silent for a while, and then a question of another size than any
before must be answered first. A slave answers in order, so whatever was late has come or never will.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from itertools import cycle
from typing import Any

from pymodbus.client import AsyncModbusSerialClient
from pymodbus.exceptions import ConnectionException, ModbusException
from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.register_message import ReadInputRegistersResponse, WriteMultipleRegistersResponse

from slipguard.cancellation import raise_if_cancelled
from slipguard.errors import DeviceLost, DeviceTimeout
from slipguard_drivers.robotiq import serial_port

BAUD = 115200
SPACING_S = 0.005
"""From one request to the next: the manual's minimum."""
PAUSE_S = 0.00175
"""From an answer to the next request: 3.5 characters, by the standard never less than this."""
SILENCE_S = 0.1
"""After a time-out; the slowest adapter (16 ms latency timer) with the slowest gripper answers well within it."""
READ, WRITE = 4, 16
LOOK_EVERY_S = 3.0
"""A port that cannot be opened: how often to look at every process for the one that has it."""
PASSING_S = 0.05
"""Whoever has the port for a shorter time only looked at it, as udev and emulated grippers do."""

# What goes wrong is told by our own errors; pymodbus would print it to the terminal as well.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)


def _serial(client: AsyncModbusSerialClient) -> Any:
    """The pyserial port inside."""
    return client.ctx.transport.sync_serial  # type: ignore[attr-defined]


@dataclass(frozen=True, slots=True)
class ExpectedResponse:
    """What an answer looks like: its first two bytes and its size, checksum included."""

    head: bytes
    size: int


class ModbusConnection:
    """Reads and writes 16-bit registers of one slave. A call that was begun must not be cancelled.

    probe_address: two registers that may be read at any time, to find out whether the line is in order. by_s, of every
    call: when it must have ended, on the loop's clock; what would take longer is not begun, and raises DeviceTimeout.
    """

    def __init__(self, name: str, port: str, slave_id: int, timeout_s: float, probe_address: int) -> None:
        self._name = name
        self._port = port
        self._slave_id = slave_id
        self._timeout_s = timeout_s
        self._probe_address = probe_address
        self._probe_sizes = cycle((1, 2))
        self._client: AsyncModbusSerialClient | None = None
        self._rotation = asyncio.Lock()
        self._free_at_s = 0.0
        self._in_doubt = False
        self._silent_from_s = 0.0
        """Where the silence after a doubt began: with the doubt, or with the last byte after it."""
        self._awaited: ExpectedResponse | None = None
        self._heard = b""
        """What has come since the present request."""
        self._others: set[int] = set()
        """Processes that had the port when we last wanted it."""
        self._look_again_s = -math.inf

    @property
    def connected(self) -> bool:
        """Whether the port is open; a gripper behind it may still be silent."""
        return self._client is not None and self._client.connected

    async def connect(self) -> None:
        """Open the port for us alone. Raises DeviceLost with what is wrong with it, or who else has it.

        Neither a lock nor exclusive use keeps out a program that was there before and asked for no lock, and two
        masters could open a grip. So nothing is sent before others have been looked for; not all can be seen, see
        `serial_port.others`.
        """
        self.close()
        if self._others:
            self._others = await asyncio.to_thread(serial_port.others, self._port, self._others)
            if self._others:
                raise self._not_alone()
        client = AsyncModbusSerialClient(
            self._port, baudrate=BAUD, timeout=self._timeout_s, retries=0, reconnect_delay=0, trace_packet=self._pass
        )
        client.set_max_no_responses(1_000_000)  # a silent gripper is our caller's business, not pymodbus's
        if not await client.connect():
            raise DeviceLost(f"{self._name}: {self._port} cannot be opened: {await self._why()}")
        try:
            # Its reader is set up by callbacks of the next two turns of the loop; closing before them trips it.
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            raise_if_cancelled()
            fd = _serial(client).fileno()
            serial_port.claim(fd)  # before the look: who opens it from now on is kept out
            serial_port.hurry(fd)
            self._others = await asyncio.to_thread(serial_port.others, self._port)
            if self._others:
                await asyncio.sleep(PASSING_S)
                self._others = await asyncio.to_thread(serial_port.others, self._port, self._others)
            if self._others:
                raise self._not_alone()
        except BaseException:  # a cancelled look is none
            client.close()
            raise
        self._doubt()  # whoever had the port before may have left a question that is still to be answered
        self._client = client

    async def _why(self) -> str:
        """Why the port cannot be opened."""
        if why := serial_port.out_of_order(self._port):
            return why
        now_s = asyncio.get_running_loop().time()
        if now_s >= self._look_again_s:
            self._look_again_s = now_s + LOOK_EVERY_S
            self._others = await asyncio.to_thread(serial_port.others, self._port)
        return serial_port.in_use(self._others)

    def _not_alone(self) -> DeviceLost:
        return DeviceLost(f"{self._name}: {self._port} is not used: {serial_port.in_use(self._others)}")

    def close(self) -> None:
        """Let go of the port. Idempotent."""
        if self._client is not None:
            self._client.close()
            self._client = None

    async def read(self, address: int, count: int, by_s: float) -> list[int]:
        """Read input registers (FC 4). Raises DeviceTimeout, DeviceLost."""
        async with self._rotation:
            await self._make_sure(by_s)
            return await self._read(address, count)

    async def write(self, address: int, values: list[int], by_s: float) -> None:
        """Write holding registers (FC 16). Raises DeviceTimeout, DeviceLost; what was written is not known then."""
        async with self._rotation:
            await self._make_sure(by_s)
            answer = await self._ask(
                ExpectedResponse(bytes([self._slave_id, WRITE]), 8),
                lambda client: client.write_registers(address, values, device_id=self._slave_id),
            )
            if type(answer) is not WriteMultipleRegistersResponse:
                raise self._confused(f"{type(answer).__name__} answers a write")
            if (answer.address, answer.count) != (address, len(values)):
                raise self._confused(
                    f"an answer for {answer.count} registers at 0x{answer.address:04X} instead of {len(values)} at "
                    f"0x{address:04X}"
                )

    async def _read(self, address: int, count: int) -> list[int]:
        answer = await self._ask(
            ExpectedResponse(bytes([self._slave_id, READ]), 5 + 2 * count),
            lambda client: client.read_input_registers(address, count=count, device_id=self._slave_id),
        )
        if type(answer) is not ReadInputRegistersResponse or len(answer.registers) != count:
            raise self._confused(f"{type(answer).__name__} answers a read of {count} registers")
        return list(answer.registers)

    async def _make_sure(self, by_s: float) -> None:
        """Before each request: its distance to the last; after a doubt a question that only its own answer fits."""
        await self._keep_distance()
        if self._has_unread():
            self._doubt()
        if self._in_doubt:
            while (left_s := self._silence_left_s()) > 0.0:
                self._check_time(left_s + 2.0 * self._timeout_s, by_s)
                await asyncio.sleep(left_s)
            self._in_doubt = False
            await self._read(self._probe_address, next(self._probe_sizes))
            await self._keep_distance()
            if self._in_doubt or self._has_unread():
                raise self._confused("more came than was asked for")
        self._check_time(self._timeout_s, by_s)

    def _silence_left_s(self) -> float:
        """How long the line has still to be silent; after a late turn of the loop what came meanwhile is unread."""
        if self._has_unread():
            self._doubt()
        return self._silent_from_s + SILENCE_S - asyncio.get_running_loop().time()

    def _check_time(self, needed_s: float, by_s: float) -> None:
        if asyncio.get_running_loop().time() + needed_s > by_s:
            raise DeviceTimeout(
                f"{self._name}: {self._port} is too slow or never silent; see whether another master is on the line"
            )

    async def _keep_distance(self) -> None:
        await asyncio.sleep(self._free_at_s - asyncio.get_running_loop().time())

    def _has_unread(self) -> bool:
        """Whether bytes that nobody has asked for are waiting in the port."""
        try:
            return self._client is not None and self._client.connected and bool(_serial(self._client).in_waiting)
        except OSError:  # just unplugged; the next request says so
            return False

    async def _ask(
        self, awaited: ExpectedResponse, request: Callable[[AsyncModbusSerialClient], Awaitable[ModbusPDU]]
    ) -> ModbusPDU:
        loop = asyncio.get_running_loop()
        client = self._client
        if client is None or not client.connected:
            raise self._gone()
        self._free_at_s = loop.time() + SPACING_S
        self._awaited, self._heard = awaited, b""
        try:
            return await request(client)
        except ConnectionException:
            raise self._gone() from None
        except (ModbusException, OSError):
            self._doubt()
            if not client.connected:
                raise self._gone() from None
            if self._heard:
                raise self._confused(f"{self._heard[:16].hex(' ')} is no whole answer to the request") from None
            raise DeviceTimeout(
                f"{self._name}: no answer within {self._timeout_s * 1000:.0f} ms from slave {self._slave_id} on "
                f"{self._port}; check the gripper's power and the cable"
            ) from None
        finally:
            self._awaited = None
            self._free_at_s = max(self._free_at_s, loop.time() + PAUSE_S)

    def _pass(self, sending: bool, data: bytes) -> bytes:
        """Hand on what begins like the awaited answer, as soon as it is whole; all else casts doubt on the line.

        data: everything since the request.
        """
        if sending:
            return data
        awaited = self._awaited
        if awaited is None:
            self._doubt()
            return b""
        self._heard = data
        head = data[: len(awaited.head)]
        if head != awaited.head[: len(head)] or len(data) > awaited.size:
            self._doubt()
        fits = head == awaited.head and len(data) >= awaited.size
        return data[: awaited.size] if fits else b""

    def _doubt(self) -> None:
        self._in_doubt = True
        self._silent_from_s = asyncio.get_running_loop().time()

    def _gone(self) -> DeviceLost:
        self.close()
        return DeviceLost(f"{self._name}: the connection on {self._port} is gone; open it again")

    def _confused(self, what: str) -> DeviceTimeout:
        self._doubt()
        return DeviceTimeout(f"{self._name}: {what}; check the cable, ask again")
