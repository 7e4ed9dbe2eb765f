"""A bar in the simulated world: gripped, and followed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from slipguard.errors import InputError
from slipguard.sim.gripper_plant import GripperDynamics
from slipguard.sim.scenario import Scenario
from slipguard.sim.sim_object import SimObject
from slipguard.sim.world import World, WorldTruth

T0 = 1000.0
QUICK = GripperDynamics(dead_time_s=0.02, ramp_n_s=480.0, speed_mm_s=150.0)


def bar(mass_kg: float = 0.35, lever_mm: float = 60.0, friction: float = 0.8) -> SimObject:
    return SimObject("bar", "test", lambda u, v: u, mass_kg, lever_mm, 7.4e-4, friction, press_mm=1.0)


def make(item: SimObject | None = None) -> World:
    thing = item or bar()

    def lookup(name: str) -> SimObject:
        if name != thing.name:
            raise InputError(f"no object {name!r}; there is {thing.name}")
        return thing

    return World(lookup=lookup)


def grasped(force_n: float, item: SimObject | None = None, **changes: object) -> tuple[World, float]:
    """A world in which the object has been gripped on the table, and the time then."""
    world = make(item)
    world.place(replace(Scenario("bar", gripper=QUICK), **changes), T0)  # type: ignore[arg-type]
    world.command_hold(T0, force_n)
    return world, T0 + 1.5


def follow(
    world: World, start_s: float, seconds: float, act: Callable[[WorldTruth], None] | None = None
) -> list[WorldTruth]:
    truths = []
    for i in range(round(seconds * 100)):
        truths.append(world.truth(start_s + i * 0.01))
        if act is not None:
            act(truths[-1])
    return truths
