"""Random commands on a line on which everything goes wrong now and then, and what must never come of it.

The emulator knows the truth: what each of its answers said at the moment it was made, every grip, every opening. A
state is believed wrongly if no answer made during the call says the same. A grip is opened wrongly if the jaws release,
or the gripper is reset or activated, by what no release has written; an activation that one has begun goes on alone.
"""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from collections.abc import Awaitable, Callable
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from pathlib import Path

from slipguard.devices import DriverContext, GripperState
from slipguard.emulator import Event
from slipguard.errors import CommandRefused, DeviceError, DeviceLost
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_drivers.robotiq.registers import MODEL_2F85, MODEL_HAND_E, RobotiqCommand, RobotiqModel, encode
from slipguard_emulators.robotiq.emulator import RobotiqEmulator
from slipguard_emulators.robotiq.jaws import JawsState, SimpleJaws
from slipguard_emulators.robotiq.registers import ActivationStage, GripperFigures

PROBABILITY = 0.01
"""Of each kind of fault, at each request."""
STEP_MM, STEP_N = 0.38, 0.85
"""One count of the position and of the force register."""
COPY_S = 0.04
"""Age of the URCap's copy: two refreshes."""
TICK_S, STALL_S = 0.005, 0.02
"""A loop that comes later than this was kept from running by the machine."""
APPROACH = 0.9
"""Share of the full speed at which the driver moves: there is no time for slow jaws."""
RELEASING = ContextVar("RELEASING", default=False)
"""Whether we are inside a release, in any task the driver does it."""
OPENINGS = ("released", "activating", "rACT cleared")
LANE_MODELS = (MODEL_2F85, MODEL_HAND_E)
"""Every second line has the other gripper."""
MIX = {"state": 30, "hold": 25, "move": 12, "give up": 10, "release": 11, "restart": 6, "object": 6}


@dataclass(frozen=True)
class Truth:
    """The gripper as it was when an answer was made."""

    at_s: float
    ready: bool
    going: bool
    view: JawsState
    width_mm: float
    """By the reported position and the usual calibration."""


@dataclass
class Outcome:
    """What the campaign came to.

    longest_s: of a call that activates nothing, less what this process was kept from running meanwhile (stalled_s in
    all).
    """

    commands: int = 0
    states: int = 0
    refused: int = 0
    failed: int = 0
    restarts_holding: int = 0
    longest_s: float = 0.0
    stalled_s: float = 0.0
    due_s: float = 0.0
    """When the loop should run next, for stalls that are not over."""
    wrong: list[str] = field(default_factory=list)
    opened: list[str] = field(default_factory=list)
    loosened: list[str] = field(default_factory=list)
    occurred: Counter[str] = field(default_factory=Counter)

    def stalled_till(self, now_s: float) -> float:
        """stalled_s, with what is being lost at the moment."""
        late_s = now_s - self.due_s
        return self.stalled_s + (late_s if late_s > STALL_S else 0.0)


