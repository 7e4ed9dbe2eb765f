"""The programs that an emulated controller can run: ur-rtde's control script, and a user's program.

The control script is not interpreted; its handshake over the registers and its relevant behavior are implemented.
A synchronous `stopL` executes `stopj`, an asynchronous one `stopl`; a second thread that moves the arm ends the script.
"""

from __future__ import annotations

import re
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Protocol

import cv2
import numpy as np

from slipguard_emulators.ur5.tool import ToolPlant

MOVE_L, SPEED_STOP, STOP_L, STOP_J, WATCHDOG, POSE_TRANS, KICK, STOP_SCRIPT = 3, 15, 33, 34, 35, 39, 99, 255
READY, DONE = 1, 2
PROGRAM_STOP_M_S2 = 2.5
"""Deceleration of the arm when a program ends."""


class RobotProgram(Protocol):
    """A program that runs on the controller, cycle by cycle. name: as the dashboard shows it."""

    name: str

    @abstractmethod
    def cycle(self, now_s: float) -> str | None:
        """Execute one cycle; return why the program has ended, or None while it runs."""

    @abstractmethod
    def pause(self, now_s: float) -> None: ...

    @abstractmethod
    def resume(self, now_s: float) -> None: ...


class ShuttleProgram(RobotProgram):
    """A user's program: up and down by `stroke_m`, permanently."""

    def __init__(self, tool: ToolPlant, stroke_m: float = 0.1, speed_m_s: float = 0.1) -> None:
        self.name = "shuttle.urp"
        self._tool = tool
        self._stroke_m, self._speed_m_s = stroke_m, speed_m_s
        self._ends: list[list[float]] = []
        self.trips = 0

    def cycle(self, now_s: float) -> str | None:
        if not self._ends:
            low = list(self._tool.pose(now_s))
            self._ends = [low, [*low[:2], low[2] + self._stroke_m, *low[3:]]]
        if not self._tool.under_way(now_s):
            self.trips += 1
            self.resume(now_s)
        return None

    def pause(self, now_s: float) -> None:
        self._tool.stop(now_s, PROGRAM_STOP_M_S2)

    def resume(self, now_s: float) -> None:
        if self._ends:
            self._tool.move(now_s, self._ends[self.trips % 2], self._speed_m_s, 1.0)


class ControlScript(RobotProgram):
    """ur-rtde's script, from its upload on.

    number: returns an input register by name. on_command: called with each executed command.
    """

    def __init__(
        self,
        text: str,
        tool: ToolPlant,
        number: Callable[[str], float],
        on_command: Callable[[int, str], None],
        now_s: float,
    ) -> None:
        self.name = "<unnamed>"
        offset = re.search(r"reg_offset_int *=[^\d\n]*\n?(\d+)", text)
        self.offset = int(offset[1]) if offset else 0
        self.watchdog_s: float | None = None
        self.last_kick_s = now_s
        self._tool, self._number, self._on_command = tool, number, on_command
        self._answer = READY
        self._result: dict[str, Sequence[float]] = {}
        self._executing: int | None = None
        self._thread: str | None = None
        self._changes = self._operation = 0
        self._motion: tuple[list[float], float, float] | None = None
        self._note(started=False)

    @property
    def heartbeat_name(self) -> str:
        """The register that feeds the watchdog."""
        return f"input_int_register_{self.offset}"

    def outputs(self) -> dict[str, Sequence[float]]:
        """Return the registers that it writes."""
        progress = self._operation << 24 | self._changes << 16 | (self._thread is not None) << 15
        return {
            f"output_int_register_{self.offset}": (self._answer,),
            f"output_int_register_{self.offset + 2}": (progress,),
            **self._result,
        }

    def pause(self, now_s: float) -> None:
        if not self._tool.under_way(now_s):
            self._motion = None
        self._tool.stop(now_s, PROGRAM_STOP_M_S2)

    def resume(self, now_s: float) -> None:
        """Continue the move that was under way; the time in the pause does not count for the watchdog."""
        self.last_kick_s = now_s
        if self._motion is not None:
            self._tool.move(now_s, *self._motion)

    def cycle(self, now_s: float) -> str | None:
        if self.watchdog_s is not None and now_s - self.last_kick_s > self.watchdog_s:
            return "its watchdog received nothing"
        if self._thread is not None and not self._tool.under_way(now_s):
            self._note(started=False)
        command = int(self._number(self.heartbeat_name))
        if command == 0:
            if self._executing is None or not self._busy(now_s):
                self._executing, self._answer = None, READY
            return None
        if self._executing is not None:
            if not self._busy(now_s):
                self._answer = DONE
            return None
        return self._begin(command, now_s)

    def _busy(self, now_s: float) -> bool:
        """Return whether a synchronous command is running."""
        return self._executing in (MOVE_L, STOP_L, STOP_J) and self._thread is None and self._tool.under_way(now_s)

    def _begin(self, command: int, now_s: float) -> str | None:
        self._executing = command
        asynchronous = self._number(f"input_int_register_{self.offset + 1}") == 1
        doubles = [self._number(f"input_double_register_{self.offset + index}") for index in range(12)]
        if command == MOVE_L:
            if self._thread == "stop":
                return "another thread is already controlling the robot"
            self._on_command(command, "movel" + " in a thread" * asynchronous)
            self._motion = (doubles[:6], doubles[6], doubles[7])
            self._tool.move(now_s, *self._motion)
            self._note(started=asynchronous, thread="move")
        elif command in (STOP_L, STOP_J):
            self._on_command(command, "stopl" if command == STOP_L and asynchronous else "stopj")
            self._motion = None
            self._tool.stop(now_s, doubles[0])
            self._note(started=asynchronous, thread="stop")
        elif command == WATCHDOG:
            self._on_command(command, f"watchdog at {doubles[0]:g} Hz")
            self.watchdog_s, self.last_kick_s = 1.0 / doubles[0], now_s
        elif command == POSE_TRANS:
            self._on_command(command, "pose_trans")
            pose = pose_trans(doubles[:6], doubles[6:])
            names = (f"output_double_register_{self.offset + index}" for index in range(6))
            self._result = {name: (value,) for name, value in zip(names, pose, strict=True)}
        elif command == STOP_SCRIPT:
            self._on_command(command, "end")
            return "it was commanded to end"
        else:
            self._on_command(command, f"command {command}")
        if not self._busy(now_s):
            self._answer = DONE
        return None

    def _note(self, *, started: bool, thread: str = "") -> None:
        """Write the progress register: an operation has begun in a thread, or none is running."""
        self._thread = thread if started else None
        self._changes = (self._changes + 1) % 128
        self._operation = (self._operation + started) % 128


def pose_trans(first: Sequence[float], second: Sequence[float]) -> list[float]:
    """Return the pose that is at `second` in the frame `first`, both as position and rotation vector."""
    vectors = (np.array(part) for part in (second[3:], second[:3], first[3:], first[:3]))
    rotation, position = cv2.composeRT(*vectors)[:2]
    return [*map(float, position.ravel()), *map(float, rotation.ravel())]
