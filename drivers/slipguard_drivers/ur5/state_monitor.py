"""Receives an arm's state over RTDE: pose, speed, program and safety state, and how old they are.

The only source of state in both modes. It claims no inputs and starts nothing, so no other program is disturbed.
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
from slipguard_drivers.ur5.mounting import MeasuredUp
from slipguard_drivers.ur5.rtde import RESPONSE_TIMEOUT_S, RtdeConnection

VARIABLES: tuple[tuple[str, str], ...] = (
    ("timestamp", "DOUBLE"),
    ("actual_TCP_pose", "VECTOR6D"),
    ("actual_TCP_speed", "VECTOR6D"),
    ("actual_q", "VECTOR6D"),
    ("actual_tool_accelerometer", "VECTOR3D"),
    ("runtime_state", "UINT32"),
    ("safety_status_bits", "UINT32"),
    ("robot_mode", "INT32"),
)
LAYOUT = struct.Struct(">d6d6d6d3dIIi")
REGISTERS = 3
"""How many output registers are received in addition, if any."""
STALE_S = 0.2
"""A state older than this is not used: 25 packets."""
UP_EVERY = 5
"""Up is measured in every fifth packet, 25 times per second."""
CURRENT_S = 0.05
"""A program that was stopped longer ago may have been started again."""
PROTECTIVE = 1 << 2 | 1 << 4 | 1 << 10
"""Protective stop, safeguard stop, stopped due to safety (such as a three-position switch that is not pressed)."""
EMERGENCY = 1 << 5 | 1 << 6 | 1 << 7 | 1 << 8 | 1 << 9
"""System, robot and emergency stop, safety violation, safety fault."""
MOVING_M_S = 0.0005
ROTATING_RAD_S = 0.01
STOPPED, PLAYING, PAUSING, PAUSED = 1, 2, 3, 4
"""`runtime_state`: 0 stopping, 1 stopped, 2 playing, 3 pausing, 4 paused, 5 resuming."""
RUNNING = 7
ROBOT_MODES = {
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
"""`robot_mode` as text."""


@dataclass(frozen=True, slots=True)
class RobotState:
    """One RTDE packet.

    Attributes:
        timestamp_s: the controller's clock.
        pose: x, y, z in m and rotation vector in rad, base frame.
        velocity: m/s and rad/s, base frame.
        joints: angles in rad.
        acceleration: of the tool in m/s2, with that of gravity; see `slipguard_drivers.ur5.mounting`.
        registers: output registers, which only a program on the controller writes; empty if not requested.
    """

    timestamp_s: float
    pose: tuple[float, ...]
    velocity: tuple[float, ...]
    joints: tuple[float, ...]
    acceleration: tuple[float, ...]
    runtime: int
    safety_bits: int
    mode: int
    received_at_s: float
    registers: tuple[float, ...] = ()

    @property
    def protective(self) -> bool:
        """Whether a stop is active that is no emergency stop: a protective or safeguard stop, or an enabling switch."""
        return bool(self.safety_bits & PROTECTIVE) and not self.emergency

    @property
    def emergency(self) -> bool:
        """Whether an emergency stop is active, or the safety system has found a fault."""
        return bool(self.safety_bits & EMERGENCY)

    @property
    def safety_stop(self) -> bool:
        """Whether any stop of the safety system is active."""
        return self.protective or self.emergency

    @property
    def moving(self) -> bool:
        """Whether the tool moves or rotates."""
        speed_m_s, rotation_rad_s = math.hypot(*self.velocity[:3]), math.hypot(*self.velocity[3:])
        return speed_m_s > MOVING_M_S or rotation_rad_s > ROTATING_RAD_S


class StateMonitor:
    """Receives states from `open` to `close`, or until the connection is lost.

    on_lost: called once with the reason. first_register: the first output register to receive; None for no registers.
    """

    def __init__(
        self,
        name: str,
        host: str,
        on_lost: Callable[[str], None] = lambda reason: None,
        first_register: int | None = None,
    ) -> None:
        self._name, self._host, self._on_lost = name, host, on_lost
        self._connection: RtdeConnection | None = None
        self._reading: asyncio.Task[None] | None = None
        self._variables, self._layout = VARIABLES, LAYOUT
        if first_register is not None:
            numbers = range(first_register, first_register + REGISTERS)
            self._variables += tuple((f"output_double_register_{number}", "DOUBLE") for number in numbers)
            self._layout = struct.Struct(f"{LAYOUT.format}{REGISTERS}d")
        self._zero_height_m = 0.0
        self._up = MeasuredUp()
        self._newest: RobotState | None = None
        self._lost: str | None = None
        self.packets = 0
        """Number of packets since `open`."""
        self.stopped_at_s = -math.inf
        """When a packet last said that no program runs."""
        self.safety_stop_at_s = -math.inf
        """When a packet last said that a safety stop is active."""

    @property
    def version(self) -> tuple[int, ...]:
        """Version of the controller's software; known after `open`."""
        return self._connection.version if self._connection is not None else (0, 0, 0, 0)

    @property
    def newest(self) -> RobotState:
        """The newest state, however old. Raises DeviceLost if the connection is not open or was lost."""
        if self._lost is not None:
            raise DeviceLost(self._lost)
        if self._newest is None:
            raise DeviceLost(f"{self._name}: the connection is not open; open it first")
        return self._newest

    @property
    def age_s(self) -> float:
        """Time since the controller's clock last advanced. Raises as `newest`."""
        return asyncio.get_running_loop().time() - self.newest.received_at_s

    @property
    def current_runtime(self) -> int | None:
        """`runtime_state` if it is at most `CURRENT_S` old, else None."""
        try:
            return self.newest.runtime if self.age_s < CURRENT_S else None
        except DeviceLost:
            return None

    async def open(self) -> None:
        """Connect and wait for the first packet; heights are relative to the tool's position in it."""
        await self.close()
        connection = await RtdeConnection.connect(self._name, self._host)
        try:
            await connection.request_outputs(self._variables)
            await connection.start()
            async with asyncio.timeout(RESPONSE_TIMEOUT_S):
                first = self._decode(await connection.receive())
        except TimeoutError:
            connection.close()
            raise DeviceLost(f"{self._name}: {self._host} sends no RTDE data; check the network cable") from None
        except BaseException:
            connection.close()
            raise
        self._connection, self._newest, self._lost, self.packets = connection, first, None, 1
        self._zero_height_m = first.pose[2]
        self._up = MeasuredUp()
        self._measure_up(first)
        self._reading = asyncio.create_task(self._read(connection), name=f"{self._name}: state monitor")

    def fresh(self) -> RobotState:
        """Return the newest state. Raises DeviceTimeout if it is too old, DeviceLost as `newest`."""
        newest = self.newest
        if self.age_s > STALE_S:
            raise DeviceTimeout(
                f"{self._name}: no new state from the controller for {self.age_s * 1000:.0f} ms; check its cable"
            )
        return newest

    def arm_state(self, *, command_running: bool = False) -> ArmState:
        """Return the state for the port; raises as `fresh`. command_running: a motion is known to be under way."""
        state = self.fresh()
        return ArmState(
            height_mm=(state.pose[2] - self._zero_height_m) * 1000.0,
            speed_mm_s=state.velocity[2] * 1000.0,
            moving=command_running or state.moving,
            protective_stop=state.protective,
            emergency_stop=state.emergency,
            measured_at_s=state.received_at_s,
            position_mm=(state.pose[0] * 1000.0, state.pose[1] * 1000.0, state.pose[2] * 1000.0),
            orientation_rad=(state.pose[3], state.pose[4], state.pose[5]),
            up=self._up.direction,
        )

    async def close(self) -> None:
        """Disconnect. Never raises; idempotent."""
        reading, self._reading = self._reading, None
        await cancel_and_wait(reading)
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        self._newest, self._lost = None, None

    async def _read(self, connection: RtdeConnection) -> None:
        try:
            while True:
                state = self._decode(await connection.receive())
                self.packets += 1
                if state.runtime == STOPPED:
                    self.stopped_at_s = state.received_at_s
                if state.safety_stop:
                    self.safety_stop_at_s = state.received_at_s
                before = self._newest
                if before is not None and state.timestamp_s < before.timestamp_s:
                    raise DeviceLost(f"{self._name}: the controller was restarted; open the arm again")
                if before is None or state.timestamp_s > before.timestamp_s:
                    self._newest = state
                    if self.packets % UP_EVERY == 0:
                        self._measure_up(state)
        except DeviceLost as error:
            self._lost = str(error)
            connection.close()
            self._on_lost(self._lost)

    def _measure_up(self, state: RobotState) -> None:
        if not state.moving:  # in motion, the accelerometer reads the motion, too
            self._up.add(state.joints, state.acceleration)

    def _decode(self, data: bytes) -> RobotState:
        size = self._layout.size
        if len(data) != size:
            raise DeviceLost(f"{self._name}: {len(data)} bytes of RTDE data instead of {size}; open it again")
        timestamp_s, *numbers, runtime, bits, mode = LAYOUT.unpack_from(data)
        registers = struct.unpack_from(f">{(size - LAYOUT.size) // 8}d", data, LAYOUT.size)
        if not all(map(math.isfinite, (timestamp_s, *numbers))):
            raise DeviceLost(f"{self._name}: the controller sends a number that is not finite; open it again")
        now_s = asyncio.get_running_loop().time()
        pose, velocity, joints = (tuple(numbers[start : start + 6]) for start in (0, 6, 12))
        acceleration = tuple(numbers[18:])
        return RobotState(timestamp_s, pose, velocity, joints, acceleration, runtime, bits, mode, now_s, registers)