class Lane:
    """One gripper on one line, with its own driver and its own chance."""

    def __init__(self, folder: Path, seed: int, outcome: Outcome, model: RobotiqModel, wiring: str) -> None:
        self.outcome = outcome
        self.model = model
        self.rng = random.Random(seed)
        options = {"seed": seed, "quick": 5.0, "outage_ms": 200.0, "activated": True, "model": model.name}
        options |= {"link": folder / f"tty{seed}"} if wiring == "usb" else {"tcp_port": 0, "wiring": wiring}
        self.through_copy = wiring == "urcap"
        """Whether statuses and commands pass through the URCap's copy."""
        self.emulator = RobotiqEmulator(RobotiqEmulator.Settings.model_validate(options), self._on_event)
        self.truths: list[Truth] = []
        self.asked: tuple[bool, list[str]] = (False, [])
        """What the driver wrote last, and whether a release did; no write is sent before the last one is done with."""
        self.by_release = False
        """Whether the last write that reached the gripper was a release's."""
        self._watch_answers()

    def _driver(self) -> RobotiqGripper:
        keys = {"model": self.model.name, "approach_speed": APPROACH, **self.emulator.driver_settings}
        gripper = RobotiqGripper(RobotiqGripper.Settings.model_validate(keys), DriverContext("gripper"))
        write = gripper._transport.write_command

        async def noted(command: RobotiqCommand, by_s: float) -> None:
            self.asked = (RELEASING.get(), [f"{word:04X}" for word in encode(command)])
            await write(command, by_s)

        gripper._transport.write_command = noted  # type: ignore[method-assign]
        return gripper

    def _watch_answers(self) -> None:
        registers = self.emulator.registers
        read = registers.read

        def watched(now_s: float) -> list[int]:
            view = registers.tick(now_s)
            going = bool(registers.outputs[0] >> 8 & 0x08)
            at_s = asyncio.get_running_loop().time()
            words = read(now_s)
            width_mm = usual_width_mm(registers.figures, words[2] >> 8)
            self.truths.append(Truth(at_s, registers.stage is ActivationStage.READY, going, view, width_mm))
            return words

        registers.read = watched  # type: ignore[method-assign]

    def _on_event(self, event: Event) -> None:
        if event["event"] == "fault":
            self.outcome.occurred[str(event["kind"])] += 1
        if event["event"] == "write":
            by_release, words = self.asked
            self.by_release = by_release and (self.through_copy or words == event["registers"])
        opens = event["event"] in OPENINGS and event.get("held", True)
        activating = event["event"] == "released" and self.emulator.registers.stage is not ActivationStage.READY
        if opens and not self.by_release and not activating:
            self.outcome.opened.append("; ".join(str(entry) for entry in list(self.emulator.log)[-8:]))

    async def run(self, commands: int) -> None:
        """Do a number of commands; the line is quiet again afterwards."""
        await self.emulator.start()
        self.gripper = self._driver()
        self._jaws.object_mm = 41.2
        await self._open_again()
        for name in self.emulator.faults.kinds:
            self.emulator.faults.set(name, PROBABILITY / (4 if self.through_copy else 1))
        for _ in range(commands):
            self.outcome.commands += 1
            (name,) = self.rng.choices(list(MIX), list(MIX.values()))
            await getattr(self, f"_{name.replace(' ', '_')}")()
            await asyncio.sleep(self.rng.uniform(0.0, 0.02))
        self.emulator.control("clear")
        await self.gripper.close()
        await self.emulator.stop()

    @property
    def _jaws(self) -> SimpleJaws:
        assert isinstance(self.emulator.jaws, SimpleJaws)
        return self.emulator.jaws

    def _force_n(self) -> float:
        return self.rng.uniform(self.model.force_min_n, self.model.force_max_n)

    def _look(self) -> JawsState:
        return self.emulator.registers.tick(asyncio.get_running_loop().time())

    async def _call(self, ask: Callable[[], Awaitable[object]]) -> object:
        """One call as the daemon makes it: what is lost is opened again; None where it failed."""
        try:
            return await self._timed(ask)
        except CommandRefused:
            self.outcome.refused += 1
        except DeviceLost:
            self.outcome.failed += 1
            await self._open_again()
        except DeviceError:
            self.outcome.failed += 1
        return None

    async def _timed(self, ask: Callable[[], Awaitable[object]]) -> object:
        """How long a call took is noted, but where it activated the gripper."""
        loop = asyncio.get_running_loop()
        began_s, activations = loop.time(), self.emulator.registers.activations
        stalled_s = self.outcome.stalled_till(began_s)
        try:
            return await ask()
        finally:
            if self.emulator.registers.activations == activations:
                now_s = loop.time()
                took_s = now_s - began_s - (self.outcome.stalled_till(now_s) - stalled_s)
                self.outcome.longest_s = max(self.outcome.longest_s, took_s)

    async def _open_again(self) -> None:
        await self.gripper.close()
        for _ in range(100):
            try:
                await self._timed(self.gripper.open)
            except DeviceError:
                await self.gripper.close()
                await asyncio.sleep(0.05)
            else:
                return
        raise AssertionError("the gripper does not come back")

    async def _state(self) -> None:
        began_s = asyncio.get_running_loop().time()
        self.truths = self.truths[-4:]
        state = await self._call(self.gripper.state)
        if isinstance(state, GripperState):
            self.outcome.states += 1
            said = [truth for truth in self.truths if truth.at_s >= began_s]
            if self.through_copy:  # of up to one refresh ago, and the position may be older than the rest
                said = [truth for truth in self.truths if truth.at_s >= began_s - COPY_S]
                said = [replace(new, width_mm=old.width_mm) for new in said for old in said]
            if not any(agree(state, truth, executed=not self.through_copy) for truth in said):
                self.outcome.wrong.append(f"{state} but {said}")

    async def _hold(self) -> None:
        force_n = self._force_n()
        applied_n = await self._call(lambda: self.gripper.hold(force_n))
        if isinstance(applied_n, float) and applied_n < force_n - 1e-6:
            self.outcome.wrong.append(f"asked for {force_n} N, believes {applied_n} N")

    async def _move(self) -> None:
        width_mm, force_n = self.rng.uniform(0.0, self.model.stroke_mm), self._force_n()
        await self._call(lambda: self.gripper.move(width_mm, force_n))

    async def _release(self) -> None:
        width_mm = self.rng.uniform(0.5, 1.0) * self.model.stroke_mm

        async def release() -> None:
            """A gripper that was not active is activated afterwards, with empty jaws."""
            token = RELEASING.set(True)
            try:
                await self.gripper.release(width_mm)
                if (await self.gripper.state()).auto_released:
                    self._jaws.object_mm = None
                    await self.gripper.activate()
            finally:
                RELEASING.reset(token)

        await self._call(release)

    async def _give_up(self) -> None:
        """A caller that is cancelled in the middle of its call."""

        async def impatient() -> object:
            force_n = self._force_n()
            call = self.gripper.hold(force_n) if self.rng.random() < 0.5 else self.gripper.state()
            try:
                return await asyncio.wait_for(call, self.rng.uniform(0.0, 0.03))
            except TimeoutError:
                return None

        await self._call(impatient)

    async def _restart(self) -> None:
        """The daemon dies and another comes: what is held stays held, as firmly as before."""
        await self.gripper.close()
        before = await self._rest()
        holding = before.holds and self.emulator.registers.stage in (ActivationStage.READY, ActivationStage.OFF)
        self.outcome.restarts_holding += holding
        self.gripper = self._driver()
        await self._open_again()
        await self._state()
        if holding and self._look().force_n < before.force_n:
            self.outcome.loosened.append(f"{before} became {self._look()}")

    async def _rest(self) -> JawsState:
        """The jaws when they have come to rest; seen from outside, the line is not asked."""
        for _ in range(1000):
            if not (view := self._look()).moving:
                return view
            await asyncio.sleep(0.01)
        raise AssertionError("the jaws do not come to rest")

    async def _object(self) -> None:
        """Put another object between open jaws."""
        view = self._look()
        if not view.holds and not view.moving and view.width_mm > 10.0:
            self._jaws.object_mm = self.rng.uniform(5.0, view.width_mm - 1.0)
        await asyncio.sleep(0)


