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
RATE_HZ = 125.0
SEEN_S = 0.3


class DigitalOutput:
    """One output of one robot. number: 0 to 7."""

    def __init__(self, name: str, host: str, number: int, pulse_s: float) -> None:
        self._name, self._host, self._number, self._pulse_s = name, host, number, pulse_s
        self._pulse: asyncio.Task[None] | None = None

    async def check(self) -> None:
        """Whether it could be set now. Raises CommandRefused naming who may hold it, or DeviceLost."""
        connection, _ = await self._take()
        connection.close()

    async def pulse(self) -> None:
        """Set it high, and low again after the pulse; returns when the controller reports it high.

        Within a pulse nothing more happens. Raises as `check`, and DeviceLost where it does not become high.
        """
        if self._pulse is not None and not self._pulse.done():
            return
        connection, recipe = await self._take()
        try:
            await self._set(connection, recipe, high=True)
        except BaseException:
            connection.close()
            raise
        self._pulse = asyncio.create_task(self._end(connection, recipe), name=f"{self._name}: output pulse")

    async def close(self) -> None:
        """End a pulse that is on. Never raises."""
        if self._pulse is not None:
            self._pulse.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._pulse
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
                while bool(struct.unpack(">Q", await connection.data())[0] & mask) != high:
                    pass
        except TimeoutError:
            raise DeviceLost(
                f"{self._name}: digital output {self._number} does not become {'high' if high else 'low'}"
            ) from None

    async def _end(self, connection: RtdeConnection, recipe: int) -> None:
        try:
            with contextlib.suppress(asyncio.CancelledError):
                await asyncio.sleep(self._pulse_s)
            with contextlib.suppress(DeviceError, struct.error):
                await self._set(connection, recipe, high=False)
        finally:
            connection.close()
