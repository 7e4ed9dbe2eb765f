"""How the driver reaches the gripper: the status it reads, the commands it writes, and how long both take.

There are three ways: a serial adapter of this computer, the RS-485 forwarder on the robot (both Modbus RTU, `modbus`),
and Robotiq's URCap on the robot (`urcap`). A round trip through the robot takes several times as long as one through a
USB adapter, and differs from cell to cell. So it is measured at each connection, and the time-out follows from it.
"""

from __future__ import annotations

import asyncio
import statistics
from abc import ABC, abstractmethod
from collections.abc import Iterator

from slipguard.diagnosis import CheckResult
from slipguard.errors import DeviceTimeout
from slipguard_drivers.robotiq.registers import RobotiqCommand, RobotiqStatus

READS_AT_START = 8
UNMEASURED_TIMEOUT_S = 0.25
"""Time-out of the first responses."""
FIRST_TIMEOUTS = 8.0
"""The first statuses may take this many time-outs: the line may have to be brought in step."""
TIMEOUT_TRIPS = 4.0
"""A response may take this many usual round trips: jitter of a network and of the robot's controller."""
DEAD_TIME_S = 0.04
"""From a command in the gripper to the first change of the force: 20 to 60 ms."""


class GripperTransport(ABC):
    """Status and commands of one gripper. Calls wait for each other; a call must not be cancelled once it has begun.

    Each call has a `deadline_s` on the loop's clock. A request that could end later is not sent: DeviceTimeout.

    timeout_s: least time-out of a response.
    """

    requests_per_read = 1
    """Requests for one status; a command is one request."""
    settle_s = 0.0
    """Time that a command must have been accepted before it is certain that the gripper has executed it."""

    def __init__(self, timeout_s: float) -> None:
        self._timeout_min_s = timeout_s
        self.timeout_s = timeout_s
        """Time-out of one response."""
        self.read_s: float | None = None
        """Usual time of one status; None before it was measured."""

    @property
    @abstractmethod
    def connected(self) -> bool:
        """Whether the connection is open, for this program alone where that can be known."""

    @abstractmethod
    async def connect(self) -> None:
        """Connect. Raises DeviceLost with the reason."""

    @abstractmethod
    def close(self) -> None:
        """Begin to disconnect. Idempotent."""

    @abstractmethod
    async def closed(self) -> None:
        """Wait until disconnected, but not for a wedged adapter."""

    @abstractmethod
    async def read_status(self, deadline_s: float) -> RobotiqStatus:
        """Read the status. Raises DeviceTimeout or DeviceLost."""

    @abstractmethod
    async def write_command(self, command: RobotiqCommand, deadline_s: float) -> None:
        """Write a command. After DeviceTimeout or DeviceLost, what the gripper has received is unknown."""

    @abstractmethod
    def diagnose(self) -> Iterator[CheckResult]:
        """Check the wiring for `slipguard doctor`, without connecting."""

    @property
    def force_latency_s(self) -> float | None:
        """Return the time from a tightening that is requested to the first change of the force; None: not measured.

        It is two statuses, two commands of which the second need not be answered, and the gripper's dead time.
        """
        if self.read_s is None:
            return None
        return 2.0 * self.read_s + 1.5 * self.read_s / self.requests_per_read + self.settle_s + DEAD_TIME_S

    async def measure(self) -> None:
        """Measure the round trip and set the time-out. Raises DeviceTimeout if the gripper does not respond at all."""
        loop = asyncio.get_running_loop()
        self.read_s, self.timeout_s = None, max(self._timeout_min_s, UNMEASURED_TIMEOUT_S)
        await self.read_status(
            loop.time() + FIRST_TIMEOUTS * self.timeout_s
        )  # brings the line in step, which takes long
        times_s: list[float] = []
        for _ in range(READS_AT_START):
            begun_s = loop.time()
            try:
                await self.read_status(begun_s + FIRST_TIMEOUTS * self.timeout_s)
            except DeviceTimeout:
                if not times_s:
                    raise
                break
            times_s.append(loop.time() - begun_s)
            self.read_s = statistics.median(times_s)
            self.timeout_s = max(self._timeout_min_s, TIMEOUT_TRIPS * self.read_s / self.requests_per_read)
