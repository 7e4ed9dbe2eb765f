"""How an object is held, and the fault latched, kept on the disk for whoever starts next.

A killed daemon comes back, knows the force and whether the gripper had taken it, and is still in FAULT if it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Protocol

import structlog

from slipguard.control.fault import Fault
from slipguard.control.state import AT_STAKE, GraspState, Phase, RememberedGrip, force_applied
from slipguard.control.step import ControlState
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.store.disk_writer import DiskWriter
from slipguard.daemon.store.state_dir import LastGrasp
from slipguard.errors import SlipguardError

GOOD_FOR = timedelta(hours=1)
"""A grip older than this is somebody else's by now; a fault stays latched until it is cleared, however old."""
AGAIN_S = 300.0
"""A grip that does not change is noted down again after this time: it is its age that tells it from somebody else's."""
CHANGE_MM = 0.5
NOTHING = RememberedGrip(0.0, 0.0)
log = structlog.get_logger()


class Shelf(Protocol):
    """Where the last grasp is kept; may raise SlipguardError."""

    def save_last_grasp(self, last: LastGrasp) -> None: ...

    def load_last_grasp(self) -> LastGrasp | None: ...

    def forget_last_grasp(self) -> None: ...


def remembered(shelf: Shelf, now: datetime | None = None) -> ControlState:
    """The law's memory at a start; a damaged or old file counts as none, and a damaged one is said."""
    try:
        last = shelf.load_last_grasp()
    except SlipguardError as error:
        log.error("last grasp", why=str(error))
        return ControlState()
    if last is None:
        return ControlState()
    grasp = GraspState()
    if (now or datetime.now(UTC)) - last.saved_at <= GOOD_FOR:
        grip = RememberedGrip(last.force_n, last.width_mm, last.applied) if last.force_n > 0.0 else None
        grasp = replace(grasp, remembered=grip, person_near=last.person_near)
    if last.fault is not None:
        grasp = replace(
            grasp,
            phase=Phase.FAULT,
            fault=last.fault,
            release_requested=last.release_requested,
            closing_interrupted=last.closing_interrupted,
        )
    return ControlState(grasp)


@dataclass(frozen=True, slots=True)
class _Note:
    """What the shelf is to hold: of the grip only where there is one."""

    grip: RememberedGrip | None = None
    person_near: bool = False
    fault: Fault | None = None
    release_requested: bool = False
    closing_interrupted: bool = False

    @property
    def latched(self) -> tuple[Fault | None, bool, bool]:
        """The fault, and what goes with it."""
        return self.fault, self.release_requested, self.closing_interrupted


class LastGraspSaver:
    """Watches decisions and keeps the shelf up to date, in a thread: the loop never waits for the disk."""

    def __init__(self, shelf: Shelf, say: Callable[[str], None], warn: Callable[[str], None]) -> None:
        self._shelf = shelf
        self._disk = DiskWriter("last grasp", "the grip", say, warn)
        self._kept = _Note()
        self._known = False
        self._noted_at_s = 0.0

    def decided(self, decision: Decision) -> None:
        """To be called after every turn of the loop."""
        if self._disk.busy:
            return  # a later turn will do
        grasp, gripper, fault = decision.memory.grasp, decision.observation.gripper, decision.command.fault
        held = decision.phase in AT_STAKE or decision.phase is Phase.FAULT
        note = _Note(None, grasp.person_near)
        if fault is not None:
            note = replace(
                note,
                fault=fault,
                release_requested=grasp.release_requested,
                closing_interrupted=grasp.closing_interrupted,
            )
        if held and gripper is not None and gripper.holding and not gripper.moving and grasp.target_n > 0.0:
            self._keep(
                replace(note, grip=RememberedGrip(grasp.target_n, gripper.width_mm, force_applied(grasp, gripper))),
                decision,
            )
        elif not held and gripper is not None and not gripper.holding:
            self._keep(_Note(), decision)
        elif note.latched != self._kept.latched:
            # What is held cannot be told just now; what was held is as good as before.
            self._keep(replace(note, grip=self._kept.grip if self._known else grasp.remembered), decision)

    def _keep(self, note: _Note, decision: Decision) -> None:
        same = self._known and not _differs(note, self._kept)
        old = note.grip is not None and decision.now_s - self._noted_at_s >= AGAIN_S
        if same and not old and not self._disk.due:
            return
        self._kept, self._known, self._noted_at_s = note, True, decision.now_s
        self._disk.begin(lambda: self._write(note))

    def _write(self, note: _Note) -> None:
        if note.grip is None and note.fault is None:
            self._shelf.forget_last_grasp()
            return
        grip = note.grip or NOTHING
        self._shelf.save_last_grasp(
            LastGrasp(
                saved_at=datetime.now(UTC),
                force_n=grip.force_n,
                width_mm=grip.width_mm,
                applied=grip.applied,
                person_near=note.person_near,
                fault=note.fault,
                release_requested=note.release_requested,
                closing_interrupted=note.closing_interrupted,
            )
        )


def _differs(one: _Note, other: _Note) -> bool:
    if one.grip is None or other.grip is None:
        return one != other
    moved_mm = abs(one.grip.width_mm - other.grip.width_mm)
    return moved_mm > CHANGE_MM or replace(one, grip=replace(one.grip, width_mm=other.grip.width_mm)) != other
