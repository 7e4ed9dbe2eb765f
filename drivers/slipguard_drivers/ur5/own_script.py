"""Whether the program on the controller is the control script that this driver has uploaded.

The controller does not say whose program runs, so the script is followed: from its upload until a packet says that no
program runs. A program that runs later is another user's, and is never ended.
"""

from __future__ import annotations

import asyncio
import math

from slipguard_drivers.ur5.state_monitor import STOPPED, StateMonitor

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
        now_s = asyncio.get_running_loop().time()
        return now_s < self._until_s and self._monitor.stopped_at_s <= self._stopped_after_s

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
        self._until_s = -math.inf

    def uploading(self) -> None:
        """Note that the script is about to be uploaded."""
        self._until_s, self._stopped_after_s = math.inf, -math.inf

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
