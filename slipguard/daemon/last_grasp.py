"""How an object is held, kept on the disk for whoever starts next: a killed daemon comes back and knows the force."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Protocol

import structlog

from slipguard.daemon.decision import Decision
from slipguard.daemon.disk_work import DiskWork
from slipguard.daemon.state_dir import LastGrasp
from slipguard.errors import SlipguardError
from slipguard.grasp.guard import Guard
from slipguard.grasp.state import AT_STAKE, GuardState, Phase, Remembered

GOOD_FOR = timedelta(hours=1)
"""A grip older than this is somebody else's by now."""
AGAIN_S = 300.0
"""A grip that does not change is noted down again after this time: it is its age that tells it from somebody else's."""
CHANGE_MM = 0.5
log = structlog.get_logger()


class Shelf(Protocol):
    """Where the last grasp is kept; may raise SlipguardError."""

    def save_last_grasp(self, last: LastGrasp) -> None: ...

    def load_last_grasp(self) -> LastGrasp | None: ...

    def forget_last_grasp(self) -> None: ...


def remembered(shelf: Shelf, now: datetime | None = None) -> Guard:
    """The law's memory at a start; a damaged or old file counts as none, and a damaged one is said."""
    try:
        last = shelf.load_last_grasp()
    except SlipguardError as error:
        log.error("last grasp", why=str(error))
        return Guard()
    if last is None or (now or datetime.now(UTC)) - last.saved_at > GOOD_FOR:
        return Guard()
    return Guard(GuardState(remembered=Remembered(last.force_n, last.width_mm), person_near=last.person_near))


class GraspKeeper:
    """Watches decisions and keeps the shelf up to date, in a thread: the loop never waits for the disk."""

    def __init__(self, shelf: Shelf, say: Callable[[str], None]) -> None:
        self._shelf = shelf
        self._disk = DiskWork("last grasp", "the grip", say)
        self._kept: Remembered | None = None
        self._near = False
        self._known = False
        self._noted_at_s = 0.0

    def decided(self, decision: Decision) -> None:
        """To be called after every turn of the loop."""
        gripper, target_n = decision.seen.gripper, decision.memory.law.target_n
        if gripper is None or self._disk.busy:
            return  # not known, or the disk is busy: a later turn will do
        held = decision.phase in AT_STAKE or decision.phase is Phase.FAULT
        if held and gripper.holding and not gripper.moving and target_n > 0.0:
            self._keep(Remembered(target_n, gripper.width_mm), decision.memory.law.person_near, decision.now_s)
        elif not held and not gripper.holding:
            self._keep(None, False, decision.now_s)

    def _keep(self, grip: Remembered | None, person_near: bool, now_s: float) -> None:
        same = self._known and person_near is self._near and not _differs(grip, self._kept)
        old = grip is not None and now_s - self._noted_at_s >= AGAIN_S
        if same and not old and not self._disk.due:
            return
        self._kept, self._near, self._known, self._noted_at_s = grip, person_near, True, now_s
        self._disk.begin(lambda: self._write(grip, person_near))

    def _write(self, grip: Remembered | None, person_near: bool) -> None:
        if grip is None:
            self._shelf.forget_last_grasp()
        else:
            now, force_n, width_mm = datetime.now(UTC), grip.force_n, grip.width_mm
            self._shelf.save_last_grasp(
                LastGrasp(saved_at=now, force_n=force_n, width_mm=width_mm, person_near=person_near)
            )


def _differs(one: Remembered | None, other: Remembered | None) -> bool:
    if one is None or other is None:
        return one is not other
    return one.force_n != other.force_n or abs(one.width_mm - other.width_mm) > CHANGE_MM
