"""The ports: what slipguard needs of a tactile sensor, a gripper and an arm, and nothing more.

A driver inherits its port explicitly and registers under an entry-point group
(`slipguard.tactile`, `slipguard.gripper`, `slipguard.arm`). The registered class has a
`Settings` (a pydantic model: its own section of config.toml) and is built as
`Driver(settings, context)`; building touches no hardware, `open()` does.

All times are seconds on the monotonic clock (`CLOCK_MONOTONIC`, the event loop's `time()`).
Forces are newtons **per finger**. Commands state an intent, may be repeated, and return what was applied.
Every method may raise `DeviceLost` (open again) or `DeviceTimeout` (ask again).
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from slipguard.errors import ConfigError

FRAME_WIDTH_PX = 240
FRAME_HEIGHT_PX = 320


@dataclass(frozen=True, slots=True)
class DriverContext:
    """What the composition root hands to every driver it builds."""

    name: str
    """`left`, `right`, `gripper` or `arm`: how messages name the device."""
    world: object | None = None
    """The simulated world that the fakes share (a `slipguard.sim.world.World`); None on a real cell."""
    mode: Literal["lift", "guard"] = "lift"
    """guard: another program moves the arm; its driver must take nothing over, refuse `lift`, and `stop` by a pause."""

    def require_world(self) -> Any:
        """Return the simulated world. Raises ConfigError on a real cell, which has none."""
        if self.world is None:
            raise ConfigError(
                f"{self.name}: driver 'fake' needs the simulated world, and this is a real cell; "
                "start with --sim, or configure a real driver"
            )
        return self.world


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One gel image. image: (320, 240, 3) uint8 BGR, portrait, read-only."""

    image: NDArray[np.uint8]
    captured_at_s: float
    sequence: int


@dataclass(frozen=True, slots=True)
class GripperState:
    """What the gripper said. `holding`: stopped on an object while closing."""

    active: bool
    moving: bool
    holding: bool
    closed_on_nothing: bool
    """Closing ended at the end stop: no object between the fingers."""
    width_mm: float
    force_n: float
    """The force last applied by command, per finger; not a measurement."""
    fault: str | None
    measured_at_s: float


@dataclass(frozen=True, slots=True)
class ArmState:
    """What the arm said. `height_mm`: tool height above where the last `open()` found it."""

    height_mm: float
    speed_mm_s: float
    moving: bool
    protective_stop: bool
    emergency_stop: bool
    measured_at_s: float


class TactileSensor(Protocol):
    """One fingertip camera."""

    @property
    @abstractmethod
    def serial(self) -> str:
        """Serial number; the no-contact image is stored under it. Empty before `open()` where it is not known yet."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """What works, but not as asked, in words: another rate, too little bandwidth."""
        return ()

    @abstractmethod
    async def open(self) -> None:
        """Find the sensor and start its stream. Idempotent."""

    @abstractmethod
    async def next_frame(self) -> Frame:
        """The newest frame not yet handed out; waits for one.

        Never the previous frame again. Raises `DeviceTimeout` on a stalled stream, `FrameCorrupt` on a damaged
        frame, `FrameFrozen` on a repeating one, `DeviceLost` when the sensor is gone.
        """

    @abstractmethod
    async def close(self) -> None:
        """Stop the stream. Never raises; idempotent."""


class Gripper(Protocol):
    """A two-finger gripper."""

    @property
    @abstractmethod
    def force_limits_n(self) -> tuple[float, float]:
        """Lowest and highest force per finger the model can apply."""

    @abstractmethod
    async def open(self) -> None:
        """Connect. Adopts a held object as it is: never re-activates, never moves while one may be held."""

    @abstractmethod
    async def state(self) -> GripperState:
        """Ask the gripper now."""

    @abstractmethod
    async def hold(self, force_n: float) -> float:
        """Close on what is there with `force_n`, or tighten to it; return the force really applied (quantised).

        A force below the one already applied changes nothing (on a 2F it could only be had by opening).
        """

    @abstractmethod
    async def move(self, width_mm: float, force_n: float) -> float:
        """Move the fingers to a width, empty-handed; return the width commanded (quantised, within the stroke).

        Raises `CommandRefused` while an object is held, and outwards while the fingers are closing, for they may just
        have met something: only `release` opens then.
        """

    @abstractmethod
    async def halt(self) -> None:
        """Stop the fingers where they are, with the grip they have; nothing happens where they rest.

        For closing and tightening while a person may be near. Never lets go. What was reached is not known: until the
        next `hold`, `force_n` is 0 (at most the lowest limit, where something was held), and `holding` is true wherever
        something may be between the fingers. A gripper that cannot be halted raises `CommandRefused`.
        """

    @abstractmethod
    async def release(self, width_mm: float) -> None:
        """Open to `width_mm`, or as far as the stroke goes. The one command that lets go."""

    @abstractmethod
    async def close(self) -> None:
        """Disconnect and leave the grip as it is. Never raises; idempotent."""


class Arm(Protocol):
    """An arm that can lift, stop and lower along the vertical."""

    @abstractmethod
    async def open(self) -> None:
        """Connect without moving."""

    @abstractmethod
    async def state(self) -> ArmState:
        """The newest state; raises `DeviceTimeout` when it has stopped coming."""

    @abstractmethod
    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        """Start moving by `height_mm` (down when negative), return the speed applied; replaces a motion under way.

        Does not wait for its end. Raises `CommandRefused` in guard mode and while a safety stop is active.
        """

    @abstractmethod
    async def stop(self) -> None:
        """Stop a motion now and hold still; in guard mode: pause who moves it. Safe to call at any time."""

    @abstractmethod
    async def close(self) -> None:
        """Stop what this driver has moved, and disconnect. Never raises; idempotent."""
