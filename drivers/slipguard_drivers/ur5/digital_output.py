"""A pulse on one of the robot's standard digital outputs, over RTDE.

The output is claimed only while the pulse lasts: RTDE gives it to one client at a time, and a program that is started
later, such as a ROS driver, must find it free. No script is uploaded and no register is written.
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
REPORT_TIMEOUT_S = 0.3


class DigitalOutput:
    """One output of one robot. number: 0 to 7."""

    def __init__(self, name: str, host: str, number: int, pulse_s: float) -> None:
        self._name, self._host, self._number, self._pulse_s = name, host, number, pulse_s
        self._pulse: asyncio.Task[None] | None = None
        self._end_now = asyncio.Event()
        self._left_high: str | None = None

    async def check(self) -> None:
        """Raise CommandRefused if another client holds the output, or DeviceLost."""
        connection, _ = await self._claim()
        connection.close()

    async def pulse(self) -> None:
        """Set the output high, and low again after the pulse; return when the controller reports it high.

        Does nothing during a pulse.

        Raises:
            CommandRefused: if another client holds it, or if it is high already, so that a pulse has no effect.
            DeviceLost: if the controller does not report it high.
        """
        if self._pulse is not None and not self._pulse.done():
            return
        connection, recipe = await self._claim()
        try:
            if await self._is_high(connection):
                raise CommandRefused(
                    f"{self._name}: digital output {self._number} is high already, so a pulse has no effect; "
                    "find the program that holds it high"
                )
            await self._set(connection, recipe, high=True)
        except BaseException:
            connection.close()
            raise
        self._end_now.clear()
        self._pulse = asyncio.create_task(self._end_pulse(connection, recipe), name=f"{self._name}: output pulse")

    def raise_if_left_high(self) -> None:
        """Raise DeviceLost, once, if a pulse could not be ended."""
        if self._left_high is not None:
            reason, self._left_high = self._left_high, None
            raise DeviceLost(reason)

    async def close(self) -> None:
        """End a pulse. Never raises."""
        if self._pulse is not None:
            self._end_now.set()
            await asyncio.wait([self._pulse])
            self._pulse = None

    async def _claim(self) -> tuple[RtdeConnection, int]:
        connection = await RtdeConnection.connect(self._name, self._host)
        try:
            await connection.request_outputs(OUTPUTS)
            recipe = await connection.claim_inputs(INPUTS)
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
            async with asyncio.timeout(REPORT_TIMEOUT_S):
                while await self._reported_high(connection) != high:
                    pass
        except TimeoutError:
            raise DeviceLost(
                f"{self._name}: digital output {self._number} does not become {'high' if high else 'low'} within "
                f"{REPORT_TIMEOUT_S:g} s; check the robot"
            ) from None

    async def _is_high(self, connection: RtdeConnection) -> bool:
        try:
            async with asyncio.timeout(REPORT_TIMEOUT_S):
                return await self._reported_high(connection)
        except TimeoutError:
            raise DeviceLost(
                f"{self._name}: no report of digital output {self._number} within {REPORT_TIMEOUT_S:g} s; check it"
            ) from None

    async def _reported_high(self, connection: RtdeConnection) -> bool:
        data = await connection.receive()
        if len(data) != LAYOUT.size:
            raise DeviceLost(
                f"{self._name}: {len(data)} bytes of digital outputs instead of {LAYOUT.size}; update the controller"
            )
        return bool(LAYOUT.unpack(data)[0] >> self._number & 1)

    async def _end_pulse(self, connection: RtdeConnection, recipe: int) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._pulse_s):
                await self._end_now.wait()
        try:
            await self._set_low(connection, recipe)
        except DeviceError:  # an output keeps its value when the connection is lost
            try:
                await self._set_low(*await self._claim())
            except (DeviceError, CommandRefused) as error:
                self._left_high = (
                    f"{self._name}: digital output {self._number} may still be high after its pulse ({error}); "
                    "set it low at the panel"
                )

    async def _set_low(self, connection: RtdeConnection, recipe: int) -> None:
        try:
            await self._set(connection, recipe, high=False)
        finally:
            connection.close()
