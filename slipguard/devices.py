"""The ports: the interfaces of a tactile sensor, a gripper and an arm.

A driver inherits its port explicitly and registers under an entry-point group
(`slipguard.tactile`, `slipguard.gripper`, `slipguard.arm`). The registered class has a
`Settings` (a pydantic model: its own section of config.toml) and is built as
`Driver(settings, context)`; only `open()` uses the hardware.

All times are seconds on the monotonic clock (`CLOCK_MONOTONIC`, the event loop's `time()`).
Forces are newtons **per finger**. Commands state an intent, may be repeated, and return what was applied.
Every method may raise `DeviceLost` (open again) or `DeviceTimeout` (try again).
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from slipguard.errors import CommandRefused, ConfigError

FRAME_WIDTH_PX = 240
FRAME_HEIGHT_PX = 320
FRAME_SHAPE = (FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3)
FINGERS = ("left", "right")
ACTIVATION_HINT = (
    "if it holds something, support that and release it; with empty jaws, covered gels and no hand near, run "
    "`slipguard ctl activate`: the jaws open and close fully, at full speed and force"
)
"""What to do about a gripper that is not activated."""


@dataclass(frozen=True, slots=True)
class DriverContext:
    """What every driver is built with, in addition to its settings."""

    name: str
    """`left`, `right`, `gripper` or `arm`: the device's name in messages."""
    world: object | None = None
    """The simulated world that the fakes share (a `slipguard.sim.world.World`); None on a real cell."""
    mode: Literal["lift", "guard"] = "lift"
    """guard: another program moves the arm; the driver takes no control of it, refuses `lift`, and pauses to `stop`."""

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


def wrong_image(image: object) -> str | None:
    """Return why a value is not the image of a frame; None if it is."""
    if isinstance(image, np.ndarray) and image.shape == FRAME_SHAPE and image.dtype == np.uint8:
        return None
    found = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
    return f"{found}; it must be a numpy array, uint8 {FRAME_SHAPE}"


@dataclass(frozen=True, slots=True)
class GripperState:
    """State reported by the gripper."""

    active: bool
    moving: bool
    holding: bool
    """The fingers stopped on an object while closing. A gripper that is not active cannot know; then it is False."""
    closed_on_nothing: bool
    """The fingers are closed, as far as fingertip sensors allow: there is no object between them."""
    width_mm: float
    """Between the fingers, or between the gels of fingertip sensors. Only its changes count while not active."""
    force_n: float
    """The force last applied by a command, per finger; not a measurement."""
    fault: str | None
    measured_at_s: float
    force_known: bool = True
    """False if something is held that was not commanded on this connection: `force_n` is then the least it can be."""
    auto_released: bool = False
    """`release` has opened a gripper that was not active; it must be activated before it moves again."""


@dataclass(frozen=True, slots=True)
class ArmState:
    """State reported by the arm. `height_mm`: tool height above its height at the last `open()`."""

    height_mm: float
    speed_mm_s: float
    moving: bool
    protective_stop: bool
    emergency_stop: bool
    measured_at_s: float
    motion_known: bool = True
    """Whether the arm reports its motion. If not, every rotation is judged as in motion."""
    position_mm: tuple[float, float, float] | None = None
    """Tool position x, y, z in a frame that outlasts the connection, z up; None if the arm does not report one."""
    orientation_rad: tuple[float, float, float] | None = None
    """Tool orientation in that frame as a rotation vector (axis times angle); the tool's z axis points away from the
    flange, along the fingers. None if the arm does not report one."""
    up: tuple[float, float, float] | None = None
    """Which way is up in that frame, measured at rest, so that an arm that is not mounted upright is noticed: a lift is
    refused if up is more than 10 degrees from z. None for an arm without an accelerometer."""


class TactileSensor(Protocol):
    """One fingertip camera."""

    @property
    @abstractmethod
    def serial(self) -> str:
        """Serial number; the background image is stored under it. May be empty before `open()`."""

    @property
    def remarks(self) -> tuple[str, ...]:
        """Deviations from the configuration, such as another frame rate, as text."""
        return ()

    @abstractmethod
    async def open(self) -> None:
        """Find the sensor and start its stream. Idempotent."""

    @abstractmethod
    async def next_frame(self) -> Frame:
        """Wait for a frame that was not returned yet, and return the newest.

        Never returns the previous frame again. Raises `DeviceTimeout` on a stalled stream, `FrameCorrupt` on a damaged
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
        """Lowest and highest force per finger that the model can apply."""

    @property
    def force_latency_s(self) -> float | None:
        """Time from a request to tighten to the first change of the force, by the round trips measured at `open()`.

        None: not measured.
        """
        return None

    @abstractmethod
    async def open(self) -> None:
        """Connect. Never activates or moves the gripper while an object may be held."""

    @abstractmethod
    async def state(self) -> GripperState:
        """Read the gripper's state now."""

    @abstractmethod
    async def hold(self, force_n: float) -> float:
        """Close with `force_n`, or tighten to it; return the force that is applied (quantized).

        A force below the applied one changes nothing (a 2F gripper would have to open for it).
        """

    @abstractmethod
    async def move(self, width_mm: float, force_n: float) -> float:
        """Move the empty fingers to a width; return the commanded width (quantized, within the stroke).

        Raises `CommandRefused` while an object is held, and for opening while the fingers close, because they may have
        just reached an object. Only `release` opens in these states.
        """

    @abstractmethod
    async def halt(self) -> None:
        """Stop moving fingers where they are, with the present grip; no effect on resting fingers.

        For closing and tightening while a person may be near. Never opens. The reached force is unknown: until the next
        `hold`, `force_n` is 0 (at most the lowest limit if something was held), and `holding` is true if something may
        be between the fingers. A gripper that cannot be halted raises `CommandRefused`.
        """

    @abstractmethod
    async def release(self, width_mm: float) -> None:
        """Open to `width_mm`, and by some millimeters in any case, limited by the stroke.

        The only command that opens a held object's grip, and in no state does it close the fingers first. A gripper
        that is not active, or faulty, may open in another way, and then reports `auto_released`. Raises
        `CommandRefused`, with what to do, if it cannot be opened without closing.
        """

    async def activate(self) -> None:
        """Activate the empty gripper and wait until it is active; its fingers may move fully, at full speed and force.

        Raises `CommandRefused` if it is active already, and for a gripper that needs no activation.
        """
        raise CommandRefused("this gripper needs no activation")

    @abstractmethod
    async def close(self) -> None:
        """Disconnect and leave the grip as it is. Never raises; idempotent."""


class Arm(Protocol):
    """An arm that can lift, stop and lower along the vertical. Up is the z axis of its base."""

    @abstractmethod
    async def open(self) -> None:
        """Connect without moving."""

    @abstractmethod
    async def state(self) -> ArmState:
        """Return the newest state. Raises `DeviceTimeout` if no state arrives any more."""

    @abstractmethod
    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        """Start to move by `height_mm` (down if negative); return the applied speed. Replaces a running motion.

        Does not wait for its end. Raises `CommandRefused` in guard mode and while a safety stop is active.
        """

    @abstractmethod
    async def stop(self) -> None:
        """Stop the motion; in guard mode, pause the program that moves the arm.

        Safe to call at any time, also while `lift` has not returned; it is called again afterwards.
        """

    @abstractmethod
    async def close(self) -> None:
        """Stop a motion of this driver, and disconnect. Never raises; idempotent."""
