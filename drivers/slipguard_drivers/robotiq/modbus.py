"""Modbus RTU access to the gripper's registers; the only user of pymodbus.

Modbus RTU has no transaction number, and pymodbus checks neither function nor size. After a time-out, a late response
would be taken for the response to the next request, and every response would stay one behind. Therefore:

* only one request is on the line at a time;
* only bytes that begin like the expected response are passed on;
* after anything but a good response, and on a new connection, the line counts as out of sync. It must then be silent
  for a while, and a probe with a response of another size than the previous probe must be answered first. A slave
  answers in order, so by then every late response has arrived or never will.
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
REQUEST_PERIOD_S = 0.005
"""From one request to the next: the manual's minimum."""
PAUSE_S = 0.00175
"""From a response to the next request: 3.5 characters, never less than this by the standard."""
SILENCE_S = 0.1
"""After a time-out; the slowest adapter (16 ms latency timer) with the slowest gripper answers well within it."""
READ, WRITE = 4, 16
HOLDERS_PERIOD_S = 3.0
"""How often to search all processes for the one that holds a port that cannot be opened."""
BRIEF_USE_S = 0.05
"""A program that has the port open for a shorter time only inspects it, as udev and emulated grippers do."""

# Failures are reported by our own errors; pymodbus would print them to the terminal as well.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)


def _serial(client: AsyncModbusSerialClient) -> Any:
    """Return the pyserial port inside the client."""
    return client.ctx.transport.sync_serial  # type: ignore[attr-defined]


@dataclass(frozen=True, slots=True)
class ExpectedResponse:
    """The first two bytes of a response and its size, checksum included."""

    head: bytes
    size: int


