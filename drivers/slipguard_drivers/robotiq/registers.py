"""The register map of a Robotiq 2F or Hand-E gripper: pure encoding and decoding, no communication.

Three registers are written at 0x03E8 (action | -, - | position, speed | force) and three are read at
0x07D0 (status | -, fault | position echo, position | current). Position 0 is open, 255 closed.
Source: Robotiq 2F-85/2F-140 and Hand-E instruction manuals, section 4.

What these manuals say about a gripper that is not active:

* rACT: its rising edge activates, which moves the fingers fully. A loss of power sets rACT; it must be cleared and set
  again before the gripper works. gFLT 5 says so meanwhile, and gSTA is 0.
* rATR: automatic release, meant for after an emergency stop: the fingers slowly open to the end of the stroke. It
  overrides everything but rACT. gFLT is 0x0B meanwhile and 0x0F afterwards; then the gripper must be reset and
  activated.
* rARD: direction of the automatic release, taken over with rATR: 1 opens, 0 closes. The manual of the older 2-Finger
  200 has it the other way around; that gripper is not supported.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from slipguard.errors import CommandRefused, DeviceError

SLAVE_ID = 9
OUTPUT_ADDRESS = 0x03E8
INPUT_ADDRESS = 0x07D0
REGISTERS = 3

CLOSED_COUNT = 255
FULL_SPEED = 255
CLOSED_WITHIN_MM = 2.0
"""Fingers that are this close together have closed on nothing, if gOBJ reports no object."""
GEL_GAP_MM = 1.0
"""Closing ends where the gels of fingertip sensors are still this far apart."""

FAULTS = {
    0x00: None,
    0x05: "action delayed: activation must be completed first",
    0x07: "the activation bit must be set before any action",
    0x08: "too hot: it must cool down before it moves again",
    0x09: "no communication for at least one second",
    0x0A: "supply voltage is below the minimum",
    0x0B: None,
    0x0C: "internal fault",
    0x0D: "activation fault: check that nothing is in its way",
    0x0E: "overcurrent",
    0x0F: None,
}
"""gFLT as text. Codes up to 0x07 clear themselves; 0x09 only says that no request arrived for a second. 0x0B and 0x0F
belong to the automatic release."""
PASSING_FAULTS = frozenset({0x00, 0x05, 0x07, 0x09, 0x0B, 0x0F})
RELEASING, RELEASED = 0x0B, 0x0F
"""gFLT during and after an automatic release."""
CALIBRATION_COUNTS = 8
"""An activation calibrates the position again; fingers that touch are at most this much before `closed_count`."""


@dataclass(frozen=True, slots=True)
class RobotiqModel:
    """Data of one model.

    open_count, closed_count: usual positions at which the fingers stop. They differ from unit to unit and from one
    activation to the next (the manual's own example shows 13 open), so widths are true to about 4 mm at the open end
    and 3 mm at the closed end, and differences of widths to 5 %. fingertip_mm: thickness of a sensor on each finger;
    widths are between the gels.
    """

    name: str
    stroke_mm: float
    open_count: int
    closed_count: int
    force_min_n: float
    force_max_n: float
    fingertip_mm: float = 0.0

    @property
    def mm_per_count(self) -> float:
        """Return the width of one position count: 0.37 mm on a 2F-85."""
        return self.stroke_mm / (self.closed_count - self.open_count)

    @property
    def opening_mm(self) -> float:
        """Return the width of the open fingers."""
        return self.stroke_mm - 2.0 * self.fingertip_mm

    @property
    def goal_count(self) -> int:
        """Return the position that closing aims at: fully closed, or the limit that keeps the gels apart."""
        if self.fingertip_mm == 0.0:
            return CLOSED_COUNT
        return self.open_count + math.floor((self.opening_mm - GEL_GAP_MM) / self.mm_per_count)


MODEL_2F85 = RobotiqModel("2F-85", 85.0, 3, 230, 20.0, 235.0)
MODEL_2F140 = RobotiqModel("2F-140", 140.0, 3, 230, 10.0, 125.0)
MODEL_HAND_E = RobotiqModel("Hand-E", 50.0, 0, 255, 20.0, 185.0)
"""Hand-E instruction manual: 50 mm stroke, 20 to 185 N, 20 to 150 mm/s, gPO 0 open to 255 closed. An earlier edition
calculates with at most 130 N."""
MODELS = {model.name: model for model in (MODEL_2F85, MODEL_2F140, MODEL_HAND_E)}


class FingerMotion(IntEnum):
    """gOBJ: motion of the fingers. It lags, and means nothing while gGTO is 0; see `object_detection`."""

    MOVING = 0
    STOPPED_OPENING = 1
    STOPPED_CLOSING = 2
    AT_POSITION = 3


@dataclass(frozen=True, slots=True)
class RobotiqCommand:
    """What is written to the gripper: rACT, rGTO, rPR, rSP, rFR, and rATR with rARD. Counts are 0-255."""

    activate: bool = True
    go: bool = False
    position: int = 0
    speed: int = 0
    force: int = 0
    auto_release: bool = False
    """Start an automatic release in the direction of opening."""


RESET = RobotiqCommand(activate=False)
AUTO_RELEASE = RobotiqCommand(auto_release=True)


@dataclass(frozen=True, slots=True)
class RobotiqStatus:
    """The decoded input registers. Counts are 0-255."""

    activated: bool
    """gACT, which is also set after a loss of power."""
    going: bool
    ready: bool
    motion: FingerMotion
    fault_code: int
    position_echo: int
    position: int
    activating: bool = False

    @property
    def stopped_on_object(self) -> bool:
        """Whether gOBJ says that an object stopped the closing fingers; see `object_detection` for when to trust it."""
        stopped = self.motion is FingerMotion.STOPPED_CLOSING and self.position_echo > self.position
        return self.ready and self.going and stopped

    @property
    def releasing(self) -> bool:
        """Whether an automatic release opens the fingers."""
        return self.fault_code == RELEASING

    @property
    def auto_released(self) -> bool:
        """Whether an automatic release has ended, so that the gripper must be activated again."""
        return self.fault_code == RELEASED

    @property
    def fault(self) -> str | None:
        """Return the fault as text; None if there is none or if it clears itself."""
        if self.fault_code in PASSING_FAULTS:
            return None
        return FAULTS.get(self.fault_code) or f"unknown fault code 0x{self.fault_code:02X}"


def encode(command: RobotiqCommand) -> list[int]:
    """Return the three output registers. Raises ValueError for a count outside 0 to 255."""
    position, speed, force = command.position, command.speed, command.force
    for name, count in (("position", position), ("speed", speed), ("force", force)):
        if not 0 <= count <= 255:
            raise ValueError(f"{name} is {count} counts; it must be 0 to 255")
    action = command.activate << 0 | command.go << 3 | command.auto_release << 4 | command.auto_release << 5
    return [action << 8, position, speed << 8 | force]


def decode(registers: Sequence[int]) -> RobotiqStatus:
    """Decode the three input registers. Raises DeviceError if they cannot be those of such a gripper."""
    if len(registers) != REGISTERS or any(not 0 <= word <= 0xFFFF for word in registers):
        raise DeviceError(
            f"status {list(registers)} is not {REGISTERS} registers of 16 bits; check the gripper's model"
        )
    flags, echo_word, position_word = registers
    status = flags >> 8
    return RobotiqStatus(
        activated=bool(status & 0x01),
        going=bool(status & 0x08),
        ready=status >> 4 & 0x03 == 3,
        motion=FingerMotion(status >> 6 & 0x03),
        fault_code=echo_word >> 8 & 0x0F,
        position_echo=echo_word & 0xFF,
        position=position_word >> 8,
        activating=status >> 4 & 0x03 == 1,
    )


def force_to_count(force_n: float, model: RobotiqModel) -> int:
    """Return the lowest count that applies at least `force_n` per finger, limited to the range.

    Raises CommandRefused for a force that is negative or not finite.
    """
    if not (math.isfinite(force_n) and force_n >= 0):
        raise CommandRefused(f"a force of {force_n} N is not valid; {limits(model)}")
    share = (min(force_n, model.force_max_n) - model.force_min_n) / (model.force_max_n - model.force_min_n)
    return max(0, math.ceil(share * 255 - 1e-9))


def count_to_force(count: int, model: RobotiqModel) -> float:
    """Return the force per finger in newtons: 0.84 N per count on a 2F-85, approximately linear."""
    return model.force_min_n + (model.force_max_n - model.force_min_n) * count / 255


def width_to_count(width_mm: float, model: RobotiqModel) -> int:
    """Return the position count nearest to a width, between fully open and just before the goal of closing.

    Raises CommandRefused for a width that is negative or not finite.
    """
    if not (math.isfinite(width_mm) and width_mm >= 0):
        raise CommandRefused(
            f"a width of {width_mm} mm is not valid; a {model.name} opens 0 to {model.opening_mm:g} mm"
        )
    count = model.open_count + round((model.opening_mm - min(width_mm, model.opening_mm)) / model.mm_per_count)
    return min(count, model.goal_count - 1)


def count_to_width(count: int, model: RobotiqModel) -> float:
    """Return the width in mm at a position count; 0 if fingers or gels touch."""
    width_mm = model.opening_mm - (count - model.open_count) * model.mm_per_count
    return min(model.opening_mm, max(0.0, width_mm))


def nothing_between(width_mm: float) -> bool:
    """Return whether fingers at this width are closed: no object that is thicker can be between them."""
    return width_mm <= CLOSED_WITHIN_MM


def limits(model: RobotiqModel) -> str:
    """Return the force range of a model as text."""
    return f"a {model.name} applies {model.force_min_n:g} to {model.force_max_n:g} N per finger"
