"""The world shared by the simulated gripper, arm and cameras.

It is the only mutable object of the simulation: it holds frozen states and advances them on a fixed grid of steps up to
the time of each call. Its state depends on the commands and their times only, not on how often it is read. Time is an
argument; a time earlier than the last one returns the present.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

from slipguard.devices import ArmState, GripperState
from slipguard.errors import CommandRefused, InputError
from slipguard.sim import arm_plant, cell, gripper_plant, object_motion
from slipguard.sim.arm_plant import ArmModel
from slipguard.sim.catalogue import find_object
from slipguard.sim.cell import CellState, Mechanics, PlacedObject, WorldTruth
from slipguard.sim.friction import needed_force_n
from slipguard.sim.gel_view import GelView
from slipguard.sim.gripper_plant import GripperDynamics, GripperPlant
from slipguard.sim.injected_faults import InjectedFaults
from slipguard.sim.object_motion import GraspedBody, ObjectMotion
from slipguard.sim.scenario import CameraModel, Scenario, initial_delivery
from slipguard.sim.sim_object import SimObject

__all__ = ["World", "WorldSettings", "WorldTruth"]

_SIGNS = {"left": 1, "right": -1}


@dataclass(frozen=True, slots=True)
class WorldSettings:
    """An empty world.

    Attributes:
        gripper: until a scenario brings its own.
        gripper_activated: False as it leaves the factory.
        fingertip_mm: thickness of each fingertip sensor; the gels meet where the jaws are twice as far apart.
    """

    step_s: float = 1e-3
    start_width_mm: float = 85.0
    arm: ArmModel = field(default_factory=ArmModel)
    gripper: GripperDynamics = field(default_factory=GripperDynamics)
    gripper_activated: bool = True
    fingertip_mm: float = 0.0


class World:
    """A gripper with two gels, an arm, a table, and at most one object.

    Args:
        lookup: name -> object; default: the catalogue.
        mechanics: moves the held object; default: `object_motion.advance`.

    Attributes:
        faults: injected faults; a fault of gripper or arm takes effect from the world's last time on.
        gripper_activated: what the gripper reports; its driver refuses to move a gripper that is not.
    """

    def __init__(
        self,
        settings: WorldSettings | None = None,
        seed: int = 0,
        lookup: Callable[[str], SimObject] | None = None,
        mechanics: Mechanics = object_motion.advance,
    ) -> None:
        self.settings = settings or WorldSettings()
        self.seed = seed
        self.faults = InjectedFaults()
        self.gripper_activated = self.settings.gripper_activated
        self._lookup = lookup or find_object
        self._deliveries = {finger: initial_delivery(seed, finger) for finger in _SIGNS}
        width_mm = self.settings.start_width_mm
        plant, fingertip_mm = GripperPlant(width_mm=width_mm, goal_mm=width_mm), self.settings.fingertip_mm
        self._cell = CellState(plant, self.settings.gripper, fingertip_mm=fingertip_mm, mechanics=mechanics)
        self._origin_s: float | None = None
        self._now_s = -math.inf
        self._steps = 0
        self._static = False

    def place(self, scenario: Scenario, now_s: float) -> None:
        """Put an object between the open jaws, on a table at the fingers' present height.

        Raises:
            CommandRefused: the jaws are too narrow, or there is already an object.
            InputError: unknown object.
        """
        now_s = self._advance(now_s)
        item = self._lookup(scenario.object_name)
        present = self._cell.present
        if present is not None:
            raise CommandRefused(f"{present.item.name} is between the jaws; clear it first")
        apart_mm = self._cell.gripper.width_mm - 2.0 * self.settings.fingertip_mm
        if apart_mm < item.width_mm:
            raise CommandRefused(
                f"the jaws are {apart_mm:.1f} mm apart, {item.name} is {item.width_mm:.1f} mm "
                "thick; release the gripper first"
            )
        item = replace(item, friction=item.friction * scenario.friction_scale)
        body = replace(
            GraspedBody.of(item),
            friction_difference=scenario.friction_difference,
            lever_rad=math.radians(scenario.lever_deg),
        )
        placed = PlacedObject(scenario, item, body, needed_force_n(item, scenario.gel))
        self._deliveries = {"left": scenario.left, "right": scenario.right}
        self._change(
            gripper_model=scenario.gripper,
            placed=placed,
            motion=ObjectMotion(),
            table_mm=arm_plant.pose(self._cell.arm, now_s).height_mm,
            held=False,
            dropped=None,
        )

    def take_table(self, now_s: float) -> None:
        """Remove the table: the fingers carry the whole weight at once."""
        self._advance(now_s)
        self._change(table_mm=-math.inf)

    def shake(self, now_s: float, acceleration_m_s2: Callable[[float], float] | None) -> None:
        """Accelerate the fingers additionally from now on, up, by time: vibration, a touch. None ends it."""
        self._advance(now_s)
        self._change(disturbance_m_s2=acceleration_m_s2)

    def push(self, now_s: float, force: Callable[[float], tuple[float, float]] | None) -> None:
        """Push the object from now on: force downwards (N) and torque (N m) by time. None ends it."""
        self._advance(now_s)
        self._change(push=force)

    def add_mass(self, now_s: float, mass_kg: float) -> None:
        """Put mass on the object at its center of mass: something is poured or laid into it."""
        self._advance(now_s)
        placed = self._cell.placed
        if placed is None:
            raise CommandRefused("there is no object to put mass on")
        old, item = placed.body, replace(placed.item, mass_kg=placed.item.mass_kg + mass_kg)
        body = replace(old, mass_kg=old.mass_kg + mass_kg, inertia_kg_m2=old.inertia_kg_m2 + mass_kg * old.lever_m**2)
        placed = replace(placed, item=item, body=body, needed_n=needed_force_n(item, placed.scenario.gel))
        self._change(placed=placed)

    def clear(self, now_s: float) -> None:
        """Remove the object, if any; the jaws stay as they are."""
        self._advance(now_s)
        self._change(placed=None, motion=ObjectMotion(), held=False, dropped=None)

    # The gripper.

    def command_hold(self, now_s: float, force_n: float, goal_mm: float = 0.0) -> float:
        """Close to `goal_mm` or tighten; return the commanded force per finger. A lower force changes nothing."""
        now_s = self._advance(now_s)
        _check("force_n", force_n)
        if self._gripper_faulty():
            return self._cell.gripper.applied_n
        present, model = self._cell.gripper, self._cell.gripper_model
        plant, applied_n = gripper_plant.order_hold(present, model, now_s, force_n, goal_mm)
        self._change(gripper=plant)
        return applied_n

    def command_move(self, now_s: float, width_mm: float, force_n: float) -> float:
        """Move the fingers to a width; return the commanded width. Opening releases the object."""
        now_s = self._advance(now_s)
        _check("width_mm", width_mm)
        _check("force_n", force_n)
        if self._gripper_faulty():
            return self._cell.gripper.width_mm
        model = self._cell.gripper_model
        plant, width_mm = gripper_plant.order_move(self._cell.gripper, model, now_s, width_mm, force_n)
        self._change(gripper=plant)
        return width_mm

    def command_release(self, now_s: float, width_mm: float) -> None:
        now_s = self._advance(now_s)
        _check("width_mm", width_mm)
        if not self._gripper_faulty():
            plant = gripper_plant.order_release(self._cell.gripper, self._cell.gripper_model, now_s, width_mm)
            self._change(gripper=plant)

    def command_halt(self, now_s: float) -> None:
        """Stop the gripper's motor; width and force stay."""
        self._advance(now_s)
        self._change(gripper=gripper_plant.order_halt(self._cell.gripper))

    def gripper_state(self, now_s: float) -> GripperState:
        now_s = self._advance(now_s)
        fault = "internal fault" if self._gripper_faulty() else None
        state = gripper_plant.report(self._cell.gripper, now_s, fault)
        return state if self.gripper_activated else replace(state, active=False, holding=False, closed_on_nothing=False)

    def _gripper_faulty(self) -> bool:
        return "fault" in self.faults.active("gripper")

    # The arm.

    def command_lift(self, now_s: float, height_mm: float, speed_mm_s: float) -> float:
        """Move by `height_mm` from here; return the speed applied, 0 in a protective or emergency stop."""
        now_s = self._advance(now_s)
        _check("height_mm", height_mm)
        _check("speed_mm_s", speed_mm_s)
        if self._arm_stopped():
            return 0.0
        plan, speed_mm_s = arm_plant.order_lift(self._cell.arm, self.settings.arm, now_s, height_mm, speed_mm_s)
        self._change(arm=plan)
        return speed_mm_s

    def command_stop(self, now_s: float) -> None:
        now_s = self._advance(now_s)
        self._change(arm=arm_plant.order_stop(self._cell.arm, self.settings.arm, now_s))

    def arm_state(self, now_s: float) -> ArmState:
        now_s = self._advance(now_s)
        active = self.faults.active("arm")
        return arm_plant.report(self._cell.arm, now_s, "protective_stop" in active, "emergency_stop" in active)

    def _arm_stopped(self) -> bool:
        return not self.faults.active("arm").isdisjoint({"protective_stop", "emergency_stop"})

    # The cameras.

    def camera(self, finger: str) -> CameraModel:
        """Return the camera of a finger, "left" or "right"; serial and unit never change."""
        _sign(finger)
        serial, unit_seed = f"SIM-{finger[0].upper()}", 2 * self.seed + (finger == "right")
        return CameraModel(**asdict(self._deliveries[finger]), serial=serial, unit_seed=unit_seed)

    def view(self, finger: str, now_s: float) -> GelView:
        """Return the view of a finger's camera; `depth_mm` <= 0 without contact, name "" without an object."""
        self._advance(now_s)
        return cell.view(self._cell, _sign(finger))

    def truth(self, now_s: float) -> WorldTruth:
        """Return the true state; for evaluation only."""
        now_s = self._advance(now_s)
        return cell.truth(self._cell, arm_plant.pose(self._cell.arm, now_s), now_s)

    # Time.

    def _advance(self, now_s: float) -> float:
        """Advance to the last step of the grid at or before `now_s`; return the present, never earlier."""
        if not math.isfinite(now_s):
            raise InputError(f"now_s is {now_s}; it must be a finite time in seconds")
        if self._origin_s is None:
            self._origin_s = now_s
        self._now_s = now_s = max(now_s, self._now_s)
        step_s = self.settings.step_s
        goal = math.floor((now_s - self._origin_s) / step_s + 1e-6)
        if self._arm_stopped():
            stopped = arm_plant.order_stop(self._cell.arm, self.settings.arm, self._origin_s + self._steps * step_s)
            if stopped is not self._cell.arm:
                self._change(arm=stopped)
        works = not self._gripper_faulty()
        while self._steps < goal and not self._static:
            self._steps += 1
            at_s = self._origin_s + self._steps * step_s
            before = self._cell
            self._cell = cell.step(before, at_s, step_s, gripper_works=works)
            self._static = cell.is_static(before, self._cell, at_s)
        self._steps = max(self._steps, goal)
        return now_s

    def _change(self, **changes: Any) -> None:
        self._cell = replace(self._cell, **changes)
        self._static = False


def _sign(finger: str) -> int:
    if finger not in _SIGNS:
        raise InputError(f"no finger {finger!r}; there are left and right")
    return _SIGNS[finger]


def _check(name: str, value: float) -> None:
    if not math.isfinite(value):
        raise InputError(f"{name} is {value}; it must be a finite number")