class ModbusConnection:
    """Reads and writes 16-bit registers of one slave. A call must not be cancelled once it has begun.

    Each call has a `deadline_s` on the loop's clock. A request that could end later is not sent: DeviceTimeout.
    probe_address: two registers that may be read at any time to check the line.
    """

    def __init__(self, name: str, port: str, slave_id: int, timeout_s: float, probe_address: int) -> None:
        self._name = name
        self._port = port
        self._slave_id = slave_id
        self._timeout_s = timeout_s
        self._probe_address = probe_address
        self._probe_sizes = cycle((1, 2))
        self._client: AsyncModbusSerialClient | None = None
        self._lock = asyncio.Lock()
        self._free_at_s = 0.0
        self._out_of_sync = False
        self._silent_since_s = 0.0
        """When the line went out of sync, or when the last byte after that arrived."""
        self._expected: ExpectedResponse | None = None
        self._received = b""
        """Bytes that have arrived since the current request."""
        self._holders: set[int] = set()
        """Processes that held the port at the last attempt to open it."""
        self._search_holders_at_s = -math.inf

    @property
    def connected(self) -> bool:
        """Whether the port is open; the gripper may still be silent."""
        return self._client is not None and self._client.connected

    async def connect(self) -> None:
        """Open the port for exclusive use. Raises DeviceLost with the reason, or the program that holds it.

        Neither a lock nor exclusive use excludes a program that opened the port before without a lock, and two masters
        could open a grip. So other programs are searched before anything is sent; see `serial_port.other_holders`.
        """
        self.close()
        if self._holders:
            self._holders = await asyncio.to_thread(serial_port.other_holders, self._port, self._holders)
            if self._holders:
                raise self._not_exclusive()
        client = AsyncModbusSerialClient(
            self._port, baudrate=BAUD, timeout=self._timeout_s, retries=0, reconnect_delay=0, trace_packet=self._filter
        )
        client.set_max_no_responses(1_000_000)  # our caller handles a silent gripper, not pymodbus
        if not await client.connect():
            raise DeviceLost(f"{self._name}: {self._port} cannot be opened: {await self._why_not_opened()}")
        try:
            # Callbacks of the next two loop cycles set up its reader; closing before them raises inside pymodbus.
            await asyncio.sleep(0)
            await asyncio.sleep(0)
            raise_if_cancelled()
            fd = _serial(client).fileno()
            serial_port.lock_out_others(fd)  # before the search, so that no program opens the port after it
            serial_port.request_low_latency(fd)
            self._holders = await asyncio.to_thread(serial_port.other_holders, self._port)
            if self._holders:
                await asyncio.sleep(BRIEF_USE_S)
                self._holders = await asyncio.to_thread(serial_port.other_holders, self._port, self._holders)
            if self._holders:
                raise self._not_exclusive()
        except BaseException:  # includes a cancelled search
            client.close()
            raise
        self._lose_sync()  # the previous user of the port may have left a request that is still to be answered
        self._client = client

    def close(self) -> None:
        """Close the port. Idempotent."""
        if self._client is not None:
            self._client.close()
            self._client = None

    async def read(self, address: int, count: int, deadline_s: float) -> list[int]:
        """Read input registers (function 4). Raises DeviceTimeout or DeviceLost."""
        async with self._lock:
            await self._prepare_request(deadline_s)
            return await self._read(address, count)

    async def write(self, address: int, values: list[int], deadline_s: float) -> None:
        """Write holding registers (function 16). After DeviceTimeout or DeviceLost, what was written is unknown."""
        async with self._lock:
            await self._prepare_request(deadline_s)
            response = await self._send(
                ExpectedResponse(bytes([self._slave_id, WRITE]), 8),
                lambda client: client.write_registers(address, values, device_id=self._slave_id),
            )
            if type(response) is not WriteMultipleRegistersResponse:
                raise self._wrong_response(f"{type(response).__name__} in response to a write")
            if (response.address, response.count) != (address, len(values)):
                raise self._wrong_response(
                    f"a response for {response.count} registers at 0x{response.address:04X} instead of {len(values)} "
                    f"at 0x{address:04X}"
                )

    async def _why_not_opened(self) -> str:
        if fault := serial_port.device_fault(self._port):
            return fault
        now_s = asyncio.get_running_loop().time()
        if now_s >= self._search_holders_at_s:
            self._search_holders_at_s = now_s + HOLDERS_PERIOD_S
            self._holders = await asyncio.to_thread(serial_port.other_holders, self._port)
        return serial_port.holders_text(self._holders)

    def _not_exclusive(self) -> DeviceLost:
        return DeviceLost(f"{self._name}: {self._port} is not used: {serial_port.holders_text(self._holders)}")

    async def _read(self, address: int, count: int) -> list[int]:
        response = await self._send(
            ExpectedResponse(bytes([self._slave_id, READ]), 5 + 2 * count),
            lambda client: client.read_input_registers(address, count=count, device_id=self._slave_id),
        )
        if type(response) is not ReadInputRegistersResponse or len(response.registers) != count:
            raise self._wrong_response(f"{type(response).__name__} in response to a read of {count} registers")
        return list(response.registers)

    async def _prepare_request(self, deadline_s: float) -> None:
        """Keep the distance between requests, and synchronize the line if necessary."""
        await self._wait_until_free()
        if self._has_unread():
            self._lose_sync()
        if self._out_of_sync:
            while (left_s := self._silence_left_s()) > 0.0:
                self._check_time(left_s + 2.0 * self._timeout_s, deadline_s)
                await asyncio.sleep(left_s)
            self._out_of_sync = False
            await self._read(self._probe_address, next(self._probe_sizes))
            await self._wait_until_free()
            if self._out_of_sync or self._has_unread():
                raise self._wrong_response("more bytes arrived than were requested")
        self._check_time(self._timeout_s, deadline_s)

    def _silence_left_s(self) -> float:
        """Return how long the line must still be silent; bytes that arrived during a late loop cycle are unread."""
        if self._has_unread():
            self._lose_sync()
        return self._silent_since_s + SILENCE_S - asyncio.get_running_loop().time()

    def _check_time(self, needed_s: float, deadline_s: float) -> None:
        if asyncio.get_running_loop().time() + needed_s > deadline_s:
            raise DeviceTimeout(
                f"{self._name}: {self._port} is too slow or never silent; check whether another master uses the line"
            )

    async def _wait_until_free(self) -> None:
        await asyncio.sleep(self._free_at_s - asyncio.get_running_loop().time())

    def _has_unread(self) -> bool:
        """Return whether bytes that were not requested wait in the port."""
        try:
            return self._client is not None and self._client.connected and bool(_serial(self._client).in_waiting)
        except OSError:  # just unplugged; the next request reports it
            return False

    async def _send(
        self, expected: ExpectedResponse, request: Callable[[AsyncModbusSerialClient], Awaitable[ModbusPDU]]
    ) -> ModbusPDU:
        loop = asyncio.get_running_loop()
        client = self._client
        if client is None or not client.connected:
            raise self._connection_lost()
        self._free_at_s = loop.time() + REQUEST_PERIOD_S
        self._expected, self._received = expected, b""
        try:
            return await request(client)
        except ConnectionException:
            raise self._connection_lost() from None
        except (ModbusException, OSError):
            self._lose_sync()
            if not client.connected:
                raise self._connection_lost() from None
            if self._received:
                raise self._wrong_response(f"{self._received[:16].hex(' ')} is not a complete response") from None
            raise DeviceTimeout(
                f"{self._name}: no response within {self._timeout_s * 1000:.0f} ms from slave {self._slave_id} on "
                f"{self._port}; check the gripper's power and the cable"
            ) from None
        finally:
            self._expected = None
            self._free_at_s = max(self._free_at_s, loop.time() + PAUSE_S)

    def _filter(self, sending: bool, data: bytes) -> bytes:
        """Pass on bytes that begin like the expected response, as soon as it is complete.

        Any other byte puts the line out of sync. data: all bytes since the request.
        """
        if sending:
            return data
        expected = self._expected
        if expected is None:
            self._lose_sync()
            return b""
        self._received = data
        head = data[: len(expected.head)]
        if head != expected.head[: len(head)] or len(data) > expected.size:
            self._lose_sync()
        complete = head == expected.head and len(data) >= expected.size
        return data[: expected.size] if complete else b""

    def _lose_sync(self) -> None:
        self._out_of_sync = True
        self._silent_since_s = asyncio.get_running_loop().time()

    def _connection_lost(self) -> DeviceLost:
        self.close()
        return DeviceLost(f"{self._name}: the connection on {self._port} is gone; open it again")

    def _wrong_response(self, what: str) -> DeviceTimeout:
        self._lose_sync()
        return DeviceTimeout(f"{self._name}: {what}; check the cable")
