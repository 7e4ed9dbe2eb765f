"""A robot program on the emulated robot that lifts what the gripper holds, independent of slipguard."""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum

from slipguard_emulators.ur5.script import PROGRAM_STOP_M_S2, RobotProgram
from slipguard_emulators.ur5.tool import ToolPlant

ACCELERATION_M_S2 = 1.0


class LiftStage(Enum):
    """Stage of the program."""

    WAITING = "waiting"
    UP = "up"
    STAYING = "staying"
    DOWN = "down"
    DONE = "done"


class LiftProgram(RobotProgram):
    """When an object was held for `wait_s`: lift, stay, lower; again after a release.

    held: returns whether the gripper holds an object. height_m, speed_m_s: of the lift.
    """

    def __init__(
        self,
        tool: ToolPlant,
        held: Callable[[], bool],
        *,
        height_m: float,
        speed_m_s: float,
        wait_s: float = 1.5,
        stay_s: float = 2.0,
    ) -> None:
        self.name = "pick.urp"
        self.stage = LiftStage.WAITING
        self._tool = tool
        self._held = held
        self._height_m, self._speed_m_s = height_m, speed_m_s
        self._wait_s, self._stay_s = wait_s, stay_s
        self._since_s: float | None = None
        self._low: list[float] = []

    def cycle(self, now_s: float) -> str | None:
        """Execute one cycle; the program never ends by itself."""
        held, at_rest = self._held(), not self._tool.under_way(now_s)
        if self.stage is LiftStage.WAITING:
            self._since_s = None if not held else self._since_s if self._since_s is not None else now_s
            if self._since_s is not None and now_s - self._since_s >= self._wait_s:
                self._low = list(self._tool.pose(now_s))
                self._go(LiftStage.UP, now_s)
        elif self.stage is LiftStage.UP and at_rest:
            self.stage, self._since_s = LiftStage.STAYING, now_s
        elif self.stage is LiftStage.STAYING and self._since_s is not None and now_s - self._since_s >= self._stay_s:
            self._go(LiftStage.DOWN, now_s)
        elif self.stage is LiftStage.DOWN and at_rest:
            self.stage = LiftStage.DONE
        elif self.stage is LiftStage.DONE and not held:
            self.stage, self._since_s = LiftStage.WAITING, None
        return None

    def pause(self, now_s: float) -> None:
        """Brake."""
        self._tool.stop(now_s, PROGRAM_STOP_M_S2)

    def resume(self, now_s: float) -> None:
        """Continue the interrupted motion."""
        if self.stage in (LiftStage.UP, LiftStage.DOWN):
            self._go(self.stage, now_s)

    def _go(self, stage: LiftStage, now_s: float) -> None:
        self.stage = stage
        goal = list(self._low)
        goal[2] += self._height_m if stage is LiftStage.UP else 0.0
        self._tool.move(now_s, goal, self._speed_m_s, ACCELERATION_M_S2)
