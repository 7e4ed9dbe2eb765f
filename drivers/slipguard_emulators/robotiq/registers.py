"""The controller of a 2F or Hand-E gripper behind its registers; written from the manual, without code of the driver.

It reproduces what matters to a driver:

* A rising edge of rACT activates: the jaws open and close fully, at full speed and force, so an object falls. Each
  activation calibrates the counts of the position again (Robotiq's knowledge base, "encoder bytes": about 3 open and
  230 closed; the manual's own example shows 13 open).
* A loss of power sets rACT, and it must be cleared and set again before the gripper works (manual, rACT). Until then
  gSTA is 0 and gFLT 5 (ros-industrial/robotiq, issue 202). The screw keeps the grip, and the position has no reference.
* rATR opens slowly to the end of the stroke if rARD is set with it, and closes otherwise. It overrides everything but
  rACT. gFLT is 0x0B meanwhile and 0x0F afterwards; then the gripper must be reset and activated (manual, rATR, rARD).
  rATR together with a rising edge of rACT is not documented: here it is the worse of both, an activation.
* A new force acts only while the motor runs: at rest, only a stop and then a go start it. The force setting is
  overridden for a short time when a motion begins (3-Finger manual, FORCE); see `SimpleJaws`.
* If an object yields or is lost while rGTO is set, the fingers close on, unless the force is 0 (manual: re-grasp).
* Written registers take effect once per cycle, so a stop and a go within one cycle have no effect.
* gOBJ keeps its former value for a time after a go, and while rGTO is 0 it has an arbitrary value, for the manual says
  to ignore it then.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

from slipguard_emulators.robotiq.jaws import JawsPlant, JawsState

OUTPUTS = range(0x03E8, 0x03EB)
INPUTS = range(0x07D0, 0x07D3)
CYCLE_S = 0.005
"""The manual: 200 Hz is the usual speed."""
OBJECT_LAG_MAX_S = 0.2
"""From a go to the gOBJ that belongs to it; Robotiq's SDK waits this long for motion."""
SILENT_S = 1.0
"""After this time without a request, fault 0x09 is reported."""
OPEN_SPREAD, CLOSED_SPREAD = 10, 5
"""Counts by which a calibration may differ from the usual one: upward when open, both ways when closed."""
UNREFERENCED_COUNTS = 20
"""Counts by which the position may be off between a loss of power and the next activation; an assumption."""
IMMOBILE = frozenset({0x0A, 0x0C})
"""gFLT with which nothing moves: supply voltage too low, internal fault; an assumption."""
RACT, RGTO, RATR, RARD = 0x01, 0x08, 0x10, 0x20


@dataclass(frozen=True, slots=True)
class GripperFigures:
    """Data of one model: stroke, lowest and highest force and speed.

    counts: positions at which the open and the closed fingers stop, of 0 to 255.
    """

    stroke_mm: float
    force_n: tuple[float, float]
    speed_mm_s: tuple[float, float]
    counts: tuple[int, int] = (3, 230)


FIGURES = {
    "2F-85": GripperFigures(85.0, (20.0, 235.0), (20.0, 150.0)),
    "2F-140": GripperFigures(140.0, (10.0, 125.0), (30.0, 250.0)),
    "Hand-E": GripperFigures(50.0, (20.0, 185.0), (20.0, 150.0), (0, 255)),
}


class ActivationStage(Enum):
    """Progress of the activation; gSTA is 0 at OFF and RELEASING, 3 at READY, 1 in between."""

    OFF = "off"
    RELEASING = "automatic release"
    OPENING = "opening"
    CLOSING = "closing"
    REOPENING = "reopening"
    READY = "ready"


