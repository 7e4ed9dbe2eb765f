"""Decide from successive statuses whether the fingers hold an object, have closed on nothing, or may still move.

gOBJ alone does not say it. After a command it may keep its former value for up to 200 ms, although the gripper has
accepted the command already (it echoes the position), and it means nothing while gGTO is 0. So gOBJ counts only after
it has shown motion since the command, or after these 200 ms. Until then the fingers count as moving, and what was held
before counts as held. At gOBJ 3 ("at requested position, no object detected, or it was lost or dropped") the fingers
may be apart although they were to close: they still close where an object was lost, or stand without having gripped
one. Their position says which. Source: Robotiq 2F-85/2F-140 instruction manual (gOBJ, gGTO) and Robotiq's C++ SDK (the
lag).
"""

from __future__ import annotations

from slipguard_drivers.robotiq.registers import (
    CALIBRATION_COUNTS,
    CLOSED_COUNT,
    FingerMotion,
    RobotiqModel,
    RobotiqStatus,
    count_to_width,
    nothing_between,
)

OBJECT_LAG_S = 0.2
"""Longest time from an accepted command to the gOBJ that belongs to it."""
STANDS_S = 0.5
"""Fingers whose position stays the same for this time stand; at the lowest speed a count takes 20 ms."""
YIELD_MM = 1.1
YIELD_COUNTS_MIN = 3
"""Fingers that press an object move by at most this much while the force rises."""


class ObjectDetection:
    """What the statuses since the connection was opened say together."""

    def __init__(self, model: RobotiqModel, settle_s: float = 0.0) -> None:
        """settle_s: from a command that the status shows to its arrival in the gripper, at most."""
        self._model = model
        self._lag_s = OBJECT_LAG_S + settle_s
        self._yield_counts = max(YIELD_COUNTS_MIN, round(YIELD_MM / model.mm_per_count))
        self.forget()

    def forget(self) -> None:
        """Forget everything: the connection is new, or the gripper was reset."""
        self.moving = False
        """Whether the fingers move, or may be about to."""
        self.holding = False
        """Whether an object is held, also while the force on it rises, or may be held by halted fingers."""
        self.closed_on_nothing = False
        self.gripped_at: int | None = None
        """Position at which an object was held; None if none is known to be."""
        self._newest: RobotiqStatus | None = None
        self._motion: FingerMotion | None = None
        """gOBJ in the newest status with gGTO set."""
        self._was_moving = False
        """Whether the fingers were moving when the present command was accepted."""
        self._decided = False
        self._decided_at_s = 0.0
        """When gOBJ certainly belongs to the present command."""
        self._same_since_s = 0.0
        """Since when the fingers have had the same position and the same command."""

    def update(self, status: RobotiqStatus, now_s: float) -> None:
        """Use one more status."""
        if not status.ready:
            self.forget()
            return
        newest = self._newest
        if newest is None or (newest.going, newest.position) != (status.going, status.position):
            self._same_since_s = now_s
        if status.going:
            self._follow_command(status, now_s)
        self.moving = status.going and self._may_move(status, now_s)
        self.holding = self._may_hold(status)
        # Gels that press on each other are nothing at once, while the force still rises.
        known = not self.moving or self._model.fingertip_mm > 0.0
        self.closed_on_nothing = known and not self.holding and self._is_closed(status)
        if not self.holding:
            self.gripped_at = None
        elif status.stopped_on_object and (self._decided or self._newest is None):
            self.gripped_at = status.position
        self._newest = status

    def _follow_command(self, status: RobotiqStatus, now_s: float) -> None:
        """Find out whether gOBJ belongs to the present command."""
        newest = self._newest
        if newest is None or not newest.going or newest.position_echo != status.position_echo:
            self._decided, self._decided_at_s, self._same_since_s = False, now_s + self._lag_s, now_s
            self._was_moving = self._motion is FingerMotion.MOVING
        seen = status.motion is FingerMotion.MOVING and not self._was_moving
        self._decided = self._decided or seen or now_s >= self._decided_at_s
        self._motion = status.motion

    def _may_move(self, status: RobotiqStatus, now_s: float) -> bool:
        if not self._decided or status.motion is FingerMotion.MOVING:
            return True
        arrived_early = status.motion is FingerMotion.AT_POSITION and status.position_echo >= self._model.goal_count
        if not arrived_early or self._is_closed(status):
            return False
        return now_s - self._same_since_s < STANDS_S  # they may have lost an object and go on closing

    def _may_hold(self, status: RobotiqStatus) -> bool:
        inward = status.position_echo > status.position
        known = self.gripped_at is not None and abs(status.position - self.gripped_at) <= self._yield_counts
        if not status.going:
            return inward and (known or not self._is_closed(status))
        meaningful = self._decided or self._newest is None
        if meaningful and status.motion is not FingerMotion.MOVING:
            gels_met = self._model.fingertip_mm > 0.0 and self._is_closed(status)
            return status.stopped_on_object and (known or not gels_met)  # a soft object may yield until the gels meet
        return inward and known

    def _is_closed(self, status: RobotiqStatus) -> bool:
        """Return whether the fingers were to close fully, and have; `RobotiqModel` says how exactly."""
        closing = status.position_echo >= self._model.goal_count
        if closing and nothing_between(count_to_width(status.position, self._model)):
            return True
        at_end = status.going and status.motion is FingerMotion.AT_POSITION and status.position_echo == CLOSED_COUNT
        return at_end and status.position >= self._model.closed_count - CALIBRATION_COUNTS
