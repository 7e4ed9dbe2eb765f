"""Watches an arm: its place, speed, program and safety state, as the controller tells them, and how old they are.

The only source of state in both modes. It takes no inputs and starts nothing, so it disturbs nobody.
"""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass

from slipguard.cancellation import cancel_and_wait
from slipguard.devices import ArmState
from slipguard.errors import DeviceLost, DeviceTimeout
from slipguard_drivers.ur5.rtde import ANSWER_S, RtdeConnection

VARIABLES = (
    ("timestamp", "DOUBLE"),
    ("actual_TCP_pose", "VECTOR6D"),
    ("actual_TCP_speed", "VECTOR6D"),
    ("runtime_state", "UINT32"),
    ("safety_status_bits", "UINT32"),
    ("robot_mode", "INT32"),
)
LAYOUT = struct.Struct(">d6d6dIIi")
RATE_HZ = 125.0
"""Both series can: all a CB3 controller has, a quarter of what an e-Series has."""
STALE_S = 0.2
"""A state older than this is no state: 25 packets."""
NOW_S = 0.05
"""A program that rested longer ago may have been started again."""
PROTECTIVE = 1 << 2 | 1 << 4
"""Protective stop, safeguard stop."""
EMERGENCY = 1 << 5 | 1 << 6 | 1 << 7 | 1 << 8 | 1 << 9
"""System, robot and emergency stop, safety violation, safety fault."""
MOVING_M_S = 0.0005
ROTATING_RAD_S = 0.01
STOPPED, PLAYING, PAUSED = 1, 2, 4
"""`runtime_state`: 0 stopping, 1 stopped, 2 playing, 3 pausing, 4 paused, 5 resuming."""
RUNNING = 7
MODES = {
    -1: "no controller",
    0: "disconnected",
    1: "confirm safety",
    2: "booting",
    3: "power off",
    4: "power on",
    5: "idle, brakes on",
    6: "backdrive",
    7: "running",
    8: "updating firmware",
}
"""`robot_mode` in words."""


@dataclass(frozen=True, slots=True)
class RobotState:
    """One packet. timestamp_s: the controller's clock. pose: m and rad; velocity: m/s and rad/s, base frame."""

    timestamp_s: float
    pose: tuple[float, ...]
    velocity: tuple[float, ...]
    runtime: int
    safety_bits: int
    mode: int
    received_at_s: float

    @property
    def protective(self) -> bool:
        """A protective or safeguard stop is active."""
        return bool(self.safety_bits & PROTECTIVE)

    @property
    def emergency(self) -> bool:
        """An emergency stop is active, or the safety system has found a fault."""
        return bool(self.safety_bits & EMERGENCY)

    @property
    def moving(self) -> bool:
        """The tool moves or turns."""
        speed_m_s, rotation_rad_s = math.hypot(*self.velocity[:3]), math.hypot(*self.velocity[3:])
        return speed_m_s > MOVING_M_S or rotation_rad_s > ROTATING_RAD_S


class StateMonitor:
    """From `open` to `close` or `lost`. on_lost: called once, at once, with why nothing is seen any more."""

    def __init__(
        self, name: str, host: str, rate_hz: float = RATE_HZ, on_lost: Callable[[str], None] = lambda why: None
    ) -> None:
        self._name, self._host, self._rate_hz, self._on_lost = name, host, rate_hz, on_lost
        self._connection: RtdeConnection | None = None
        self._reading: asyncio.Task[None] | None = None
        self._found_at_m = 0.0
        self._newest: RobotState | None = None
        self.lost: str | None = None
        """Why nothing is seen any more; None while the connection is there."""
        self.packets = 0
        """How many came since `open`."""
        self.stopped_at_s = -math.inf
        """When no program was last seen to run."""

    @property
    def version(self) -> tuple[int, ...]:
        """Of the controller's software. Known after `open`."""
        return self._connection.version if self._connection is not None else (0, 0, 0, 0)

    @property
    def newest(self) -> RobotState:
        """The newest packet, however old. Raises DeviceLost before `open`, after `close` and when lost."""
        if self.lost is not None:
            raise DeviceLost(self.lost)
        if self._newest is None:
            raise DeviceLost(f"{self._name}: the connection is not open; open it first")
        return self._newest

    async def open(self) -> None:
        """Connect and wait for the first packet; heights count from where it finds the tool."""
        await self.close()
        connection = await RtdeConnection.connect(self._name, self._host)
        try:
            await connection.outputs(VARIABLES, self._rate_hz)
            await connection.start()
            async with asyncio.timeout(ANSWER_S):
                first = self._decode(await connection.data())
        except TimeoutError:
            connection.close()
            raise DeviceLost(f"{self._name}: {self._host} sends no RTDE data") from None
        except BaseException:
            connection.close()
            raise
        self._connection, self._newest, self.lost, self.packets = connection, first, None, 1
        self._found_at_m = first.pose[2]
        self._reading = asyncio.create_task(self._read(connection), name=f"{self._name}: state monitor")

    def fresh(self) -> RobotState:
        """The newest packet, which is not old. Raises DeviceTimeout if it is, DeviceLost as `newest`."""
        newest = self.newest
        if self.age_s > STALE_S:
            raise DeviceTimeout(f"{self._name}: no new state from the controller for {self.age_s * 1000:.0f} ms")
        return newest

    def runtime_now(self) -> int | None:
        """`runtime_state`; None where it is not known to be that of this very moment."""
        try:
            return self.newest.runtime if self.age_s < NOW_S else None
        except DeviceLost:
            return None

    @property
    def age_s(self) -> float:
        """Since the controller's clock last advanced. Raises DeviceLost as `newest`."""
        return asyncio.get_running_loop().time() - self.newest.received_at_s

    def state(self, *, travelling: bool = False) -> ArmState:
        """What is seen, for the port; raises as `fresh`. travelling: a motion is known to be under way."""
        state = self.fresh()
        return ArmState(
            height_mm=(state.pose[2] - self._found_at_m) * 1000.0,
            speed_mm_s=state.velocity[2] * 1000.0,
            moving=travelling or state.moving,
            protective_stop=state.protective,
            emergency_stop=state.emergency,
            measured_at_s=state.received_at_s,
        )

    async def close(self) -> None:
        """Disconnect. Never raises; idempotent."""
        reading, self._reading = self._reading, None
        await cancel_and_wait(reading)
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        self._newest, self.lost = None, None

    async def _read(self, connection: RtdeConnection) -> None:
        try:
            while True:
                state = self._decode(await connection.data())
                self.packets += 1
                if state.runtime == STOPPED:
                    self.stopped_at_s = state.received_at_s
                before = self._newest
                if before is not None and state.timestamp_s < before.timestamp_s:
                    raise DeviceLost(f"{self._name}: the controller has started anew; open the arm again")
                if before is None or state.timestamp_s > before.timestamp_s:
                    self._newest = state
        except DeviceLost as error:
            self.lost = str(error)
            connection.close()
            self._on_lost(self.lost)

    def _decode(self, data: bytes) -> RobotState:
        if len(data) != LAYOUT.size:
            raise DeviceLost(f"{self._name}: {len(data)} bytes of RTDE data in place of {LAYOUT.size}; open it again")
        stamp_s, *numbers, runtime, bits, mode = LAYOUT.unpack(data)
        if not all(map(math.isfinite, (stamp_s, *numbers))):
            raise DeviceLost(f"{self._name}: the controller tells no finite pose; open it again")
        now_s = asyncio.get_running_loop().time()
        return RobotState(stamp_s, tuple(numbers[:6]), tuple(numbers[6:]), runtime, bits, mode, now_s)
