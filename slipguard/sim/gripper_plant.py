"""A Robotiq 2F-85 as seen by its driver: delayed, quantized, self-locking, with a force gain error.

A command passes the serial line and the motor's dead time, then width or force change at a finite rate. Writing the
force register while the fingers rest on an object has no effect, so tightening takes two transactions (stop, go). The
screw is self-locking: the force only rises until the fingers open, and stays without commands.
Figures: 16 ms per transaction, 20-60 ms dead time, 64-480 N/s, 20 N + 0.843 N per count, 20-150 mm/s, 0.37 mm per
count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

from slipguard.devices import GripperState

UNLOAD_N_S = 480.0
"""Rate at which the force falls when the fingers open at full speed (150 mm/s on half a pad's 6.4 N/mm)."""
COUNTS = 255


@dataclass(frozen=True, slots=True)
class GripperDynamics:
    """Parameters of one gripper. gain: true over commanded force, unknown to the driver."""

    transaction_s: float = 0.016
    dead_time_s: float = 0.04
    ramp_n_s: float = 200.0
    speed_mm_s: float = 100.0
    gain: float = 1.0
    force_min_n: float = 20.0
    force_max_n: float = 235.0
    width_max_mm: float = 85.0
    width_step_mm: float = 0.37

    @property
    def force_step_n(self) -> float:
        """Force of one register count: 0.843 N."""
        return (self.force_max_n - self.force_min_n) / COUNTS

    def quantized_force_n(self, force_n: float) -> float:
        """Return the smallest register force not below `force_n`, clipped to the register's range."""
        counts = math.ceil((force_n - self.force_min_n) / self.force_step_n - 1e-9)
        return self.force_min_n + min(max(counts, 0), COUNTS) * self.force_step_n

    def quantized_width_mm(self, width_mm: float) -> float:
        counts = round(min(max(width_mm, 0.0), self.width_max_mm) / self.width_step_mm)
        return min(counts * self.width_step_mm, self.width_max_mm)


class Drive(Enum):
    """Motion of the motor."""

    REST = "rest"
    CLOSING = "closing"
    OPENING = "opening"


@dataclass(frozen=True, slots=True)
class QueuedCommand:
    """A command in the serial line. target_n: commanded force; None keeps the present one."""

    due_s: float
    goal_mm: float
    target_n: float | None
    opens: bool = False


@dataclass(frozen=True, slots=True)
class GripperPlant:
    """State of the fingers. force_n: true force of each finger; applied_n: force in the register."""

    width_mm: float = 85.0
    force_n: float = 0.0
    applied_n: float = 0.0
    drive: Drive = Drive.REST
    starts_s: float = 0.0
    """The motor does not move before this time (dead time)."""
    goal_mm: float = 85.0
    goal_n: float = 0.0
    """True force at which the motor stops on an object."""
    holding: bool = False
    closed_on_nothing: bool = False
    pending: tuple[QueuedCommand, ...] = ()

    @property
    def at_rest(self) -> bool:
        """Whether the motor is at rest and no command is pending."""
        return self.drive is Drive.REST and not self.pending

    def grips(self, goal_mm: float) -> bool:
        """Return whether an object is held, or the fingers are closing to `goal_mm` for a grip."""
        closes = self.drive is Drive.CLOSING and self.goal_mm == goal_mm
        pending = any(command.goal_mm == goal_mm and not command.opens for command in self.pending)
        return self.holding or closes or pending


def order_hold(
    plant: GripperPlant, model: GripperDynamics, now_s: float, force_n: float, goal_mm: float = 0.0
) -> tuple[GripperPlant, float]:
    """Close as far as `goal_mm`, or tighten, to `force_n`; return the plant and the commanded force.

    A force not above the present or pending grip force changes nothing.
    """
    wanted_n = model.quantized_force_n(force_n)
    if plant.grips(goal_mm) and plant.applied_n >= wanted_n:
        return plant, plant.applied_n
    command = QueuedCommand(_due_s(plant, model, now_s), goal_mm, wanted_n)
    return replace(plant, applied_n=wanted_n, pending=(*plant.pending, command)), wanted_n


def order_move(
    plant: GripperPlant, model: GripperDynamics, now_s: float, width_mm: float, force_n: float
) -> tuple[GripperPlant, float]:
    """Move the fingers to a width with at most `force_n`; return the plant and the commanded width.

    This also works with an object between them: the driver must refuse that.
    """
    goal_mm = model.quantized_width_mm(width_mm)
    opens = goal_mm > plant.width_mm
    target_n = model.quantized_force_n(force_n)
    command = QueuedCommand(_due_s(plant, model, now_s), goal_mm, target_n, opens)
    applied_n = target_n if opens else max(target_n, plant.applied_n)
    return replace(plant, applied_n=applied_n, pending=(*plant.pending, command)), goal_mm


def order_release(plant: GripperPlant, model: GripperDynamics, now_s: float, width_mm: float) -> GripperPlant:
    """Open to `width_mm` and reset the commanded force; a width below the present one only unloads the fingers."""
    goal_mm = max(model.quantized_width_mm(width_mm), plant.width_mm)
    command = QueuedCommand(_due_s(plant, model, now_s), goal_mm, None, opens=True)
    return replace(plant, applied_n=0.0, pending=(*plant.pending, command))


def order_halt(plant: GripperPlant) -> GripperPlant:
    """Stop the motor; the screw keeps width and force. Pending commands are discarded.

    A rising force stays at its present value, and any force can be commanded again.
    """
    if plant.at_rest:
        return plant
    return replace(plant, drive=Drive.REST, pending=(), holding=plant.force_n > 0.0, applied_n=0.0)


def _due_s(plant: GripperPlant, model: GripperDynamics, now_s: float) -> float:
    """Return when a command reaches the motor: one transaction, or two (stop, go) if it rests on an object."""
    busy_until_s = max(now_s, plant.pending[-1].due_s) if plant.pending else now_s
    stop_and_go = plant.holding and plant.drive is Drive.REST
    return busy_until_s + model.transaction_s * (2 if stop_and_go else 1)


def advance(
    plant: GripperPlant, model: GripperDynamics, now_s: float, step_s: float, object_mm: float | None
) -> GripperPlant:
    """Return the fingers one step later, at `now_s`. object_mm: width at which something stops them; None: nothing."""
    while plant.pending and plant.pending[0].due_s <= now_s:
        plant = _begin(plant, model, plant.pending[0])
    if (object_mm is None or object_mm < plant.width_mm) and (plant.holding or plant.force_n > 0.0):
        plant = _lose(plant, model, now_s)
    if plant.drive is Drive.REST or now_s < plant.starts_s:
        return plant
    if plant.drive is Drive.OPENING:
        return _open(plant, model, step_s)
    if object_mm is not None and plant.width_mm <= object_mm:
        return _squeeze(plant, model, step_s)
    floor_mm = max(plant.goal_mm, object_mm if object_mm is not None else 0.0)
    width_mm = max(plant.width_mm - model.speed_mm_s * step_s, floor_mm)
    if width_mm > plant.goal_mm:
        return replace(plant, width_mm=width_mm)
    return replace(plant, width_mm=width_mm, drive=Drive.REST, closed_on_nothing=width_mm == 0.0)


def _begin(plant: GripperPlant, model: GripperDynamics, command: QueuedCommand) -> GripperPlant:
    """Start a command. A motor already closing takes a new force limit without stopping."""
    drive = Drive.OPENING if command.opens else Drive.CLOSING
    goal_n = 0.0 if command.opens or command.target_n is None else max(command.target_n * model.gain, plant.force_n)
    moving_on = plant.drive is drive
    return replace(
        plant,
        drive=drive,
        starts_s=plant.starts_s if moving_on else command.due_s + model.dead_time_s,
        goal_mm=command.goal_mm,
        goal_n=goal_n,
        holding=plant.holding and not command.opens,
        closed_on_nothing=plant.closed_on_nothing and not command.opens,
        pending=plant.pending[1:],
    )


def _lose(plant: GripperPlant, model: GripperDynamics, now_s: float) -> GripperPlant:
    """Handle the loss of the object: the pads relax, and the fingers continue to close."""
    if plant.drive is Drive.OPENING:
        return replace(plant, force_n=0.0, holding=False)
    starts_s = plant.starts_s if plant.drive is Drive.CLOSING else now_s + model.dead_time_s
    return replace(plant, force_n=0.0, holding=False, drive=Drive.CLOSING, starts_s=starts_s)


def _open(plant: GripperPlant, model: GripperDynamics, step_s: float) -> GripperPlant:
    if plant.force_n > 0.0:
        return replace(plant, force_n=max(plant.force_n - UNLOAD_N_S * step_s, 0.0))
    width_mm = min(plant.width_mm + model.speed_mm_s * step_s, plant.goal_mm)
    return replace(plant, width_mm=width_mm, drive=Drive.REST if width_mm >= plant.goal_mm else plant.drive)


def _squeeze(plant: GripperPlant, model: GripperDynamics, step_s: float) -> GripperPlant:
    """Raise the force on the object to its limit, then stop the motor."""
    force_n = min(plant.force_n + model.ramp_n_s * step_s, plant.goal_n)
    if force_n < plant.goal_n:
        return replace(plant, force_n=force_n)
    return replace(plant, force_n=force_n, drive=Drive.REST, holding=True)


def report(plant: GripperPlant, now_s: float, fault: str | None = None) -> GripperState:
    """Return the state that the gripper reports. `holding` stays true while it tightens a grip."""
    return GripperState(
        active=fault is None,
        moving=not plant.at_rest,
        holding=plant.holding,
        closed_on_nothing=plant.closed_on_nothing,
        width_mm=plant.width_mm,
        force_n=plant.applied_n,
        fault=fault,
        measured_at_s=now_s,
    )
