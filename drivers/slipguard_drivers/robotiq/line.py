"""Modbus RTU to the gripper's registers: the one user of pymodbus.

Modbus RTU has no transaction number, and pymodbus does not compare function codes: after a time-out, a late answer
would be taken for the answer to the next request, and stay one behind for as long as the other side is slow. So here
one request is on the line at a time, its answer is checked for kind and size, and after anything but a good answer
the line is kept silent until whatever is late must have come.
"""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Awaitable, Callable

from pymodbus.client import AsyncModbusSerialClient
from pymodbus.exceptions import ConnectionException, ModbusException
from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.register_message import ReadInputRegistersResponse, WriteMultipleRegistersResponse

from slipguard.errors import DeviceLost, DeviceTimeout

BAUD = 115200
SPACING_S = 0.005
"""From one request to the next: the manual's minimum."""
SILENCE_S = 0.1
"""After a time-out; the slowest adapter (16 ms latency timer) with the slowest gripper answers well within it."""

# What goes wrong is told by our own errors; pymodbus would print it to the terminal as well.
logging.getLogger("pymodbus").setLevel(logging.CRITICAL)


class RegisterLine:
    """Reads and writes 16-bit registers of one slave. A call that was begun must not be cancelled."""

    def __init__(self, name: str, port: str, slave_id: int, timeout_s: float) -> None:
        self._name = name
        self._port = port
        self._slave_id = slave_id
        self._timeout_s = timeout_s
        self._client: AsyncModbusSerialClient | None = None
        self._turn = asyncio.Lock()
        self._quiet_until_s = 0.0

    @property
    def connected(self) -> bool:
        """Whether the port is open; a gripper behind it may still be silent."""
        return self._client is not None and self._client.connected

    async def connect(self) -> None:
        """Open the port for us alone. Raises DeviceLost with what is wrong with it."""
        self.close()
        client = AsyncModbusSerialClient(
            self._port, baudrate=BAUD, timeout=self._timeout_s, retries=0, reconnect_delay=0
        )
        client.set_max_no_responses(1_000_000)  # a silent gripper is our caller's business, not pymodbus's
        if not await client.connect():
            raise DeviceLost(f"{self._name}: {self._port} cannot be opened: {_what_is_wrong(self._port)}")
        self._client = client
        # Its reader is set up by callbacks of the next two turns of the loop; closing before them trips it.
        await asyncio.sleep(0)
        await asyncio.sleep(0)

    def close(self) -> None:
        """Let go of the port. Idempotent."""
        if self._client is not None:
            self._client.close()
            self._client = None

    async def read(self, address: int, count: int) -> list[int]:
        """Read input registers (FC 4). Raises DeviceTimeout, DeviceLost."""
        answer = await self._ask(
            lambda client: client.read_input_registers(address, count=count, device_id=self._slave_id)
        )
        if type(answer) is not ReadInputRegistersResponse or len(answer.registers) != count:
            raise self._confused(answer)
        return list(answer.registers)

    async def write(self, address: int, values: list[int]) -> None:
        """Write holding registers (FC 16). Raises DeviceTimeout, DeviceLost."""
        answer = await self._ask(lambda client: client.write_registers(address, values, device_id=self._slave_id))
        if (
            type(answer) is not WriteMultipleRegistersResponse
            or answer.address != address
            or answer.count != len(values)
        ):
            raise self._confused(answer)

    async def _ask(self, request: Callable[[AsyncModbusSerialClient], Awaitable[ModbusPDU]]) -> ModbusPDU:
        async with self._turn:
            loop = asyncio.get_running_loop()
            await asyncio.sleep(self._quiet_until_s - loop.time())
            client = self._client
            if client is None or not client.connected:
                raise self._gone()
            self._quiet_until_s = loop.time() + SPACING_S
            try:
                return await request(client)
            except ConnectionException:
                raise self._gone() from None
            except (ModbusException, OSError):
                self._keep_silent()
                if not client.connected:
                    raise self._gone() from None
                raise DeviceTimeout(
                    f"{self._name}: no answer within {self._timeout_s * 1000:.0f} ms from slave {self._slave_id} on "
                    f"{self._port}; check the gripper's power and the cable"
                ) from None

    def _keep_silent(self) -> None:
        self._quiet_until_s = asyncio.get_running_loop().time() + SILENCE_S

    def _gone(self) -> DeviceLost:
        self.close()
        return DeviceLost(f"{self._name}: the connection on {self._port} is gone; open it again")

    def _confused(self, answer: ModbusPDU) -> DeviceTimeout:
        self._keep_silent()
        return DeviceTimeout(
            f"{self._name}: {type(answer).__name__} answers another request than the last one; ask again"
        )


def _what_is_wrong(port: str) -> str:
    if not os.path.exists(port):
        return "there is no such device; plug the adapter in, `ls /dev/serial/by-id` shows those there are"
    if not os.access(port, os.R_OK | os.W_OK):
        return "access is denied; the user must be in the group dialout"
    return "it is no serial port, or another program has it open"
