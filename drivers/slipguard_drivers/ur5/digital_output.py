"""A pulse on one of the robot's standard digital outputs, over RTDE.

The output is taken for the length of the pulse only: RTDE gives it to one client at a time, and a program that is
started later, such as a ROS driver, must find it free. No script is uploaded and no register is touched.
"""

from __future__ import annotations

import asyncio
import contextlib
import struct

from slipguard.errors import CommandRefused, DeviceError, DeviceLost
from slipguard_drivers.ur5.rtde import RtdeConnection

INPUTS = ("standard_digital_output_mask", "standard_digital_output")
OUTPUTS = (("actual_digital_output_bits", "UINT64"),)
LAYOUT = struct.Struct(">Q")
RATE_HZ = 125.0
SEEN_S = 0.3


class DigitalOutput:
    """One output of one robot. number: 0 to 7."""

    def __init__(self, name: str, host: str, number: int, pulse_s: float) -> None:
        self._name, self._host, self._number, self._pulse_s = name, host, number, pulse_s
        self._pulse: asyncio.Task[None] | None = None
        self._enough = asyncio.Event()
        self.left_high: str | None = None
        """In words, that a pulse could not be ended; None where there is nothing to tell."""

    async def check(self) -> None:
        """Whether it could be set now. Raises CommandRefused naming who may hold it, or DeviceLost."""
        connection, _ = await self._take()
        connection.close()

    async def pulse(self) -> None:
        """Set it high, and low again after the pulse; returns when the controller reports it high.

        Within a pulse nothing more happens. Raises as `check`, CommandRefused where it is high already, which no
        program would take for a new order, and DeviceLost where it does not become high or is not told.
        """
        if self._pulse is not None and not self._pulse.done():
            return
        connection, recipe = await self._take()
        try:
            if await self._is_high(connection):
                raise CommandRefused(
                    f"{self._name}: digital output {self._number} is high already, and a pulse on it would not be "
                    "noticed; see what holds it high"
                )
            await self._set(connection, recipe, high=True)
        except BaseException:
            connection.close()
            raise
        self._enough.clear()
        self._pulse = asyncio.create_task(self._end(connection, recipe), name=f"{self._name}: output pulse")

    async def close(self) -> None:
        """End a pulse that is on. Never raises."""
        if self._pulse is not None:
            self._enough.set()
            await asyncio.wait([self._pulse])
            self._pulse = None

    async def _take(self) -> tuple[RtdeConnection, int]:
        connection = await RtdeConnection.connect(self._name, self._host)
        try:
            await connection.outputs(OUTPUTS, RATE_HZ)
            recipe = await connection.inputs(INPUTS)
            await connection.start()
        except CommandRefused as error:
            connection.close()
            raise CommandRefused(f'{error}; or use stop_by = "dashboard_pause"') from None
        except BaseException:
            connection.close()
            raise
        return connection, recipe

    async def _set(self, connection: RtdeConnection, recipe: int, *, high: bool) -> None:
        mask = 1 << self._number
        connection.send(recipe, struct.pack(">BB", mask, mask * high))
        try:
            async with asyncio.timeout(SEEN_S):
                while await self._told(connection) != high:
                    pass
        except TimeoutError:
            raise DeviceLost(
                f"{self._name}: digital output {self._number} does not become {'high' if high else 'low'}"
            ) from None

    async def _is_high(self, connection: RtdeConnection) -> bool:
        try:
            async with asyncio.timeout(SEEN_S):
                return await self._told(connection)
        except TimeoutError:
            raise DeviceLost(f"{self._name}: it is not told whether digital output {self._number} is high") from None

    async def _told(self, connection: RtdeConnection) -> bool:
        data = await connection.data()
        if len(data) != LAYOUT.size:
            raise DeviceLost(f"{self._name}: {len(data)} bytes of digital outputs in place of {LAYOUT.size}")
        return bool(LAYOUT.unpack(data)[0] >> self._number & 1)

    async def _end(self, connection: RtdeConnection, recipe: int) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._pulse_s):
                await self._enough.wait()
        try:
            await self._low(connection, recipe)
        except DeviceError:
            # What a lost connection has set stays set.
            try:
                await self._low(*await self._take())
            except (DeviceError, CommandRefused) as error:
                self.left_high = (
                    f"{self._name}: digital output {self._number} may still be high after its pulse ({error}); "
                    "set it low at the panel"
                )

    async def _low(self, connection: RtdeConnection, recipe: int) -> None:
        try:
            await self._set(connection, recipe, high=False)
        finally:
            connection.close()
