"""An RTDE client such as a ROS driver runs: its own recipes, its own inputs, one answer to every packet."""

from __future__ import annotations

import asyncio
import contextlib
import struct

OUTPUTS = (
    "timestamp,actual_q,actual_qd,speed_scaling,target_speed_fraction,runtime_state,actual_TCP_force,actual_TCP_pose,"
    "target_TCP_pose,actual_digital_input_bits,actual_digital_output_bits,standard_analog_input0,robot_mode,"
    "safety_mode,robot_status_bits,safety_status_bits,actual_current"
)
INPUTS = "speed_slider_mask,speed_slider_fraction,standard_digital_output_mask,standard_digital_output"


class RosLikeClient:
    """From `start` to `stop`. Slider and outputs are its own; it sends the slider back with every packet."""

    def __init__(self, host: str, rate_hz: float = 125.0) -> None:
        self._host, self._rate_hz = host, rate_hz
        self.packets = 0
        self.longest_gap_s = 0.0
        self.ended: str | None = None
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> None:
        """Connect and take the inputs. Raises ConnectionError naming what another program holds."""
        self._reader, self._writer = await asyncio.open_connection(self._host, 30004)
        try:
            assert await self._ask(b"V", struct.pack(">H", 2)) == b"\x01"
            await self._ask(b"O", struct.pack(">d", self._rate_hz) + OUTPUTS.encode())
            taken = await self._ask(b"I", INPUTS.encode())
            if b"IN_USE" in taken:
                raise ConnectionError(taken[1:].decode())
            self._recipe = taken[0]
            assert await self._ask(b"S", b"") == b"\x01"
        except BaseException:
            self._writer.transport.abort()
            raise
        self._task = asyncio.create_task(self._run(), name="ROS-like client")

    async def stop(self) -> None:
        """Hang up."""
        if self._task is not None:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task
        self._writer.transport.abort()

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        last_s = loop.time()
        try:
            while True:
                await self._message()
                self.packets += 1
                self.longest_gap_s, last_s = max(self.longest_gap_s, loop.time() - last_s), loop.time()
                values = struct.pack(">IdBB", 1, 1.0, 0, 0)
                self._writer.write(struct.pack(">HcB", 4 + len(values), b"U", self._recipe) + values)
        except (asyncio.IncompleteReadError, OSError) as error:
            self.ended = repr(error)

    async def _ask(self, kind: bytes, payload: bytes) -> bytes:
        self._writer.write(struct.pack(">Hc", 3 + len(payload), kind) + payload)
        while True:
            answered, answer = await self._message()
            if answered == kind:
                return answer

    async def _message(self) -> tuple[bytes, bytes]:
        size, kind = struct.unpack(">Hc", await self._reader.readexactly(3))
        return kind, await self._reader.readexactly(size - 3)