class GripperRegisters:
    """The registers and the controller behind them.

    note(event, **details): called with every event. quick: speed of the motion relative to a real gripper. seed: of the
    lags of gOBJ and of the calibrations.
    """

    def __init__(
        self, jaws: JawsPlant, figures: GripperFigures, note: Callable[..., None], quick: float = 1.0, seed: int = 0
    ) -> None:
        rng = random.Random(seed)
        self.jaws = jaws
        self.figures = figures
        self.fault = 0
        """gFLT to report in addition to those that follow from the registers."""
        self.stage = ActivationStage.OFF
        self.activations = 0
        self.outputs = [0, 0, 0]
        self.action_after_power_loss = RACT
        """rACT is set by a loss of power, as the manual says; 0 for a unit that starts reset."""
        self.draw_lag_s: Callable[[], float] = lambda: rng.uniform(0.0, OBJECT_LAG_MAX_S)
        """Draws the lag of gOBJ, for each go."""
        self.counts = figures.counts
        """Positions at which the open and the closed fingers stop, by the newest calibration."""
        self._unreferenced = 0
        """Counts by which the position is off since the newest loss of power."""
        self._calibrations = random.Random(seed + 1)
        self._draw_object: Callable[[], int] = lambda: rng.randrange(4)
        self._former_object = 0
        """gOBJ before the newest go or stop."""
        self._ignored_object = 0
        """gOBJ while rGTO is 0."""
        self._object_due_s = 0.0
        """From then on gOBJ belongs to the newest go."""
        self._note = note
        self._quick = quick
        self._written: tuple[float, list[int]] | None = None
        self._last_request_s: float | None = None
        self._pressed_n = 0.0

    def write(self, now_s: float, address: int, values: Sequence[int]) -> float:
        """Receive register values; return when they will take effect."""
        self.tick(now_s)
        merged = list(self._written[1] if self._written is not None else self.outputs)
        merged[address - OUTPUTS[0] : address - OUTPUTS[0] + len(values)] = values
        due_s = math.ceil(now_s / CYCLE_S) * CYCLE_S
        self._written = (due_s, merged)
        return due_s

    def read(self, now_s: float) -> list[int]:
        """Return the three input registers."""
        view = self.tick(now_s)
        action = self.outputs[0] >> 8
        on = bool(action & RACT)
        state = {ActivationStage.OFF: 0, ActivationStage.RELEASING: 0, ActivationStage.READY: 3}.get(self.stage, 1)
        flags = on | bool(action & RGTO) << 3 | state << 4 | self._object(now_s, view) << 6
        current = 30 if view.moving else 0
        echo = self.outputs[1] & 0xFF
        return [flags << 8, self._fault_code(now_s) << 8 | echo, self._count(view.width_mm) << 8 | current]

    def tick(self, now_s: float) -> JawsState:
        """Advance to `now_s`."""
        if self._written is not None and now_s >= self._written[0]:
            due_s, values = self._written
            self._written = None
            self._apply(due_s, values)
        view = self.jaws.state_at(now_s)
        self._continue_activation(now_s, view)
        self._grasp_again(now_s, view)
        if not view.moving and view.force_n != self._pressed_n:
            what = "empty" if not view.holds else "tightened" if self._pressed_n else "gripped"
            self._pressed_n = view.force_n
            self._note(what, width_mm=round(view.width_mm, 2), force_n=round(view.force_n, 2))
        return view

    def request_received(self, now_s: float) -> None:
        """Note that a request has arrived."""
        self._last_request_s = now_s

    def lose_power(self, now_s: float) -> None:
        """Reset everything but the screw."""
        self._note("power lost", held=self.jaws.state_at(now_s).holds)
        self.jaws.halt(now_s)
        self.power_up()

    def power_up(self) -> None:
        """Start as after power-on: not active, and with a position that has no reference."""
        self.outputs, self._written, self.stage, self.fault = (
            [self.action_after_power_loss << 8, 0, 0],
            None,
            ActivationStage.OFF,
            0,
        )
        self._unreferenced = self._calibrations.randint(-UNREFERENCED_COUNTS, UNREFERENCED_COUNTS)

    def _apply(self, now_s: float, values: list[int]) -> None:
        former_object = self._object(now_s, self.jaws.state_at(now_s))
        old, self.outputs = self.outputs, values
        was, action = old[0] >> 8, values[0] >> 8
        if was & RGTO:
            self._former_object = former_object
        if was & RGTO and not action & RGTO:
            self._ignored_object = self._draw_object()
        if was & RACT and not action & RACT:
            self._note("rACT cleared", held=self.jaws.state_at(now_s).holds)
            self.jaws.halt(now_s)
            self.stage, self.fault = ActivationStage.OFF, 0
        elif action & RACT and not was & RACT:
            self._activate(now_s)
        elif action & RACT and action & RATR:
            if not was & RATR and self.fault not in IMMOBILE:
                self.stage = ActivationStage.RELEASING
                self._drive(now_s, 0 if action & RARD else 255, 0, 0)
        elif self.stage is ActivationStage.READY:
            self._act(now_s, old, values)

    def _activate(self, now_s: float) -> None:
        self.activations += 1
        self._note("activating", held=self.jaws.state_at(now_s).holds)
        self.stage = ActivationStage.OPENING
        self._drive(now_s, 0, 255, 255)

    def _continue_activation(self, now_s: float, view: JawsState) -> None:
        if view.moving or self.stage in (ActivationStage.OFF, ActivationStage.RELEASING, ActivationStage.READY):
            return
        if self.stage is ActivationStage.OPENING:
            self.stage = ActivationStage.CLOSING
            self._drive(now_s, 255, 255, 255)
        elif self.stage is ActivationStage.CLOSING:
            self.stage = ActivationStage.REOPENING
            self._drive(now_s, 0, 255, 255)
        else:
            self.stage = ActivationStage.READY
            self._calibrate()
            self._note("activated")

    def _calibrate(self) -> None:
        opened, closed = self.figures.counts
        draw = self._calibrations.randint
        self.counts = opened + draw(0, OPEN_SPREAD), min(closed + draw(-CLOSED_SPREAD, CLOSED_SPREAD), 255)
        self._unreferenced = 0

    def _grasp_again(self, now_s: float, view: JawsState) -> None:
        """Close on where an object has yielded or is gone."""
        action, position, motion = self.outputs[0] >> 8, self.outputs[1] & 0xFF, self.outputs[2]
        if self.stage is not ActivationStage.READY or not action & RGTO or not motion & 0xFF:
            return
        if not view.moving and not view.holds and self._count(view.width_mm) < self._reachable(position) - 1:
            self._note("grasping again", width_mm=round(view.width_mm, 2))
            self._drive(now_s, position, motion >> 8, motion & 0xFF)

    def _act(self, now_s: float, old: list[int], new: list[int]) -> None:
        was, action = old[0] >> 8, new[0] >> 8
        if not action & RGTO:
            if was & RGTO:
                self.jaws.halt(now_s)
            return
        moving = self.jaws.state_at(now_s).moving
        if not was & RGTO or old[1] & 0xFF != new[1] & 0xFF or (moving and old[2] != new[2]):
            self._object_due_s = now_s + self.draw_lag_s()
            self._drive(now_s, new[1] & 0xFF, new[2] >> 8, new[2] & 0xFF)

    def _drive(self, now_s: float, position: int, speed: int, force: int) -> None:
        view = self.jaws.state_at(now_s)
        width_mm = self._width_mm(position)
        if width_mm > view.width_mm and view.holds:
            self._note("released", width_mm=round(view.width_mm, 2))
        low, high = self.figures.speed_mm_s
        speed_mm_s = (low + (high - low) * speed / 255) * self._quick
        low, high = self.figures.force_n
        force_n = low + (high - low) * force / 255
        self._note("drive", width_mm=round(width_mm, 2), force_n=round(force_n, 2))
        self.jaws.drive(now_s, width_mm, speed_mm_s, force_n)

    def _object(self, now_s: float, view: JawsState) -> int:
        """gOBJ."""
        if self.stage is not ActivationStage.READY:
            return 0
        if not self.outputs[0] >> 8 & RGTO:
            return self._ignored_object
        if now_s < self._object_due_s:
            return self._former_object
        if view.moving:
            return 0
        if view.met_closing:
            return 2
        return 3 if abs(self._count(view.width_mm) - self._reachable(self.outputs[1] & 0xFF)) <= 1 else 0

    def _fault_code(self, now_s: float) -> int:
        """gFLT."""
        if self.stage is ActivationStage.RELEASING:
            return 0x0B if self.jaws.state_at(now_s).moving else 0x0F
        if self.fault:
            return self.fault
        action = self.outputs[0] >> 8
        if action & RGTO and not action & RACT:
            return 0x07
        if action & RACT and self.stage is ActivationStage.OFF:
            return 0x05
        if action & RGTO and self.stage is not ActivationStage.READY:
            return 0x05
        silent = self._last_request_s is not None and now_s - self._last_request_s > SILENT_S
        return 0x09 if silent else 0

    def _count(self, width_mm: float) -> int:
        """gPO."""
        share, (open_count, closed_count) = 1.0 - width_mm / self.figures.stroke_mm, self.counts
        return min(max(round(open_count + share * (closed_count - open_count)) + self._unreferenced, 0), 255)

    def _width_mm(self, count: int) -> float:
        open_count, closed_count = self.counts
        share = (self._reachable(count) - open_count) / (closed_count - open_count)
        return self.figures.stroke_mm * (1.0 - share)

    def _reachable(self, count: int) -> int:
        """Return the position nearest to a requested one at which the fingers can stop."""
        open_count, closed_count = self.counts
        return min(max(count, open_count), closed_count)
