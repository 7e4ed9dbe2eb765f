"""A Robotiq 2F-85 as its driver meets it: late, quantised, self-locking, and not quite as strong as it says.

An order waits in the serial line, then for the motor, then width or force move at a finite rate. A register written
while the fingers rest on an object does nothing, so tightening costs two transactions (stop, go). The screw locks
itself: force only ever rises until the fingers are opened, and stays when orders stop coming.
Figures: 16 ms a transaction, 20-60 ms dead time, 64-480 N/s, 20 N + 0.843 N a count, 20-150 mm/s, 0.37 mm a count.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

from slipguard.devices import GripperState

UNLOAD_N_S = 480.0
"""How fast force falls when the fingers open at full speed (150 mm/s on half a pad's 6.4 N/mm)."""
COUNTS = 255


@dataclass(frozen=True, slots=True)
class GripperDynamics:
    """One gripper's figures. gain: true force over commanded force, which only the world knows."""

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

    def quantised_force_n(self, force_n: float) -> float:
        """The lowest force of the register that is not below `force_n`; clipped to the register's range."""
        counts = math.ceil((force_n - self.force_min_n) / self.force_step_n - 1e-9)
        return self.force_min_n + min(max(counts, 0), COUNTS) * self.force_step_n

    def quantised_width_mm(self, width_mm: float) -> float:
        """The nearest width of the position register."""
        counts = round(min(max(width_mm, 0.0), self.width_max_mm) / self.width_step_mm)
        return min(counts * self.width_step_mm, self.width_max_mm)


class Drive(Enum):
    """What the motor does."""

    REST = "rest"
    CLOSING = "closing"
    OPENING = "opening"


@dataclass(frozen=True, slots=True)
class QueuedCommand:
    """A command on its way through the line. target_n is the commanded force; None keeps the present one."""

    due_s: float
    goal_mm: float
    target_n: float | None
    opens: bool = False


@dataclass(frozen=True, slots=True)
class GripperPlant:
    """The fingers at one instant. force_n: true force of each finger; applied_n: what the register says."""

    width_mm: float = 85.0
    force_n: float = 0.0
    applied_n: float = 0.0
    drive: Drive = Drive.REST
    starts_s: float = 0.0
    """The motor does not move before this (dead time)."""
    goal_mm: float = 85.0
    goal_n: float = 0.0
    """True force at which the motor stops on an object."""
    holding: bool = False
    closed_on_nothing: bool = False
    orders: tuple[QueuedCommand, ...] = ()

    @property
    def at_rest(self) -> bool:
        """Nothing moves and nothing is on its way."""
        return self.drive is Drive.REST and not self.orders

    @property
    def grips(self) -> bool:
        """An object is held, or the fingers are on their way to whatever is there."""
        closes = self.drive is Drive.CLOSING and self.goal_mm == 0.0
        return self.holding or closes or any(order.goal_mm == 0.0 and not order.opens for order in self.orders)


def order_hold(plant: GripperPlant, model: GripperDynamics, now_s: float, force_n: float) -> tuple[GripperPlant, float]:
    """Close, or tighten, to `force_n`; returns the plant and the force applied by command.

    A force that is not above the one already gripped or being gripped with changes nothing.
    """
    wanted_n = model.quantised_force_n(force_n)
    if plant.grips and plant.applied_n >= wanted_n:
        return plant, plant.applied_n
    order = QueuedCommand(_due_s(plant, model, now_s), 0.0, wanted_n)
    return replace(plant, applied_n=wanted_n, orders=(*plant.orders, order)), wanted_n


def order_move(
    plant: GripperPlant, model: GripperDynamics, now_s: float, width_mm: float, force_n: float
) -> tuple[GripperPlant, float]:
    """Move the fingers to a width with at most `force_n`; returns the plant and the width commanded.

    Done as asked even with an object between them: refusing that is the driver's duty.
    """
    goal_mm = model.quantised_width_mm(width_mm)
    opens = goal_mm > plant.width_mm
    target_n = model.quantised_force_n(force_n)
    order = QueuedCommand(_due_s(plant, model, now_s), goal_mm, target_n, opens)
    applied_n = target_n if opens else max(target_n, plant.applied_n)
    return replace(plant, applied_n=applied_n, orders=(*plant.orders, order)), goal_mm


def order_release(plant: GripperPlant, model: GripperDynamics, now_s: float, width_mm: float) -> GripperPlant:
    """Open to `width_mm` and forget the force applied; a width below the present one only unloads the fingers."""
    goal_mm = max(model.quantised_width_mm(width_mm), plant.width_mm)
    order = QueuedCommand(_due_s(plant, model, now_s), goal_mm, None, opens=True)
    return replace(plant, applied_n=0.0, orders=(*plant.orders, order))


def order_halt(plant: GripperPlant) -> GripperPlant:
    """Stop the motor where it is; the screw keeps width and force. Orders on their way are forgotten.

    A grip whose force was still rising stays at what it has reached, and any force may be ordered anew.
    """
    if plant.at_rest:
        return plant
    return replace(plant, drive=Drive.REST, orders=(), holding=plant.force_n > 0.0, applied_n=0.0)


def _due_s(plant: GripperPlant, model: GripperDynamics, now_s: float) -> float:
    """When an order given now reaches the motor: one transaction, or two (stop, go) if the motor rests on an object."""
    busy_until_s = max(now_s, plant.orders[-1].due_s) if plant.orders else now_s
    stop_and_go = plant.holding and plant.drive is Drive.REST
    return busy_until_s + model.transaction_s * (2 if stop_and_go else 1)


def advance(
    plant: GripperPlant, model: GripperDynamics, now_s: float, step_s: float, object_mm: float | None
) -> GripperPlant:
    """The fingers one step later, at `now_s`; object_mm: thickness of what is between them, None for nothing."""
    while plant.orders and plant.orders[0].due_s <= now_s:
        plant = _begin(plant, model, plant.orders[0])
    if object_mm is None and (plant.holding or plant.force_n > 0.0):
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


def _begin(plant: GripperPlant, model: GripperDynamics, order: QueuedCommand) -> GripperPlant:
    """The motor takes up an order. A motor already closing takes a new force limit without stopping."""
    drive = Drive.OPENING if order.opens else Drive.CLOSING
    goal_n = 0.0 if order.opens or order.target_n is None else max(order.target_n * model.gain, plant.force_n)
    moving_on = plant.drive is drive
    return replace(
        plant,
        drive=drive,
        starts_s=plant.starts_s if moving_on else order.due_s + model.dead_time_s,
        goal_mm=order.goal_mm,
        goal_n=goal_n,
        holding=plant.holding and not order.opens,
        closed_on_nothing=plant.closed_on_nothing and not order.opens,
        orders=plant.orders[1:],
    )


def _lose(plant: GripperPlant, model: GripperDynamics, now_s: float) -> GripperPlant:
    """What was held is gone: the pads relax, and fingers that held it go on closing."""
    if plant.drive is Drive.OPENING:
        return replace(plant, force_n=0.0, holding=False)
    starts_s = plant.starts_s if plant.drive is Drive.CLOSING else now_s + model.dead_time_s
    return replace(plant, force_n=0.0, holding=False, drive=Drive.CLOSING, starts_s=starts_s)


def _open(plant: GripperPlant, model: GripperDynamics, step_s: float) -> GripperPlant:
    """Unload first, then open."""
    if plant.force_n > 0.0:
        return replace(plant, force_n=max(plant.force_n - UNLOAD_N_S * step_s, 0.0))
    width_mm = min(plant.width_mm + model.speed_mm_s * step_s, plant.goal_mm)
    return replace(plant, width_mm=width_mm, drive=Drive.REST if width_mm >= plant.goal_mm else plant.drive)


def _squeeze(plant: GripperPlant, model: GripperDynamics, step_s: float) -> GripperPlant:
    """The object stops the fingers; force rises to its limit, then the motor stops."""
    force_n = min(plant.force_n + model.ramp_n_s * step_s, plant.goal_n)
    if force_n < plant.goal_n:
        return replace(plant, force_n=force_n)
    return replace(plant, force_n=force_n, drive=Drive.REST, holding=True)


def report(plant: GripperPlant, now_s: float, fault: str | None = None) -> GripperState:
    """What the gripper says of itself. `holding` stays true while it tightens on what it already holds."""
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