def usual_width_mm(figures: GripperFigures, count: int) -> float:
    """Return the width at a position if the fingers stop where they usually do."""
    open_count, closed_count = figures.counts
    share = min(max((count - open_count) / (closed_count - open_count), 0.0), 1.0)
    return figures.stroke_mm * (1.0 - share)


def agree(state: GripperState, truth: Truth, *, executed: bool = True) -> bool:
    """Whether a state is what the gripper was like.

    executed: the newest command has certainly reached the gripper; otherwise its force counts once the fingers rest.

    `holding` may be said of jaws halted on their way, and denied only of jaws that are said to move. `moving` may be
    said until gOBJ belongs to the newest command.
    """
    view = truth.view
    if state.active != truth.ready or abs(state.width_mm - truth.width_mm) > STEP_MM:
        return False
    if truth.ready and truth.going and view.moving and not state.moving:
        return False
    if not truth.ready and view.moving and not state.moving:
        return False  # an activation
    if truth.ready and state.moving and not truth.going:
        return False
    if truth.ready and not view.moving and view.holds and not (state.holding or state.moving):
        return False
    if state.holding and not view.holds and truth.going:
        return False
    if state.closed_on_nothing and view.holds:
        return False
    resting = not view.moving and view.holds and state.holding and (executed or not state.moving)
    return not resting or state.force_n <= view.force_n + STEP_N


async def watch_stalls(outcome: Outcome) -> None:
    """Add up by how much the loop comes too late."""
    loop = asyncio.get_running_loop()
    while True:
        outcome.due_s = loop.time() + TICK_S
        await asyncio.sleep(TICK_S)
        outcome.stalled_s = outcome.stalled_till(loop.time())


async def campaign(folder: Path, commands: int, seed: int, wiring: str, lanes: int = 6) -> Outcome:
    """A number of commands in all, on several grippers at once."""
    outcome = Outcome(due_s=asyncio.get_running_loop().time())
    each = -(-commands // lanes)
    stalls = asyncio.create_task(watch_stalls(outcome), name="stalls")
    async with asyncio.TaskGroup() as group:
        for lane in range(lanes):
            one = Lane(folder, seed * 100 + lane, outcome, LANE_MODELS[lane % len(LANE_MODELS)], wiring)
            group.create_task(one.run(each), name=f"lane {lane}")
    stalls.cancel()
    await asyncio.wait([stalls])
    return outcome
