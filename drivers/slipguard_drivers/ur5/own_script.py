"""Whether the program on the controller is the control script that this driver has uploaded.

The controller does not say whose program runs, so the script is followed: from its upload until a packet says that no
program runs. A program that runs later is another user's, and is never ended.

A script that a stop has paused outlasts a lost connection and a restart of the daemon. It is recognized by its mark:
three output registers, which only a program on the controller can write, and which keep their values. Closing the arm
clears the mark, but a script that ended otherwise leaves it. So a mark alone proves nothing: the program must be paused
(a running script without its watchdog's signals ends within half a second), no packet may have said that it ended, and
either a safety stop is still active, or this driver lost the connection to it.
"""

from __future__ import annotations

import asyncio
import math

from slipguard.errors import DeviceLost
from slipguard_drivers.ur5.state_monitor import PAUSED, PAUSING, STOPPED, RobotState, StateMonitor

MARK = (0.5165, 0.8337, 0.2741)
"""Arbitrary. The script writes it with `pose_trans`, a command of ur-rtde that writes registers and moves nothing."""
MARK_TOLERANCE = 1e-6

START_S = 0.2
"""An uploaded script may start this much later; until then, a stopped program proves nothing."""


class OwnScript:
    """The script of one arm. ends_within_s: the robot's watchdog ends an abandoned script within this time."""

    def __init__(self, monitor: StateMonitor, ends_within_s: float) -> None:
        self._monitor = monitor
        self._ends_within_s = ends_within_s
        self._controlled_since_s = math.inf
        self._until_s = -math.inf
        """A running or paused program may be the script until then, ..."""
        self._stopped_after_s = -math.inf
        """... unless a packet later than this said that no program runs."""
        self._connection_lost = False
        """Whether the connection to the script was lost, and nothing is known of the script since."""

    @property
    def has_ended(self) -> bool:
        """Whether a packet said since the script was under control that no program runs."""
        return self._monitor.stopped_at_s > self._controlled_since_s

    @property
    def safety_stopped(self) -> bool:
        """Whether a safety stop was active since the script was under control, however short."""
        return self._monitor.safety_stop_at_s > self._controlled_since_s

    @property
    def may_run(self) -> bool:
        """Whether a program that runs or is paused after the driver has lost control is the script."""
        if self._monitor.stopped_at_s > self._stopped_after_s:
            return False
        return asyncio.get_running_loop().time() < self._until_s or self._is_recognized()

    @property
    def can_be_lost(self) -> bool:
        """Whether the script was uploaded and has not ended, so that a lost arm may still move."""
        return self._until_s == math.inf and not self.has_ended

    def forget_if_stopped(self) -> None:
        """Forget an abandoned script if no program runs now."""
        if asyncio.get_running_loop().time() > self._stopped_after_s and self._monitor.newest.runtime == STOPPED:
            self.forget()

    def forget(self) -> None:
        """Treat every program from now on as another user's."""
        self._until_s, self._connection_lost = -math.inf, False

    def uploading(self) -> None:
        """Note that the script is about to be uploaded."""
        self._until_s, self._stopped_after_s, self._connection_lost = math.inf, -math.inf, False

    def controlled(self) -> None:
        """Note that the driver controls the arm, or monitors it, from now on."""
        self._controlled_since_s = asyncio.get_running_loop().time()

    def paused(self) -> None:
        """Note that a safety stop has paused the script, for as long as a person needs."""
        self._until_s, self._stopped_after_s = math.inf, self._controlled_since_s

    def still_paused(self) -> bool:
        """Return whether the script may still be paused; if so, it stays the driver's until it has ended."""
        if not self.may_run:
            return False
        self._until_s = math.inf
        return self._monitor.newest.runtime != STOPPED

    def abandon(self, *, starting: bool = False) -> None:
        """Leave the script to the watchdog: until that has ended it, a running program counts as the script."""
        now_s = asyncio.get_running_loop().time()
        self._stopped_after_s = now_s + START_S * starting
        self._until_s = now_s + self._ends_within_s
        self._connection_lost = True

    def _is_recognized(self) -> bool:
        """Return whether a paused script of this driver is found on the controller, by its mark."""
        try:
            state = self._monitor.newest
        except DeviceLost:
            return False
        paused = state.runtime in (PAUSING, PAUSED)
        return paused and is_marked(state) and (state.safety_stop or self._connection_lost)


def is_marked(state: RobotState) -> bool:
    """Return whether the newest script that wrote the registers is this driver's; it may have ended since."""
    pairs = zip(state.registers, MARK, strict=True)
    return all(math.isclose(value, mark, rel_tol=0.0, abs_tol=MARK_TOLERANCE) for value, mark in pairs)
