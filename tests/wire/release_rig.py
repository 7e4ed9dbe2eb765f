"""Controller, gripper task, real driver and emulated gripper on a virtual clock: a held object is released.

Requests are lost by their number since the release. Everything the jaws do is in `widths_mm`, as the emulator knows it.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass

from slipguard.control.control_step import ControlState, control_step
from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.messages import (
    NO_REQUEST,
    ActivateGripper,
    ControlRequest,
    HoldForce,
    Observation,
    ReleaseJaws,
    RequestKind,
)
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault
from slipguard.control.state import Phase
from slipguard.daemon.loop.actuator import Actuator
from slipguard.devices import ArmState, DriverContext, GripperState
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_drivers.robotiq.registers import MODELS
from slipguard_emulators.robotiq.emulator import RobotiqEmulator
from slipguard_emulators.robotiq.jaws import SimpleJaws

CYCLE_S = 0.02
SEEN_AFTER_S = 0.04
"""From an image to its estimate."""
GEL_MM = 0.5
"""The gels yield by this, so a finger sees contact a little longer than the gripper holds."""
RELEASED = ("released", "released_arm_unknown")


class MemoryLine:
    """The serial line of the driver and the port of the emulator in one: bytes arrive at once, in both directions."""

    def __init__(self, emulator: RobotiqEmulator, on_bytes: Callable[[bytes], None]) -> None:
        self._emulator, self._on_bytes = emulator, on_bytes
        self.is_open, self.plugged, self.plugs, self.path = True, True, 0, "memory"

    async def open(self) -> None:
        self.is_open = True

    async def settled(self) -> bool:
        return True

    def close(self) -> None:
        self.is_open = False

    def write(self, data: bytes) -> None:
        asyncio.get_running_loop().call_soon(self._emulator._on_bytes, data)

    def receive(self) -> None:
        """Nothing waits to be read."""

    def plug(self) -> None:
        """Always there."""

    def unplug(self) -> None:
        """Always there."""

    def send(self, data: bytes, plug: int) -> None:
        if self.is_open:
            asyncio.get_running_loop().call_soon(self._on_bytes, data)


@dataclass(frozen=True)
class Report:
    """A message about the release, with what was true then."""

    name: str
    text: str
    gained_mm: float
    touched: bool
    state: GripperState | None


class ReleaseRig:
    """One gripper that holds an object, and the controller that releases it.

    lost: by number of a request since the release: "deaf" (never arrives), "silence" (its answer is lost) or "power"
    (the gripper loses its power when it arrives).
    """

    def __init__(self, model: str, lost: Mapping[int, str] | None = None) -> None:
        self.emulator = RobotiqEmulator(
            RobotiqEmulator.Settings.model_validate(
                {"model": model, "baud": 0, "response_ms": 0.0, "activated": True, "quick": 5.0}
            )
        )
        settings = RobotiqGripper.Settings(port="memory", model=model, approach_speed=1.0)
        self.gripper = RobotiqGripper(settings, DriverContext("gripper"))
        line = MemoryLine(self.emulator, self.gripper._transport._on_bytes)
        self.emulator._port = self.gripper._transport._line = line  # type: ignore[assignment]
        self.emulator._occurs = self._occurs  # type: ignore[method-assign]
        self.object_mm = 0.5 * MODELS[model].stroke_mm
        self.actuator = Actuator("gripper", self.gripper, 0.025, 0.5, lambda: None, self._on_refusal)
        self.control = ControlState()
        self.emergency = False
        self.refusals: list[str] = []
        self.reports: list[Report] = []
        self.widths_mm: list[float] = []
        self.forces_n: list[float] = []
        self._lost = dict(lost or {})
        self._number: int | None = None
        """Of the newest request since the release; None before it."""
        self._contacts: list[tuple[float, bool]] = []
        self._request = NO_REQUEST

    @property
    def phase(self) -> Phase:
        return self.control.grasp.phase

    @property
    def fault(self) -> Fault | None:
        return self.control.grasp.fault

    @property
    def jaws(self) -> SimpleJaws:
        assert isinstance(self.emulator.jaws, SimpleJaws)
        return self.emulator.jaws

    async def run(self, story: Callable[[ReleaseRig], Awaitable[None]], *, gripped: bool = True) -> None:
        """Grip the object, or have the jaws open, then do what the story says."""
        await self.emulator.start()
        self.jaws.object_mm = self.object_mm
        tasks = [asyncio.create_task(self.actuator.run()), asyncio.create_task(self._cycles())]
        try:
            await self.until(lambda: self.actuator.newest is not None)
            if gripped:
                self.ask(RequestKind.GRASP)
                await self.until(lambda: self.phase is Phase.HOLDING)
            await story(self)
            for task in tasks:
                if task.done():
                    task.result()
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            with contextlib.suppress(Exception):
                await self.emulator.stop()

    def ask(self, kind: RequestKind) -> None:
        self._request = ControlRequest(kind)

    async def release(self, *, again: bool = False) -> None:
        """Request it and wait until it has ended; the requests are counted from here on."""
        if not again:
            self._number = -1
            self.widths_mm, self.forces_n = [], []
        self._watch()
        self.ask(RequestKind.RELEASE)
        await self.until(lambda: self.phase is Phase.RELEASED)
        await self.until(lambda: self.phase is not Phase.RELEASED)

    async def until(self, question: Callable[[], bool], longest_s: float = 20.0) -> None:
        """Wait until it becomes true."""
        loop = asyncio.get_running_loop()
        ends_s = loop.time() + longest_s
        while not question():
            await asyncio.sleep(CYCLE_S)
            assert loop.time() < ends_s, f"not reached: {self.phase}, {self.fault}, {self.refusals[-1:]}"

    def lose_power(self) -> None:
        """The 24 V are gone for a moment."""
        self.emulator.registers.lose_power(asyncio.get_running_loop().time())

    def _occurs(self, fault: str) -> bool:
        if fault == "freeze" and self._number is not None:  # the first question about each request
            self._number += 1
        return self.emulator.faults.lasts(fault) or (self._number is not None and self._lost.get(self._number) == fault)

    def _on_refusal(self, reason: str) -> None:
        self.refusals.append(reason)

    def _watch(self) -> None:
        view = self.jaws.state_at(asyncio.get_running_loop().time())
        self.widths_mm.append(view.width_mm)
        self.forces_n.append(view.force_n)

    async def _cycles(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            now_s = loop.time()
            self.emulator.registers.tick(now_s)
            self._watch()
            view = Observation(
                now_s, fused=self._seen(now_s), gripper=self.actuator.newest, arm=self._arm(now_s),
                request=self._request,
            )  # fmt: skip
            self._request = NO_REQUEST
            self.control, output = control_step(self.control, view, GuardParams())
            touched = self._contacts[-1][1]
            for message in output.messages:
                gained_mm = self.widths_mm[-1] - min(self.widths_mm)
                self.reports.append(Report(message.name, message.text, gained_mm, touched, view.gripper))
            match output.gripper:
                case HoldForce(force_n=force_n):
                    self.actuator.command(lambda force_n=force_n: self.gripper.hold(force_n))  # type: ignore[misc]
                case ReleaseJaws(width_mm=width_mm):
                    release = lambda width_mm=width_mm: self.gripper.release(width_mm)  # noqa: E731
                    self.actuator.command(release, urgent=True)
                case ActivateGripper():
                    self.actuator.command(self.gripper.activate)
            await asyncio.sleep(CYCLE_S)

    def _seen(self, now_s: float) -> FusedEstimate:
        """What both fingers see, a little late."""
        view = self.jaws.state_at(now_s)
        self._contacts.append((now_s, view.width_mm <= self.object_mm + GEL_MM and self.jaws.object_mm is not None))
        at_s, touched = next((one for one in reversed(self._contacts) if one[0] <= now_s - SEEN_AFTER_S), (0.0, False))
        if not touched:
            return FusedEstimate(False, False, at_s, at_s, declined="no contact")
        return FusedEstimate(True, True, at_s, at_s, ("left", "right"), 0.0, 0.5, 0.0, 0.0)

    def _arm(self, now_s: float) -> ArmState:
        return ArmState(0.0, 0.0, False, False, self.emergency, now_s)


def check_never_narrower(rig: ReleaseRig) -> None:
    """Since the release was requested."""
    narrowed = max((before - after for before, after in zip(rig.widths_mm, rig.widths_mm[1:], strict=False)), default=0)
    assert narrowed <= 1e-9, f"the jaws closed by {narrowed:.2f} mm"
    assert max(rig.forces_n) <= rig.forces_n[0] + 1e-9, "the jaws pressed harder"
    assert rig.emulator.registers.activations == 0
    assert not math.isnan(rig.widths_mm[-1])


def check_reports(rig: ReleaseRig) -> None:
    """What is reported as released is."""
    for one in rig.reports:
        if one.name in RELEASED:
            assert one.gained_mm > 1.0, one
            assert not one.touched, one
            assert one.state is not None
            assert one.state.active or one.state.auto_released, one
