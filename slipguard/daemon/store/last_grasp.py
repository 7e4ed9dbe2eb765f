"""How an object is held, and the latched fault, kept on the disk for a restart.

A killed daemon comes back, knows the force and whether the gripper had applied it, and is still in FAULT if it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import datetime
from typing import Protocol

import structlog

from slipguard.control.control_step import ControlState
from slipguard.control.reports import Fault
from slipguard.control.state import (
    AT_STAKE,
    Adoption,
    GraspState,
    HandsOff,
    PersonNear,
    Phase,
    RememberedGrip,
    force_applied,
)
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.store.dated_file import save_time
from slipguard.daemon.store.disk_writer import DiskWriter
from slipguard.daemon.store.state_dir import LastGrasp
from slipguard.devices import GripperState
from slipguard.errors import SlipguardError

REFRESH_S = 300.0
"""A grip that does not change is saved again after this time, because its age decides whether it is used."""
WIDTH_STEP_MM = 0.5
"""A smaller change of the width is not saved."""
NO_GRIP = RememberedGrip(0.0, 0.0)
log = structlog.get_logger()


class LastGraspStore(Protocol):
    """Where the last grasp is stored, as in `StateDir`; may raise SlipguardError."""

    def save_last_grasp(self, last: LastGrasp) -> None: ...

    def load_last_grasp(self) -> LastGrasp | None: ...

    def delete_last_grasp(self) -> None: ...


def restore_control_state(
    store: LastGraspStore, now: datetime | None = None, warning: Callable[[str], object] = log.warning
) -> ControlState:
    """Return the controller's state for a start: the default if nothing was stored.

    A fault stays latched until it is cleared, at any age. If the file is old or damaged, something may still be held.

    Args:
        store: Where the grasp is stored.
        now: See `DatedFile.outdated`.
        warning: Receives one line if the file is old or damaged.
    """
    try:
        last = store.load_last_grasp()
    except SlipguardError as error:
        warning(
            f"it is unknown what was held before the restart: {error}. What the gripper holds is kept; if it reports "
            "nothing, check the jaws"
        )
        return ControlState(GraspState(adoption=Adoption(outdated=True)))
    if last is None:
        return ControlState()
    grasp = GraspState()
    outdated = last.outdated(now)
    if outdated is not None:
        warning(f"the grip from before the restart is not used: {outdated}")
        grasp = replace(grasp, adoption=Adoption(outdated=last.force_n > 0.0 or last.may_hold))
    else:
        known = RememberedGrip(last.force_n, last.width_mm, last.applied, last.lift_start_mm, last.force_limit_n)
        grip = known if last.force_n > 0.0 else None
        adoption = Adoption(remembered=grip, outdated=last.may_hold)
        grasp = replace(grasp, adoption=adoption, person=PersonNear(last.person_near))
    if last.fault is not None:
        grasp = replace(
            grasp,
            phase=Phase.FAULT,
            fault=last.fault,
            hands_off=HandsOff(last.release_requested, last.closing_interrupted),
            person=PersonNear(last.person_near),
        )
    return ControlState(grasp)


@dataclass(frozen=True, slots=True)
class _SavedGrasp:
    """What is stored. grip: None if nothing is held, or it is not known how; then may_hold is set."""

    grip: RememberedGrip | None = None
    may_hold: bool = False
    person_near: bool = False
    fault: Fault | None = None
    release_requested: bool = False
    closing_interrupted: bool = False

    @property
    def latched(self) -> tuple[Fault | None, bool, bool]:
        """The fault, and what belongs to it."""
        return self.fault, self.release_requested, self.closing_interrupted


class LastGraspSaver:
    """Observes decisions and saves the grasp in a thread, so that the loop never waits for the disk.

    Args:
        store: Where the grasp is stored.
        info: Receives the recovery of the disk.
        warning: Receives failures of the disk.
    """

    def __init__(self, store: LastGraspStore, info: Callable[[str], None], warning: Callable[[str], None]) -> None:
        self._store = store
        self._disk = DiskWriter("last grasp", "the grip", info, warning)
        self._saved = _SavedGrasp()
        self._known = False
        self._saved_at_s = 0.0

    def add_decision(self, decision: Decision) -> None:
        """Save what has changed; to be called after every cycle of the loop."""
        if self._disk.busy:
            return  # a later cycle will do
        grasp, gripper, fault = decision.state_before.grasp, decision.observation.gripper, decision.output.fault
        held = decision.phase in AT_STAKE or decision.phase is Phase.FAULT
        new = _SavedGrasp(person_near=grasp.person.forbids_force)
        if fault is not None:
            new = replace(
                new,
                fault=fault,
                release_requested=grasp.hands_off.release_requested,
                closing_interrupted=grasp.hands_off.closing_interrupted,
            )
        if held and gripper is not None and gripper.holding and not gripper.moving and grasp.grip.target_n > 0.0:
            applied = force_applied(grasp, gripper)
            held_by = grasp.grip
            grip = RememberedGrip(held_by.target_n, gripper.width_mm, applied, grasp.arm.start_mm, held_by.limit_n)
            self._save(replace(new, grip=grip), decision)
        elif not held and _nothing_held(grasp, gripper):
            self._save(_SavedGrasp(), decision)
        elif new.latched != self._saved.latched:
            # Whether something is held is unknown now, so the last known grip stays.
            last = self._saved.grip if self._known else grasp.adoption.remembered
            self._save(replace(new, grip=last, may_hold=grasp.adoption.outdated), decision)

    def _save(self, new: _SavedGrasp, decision: Decision) -> None:
        same = self._known and not _differs(new, self._saved)
        old = new.grip is not None and decision.now_s - self._saved_at_s >= REFRESH_S
        if same and not old and not self._disk.due:
            return
        self._saved, self._known, self._saved_at_s = new, True, decision.now_s
        self._disk.begin(lambda: self._write(new))

    def _write(self, new: _SavedGrasp) -> None:
        if new == _SavedGrasp(person_near=new.person_near):
            self._store.delete_last_grasp()
            return
        grip = new.grip or NO_GRIP
        self._store.save_last_grasp(
            LastGrasp(
                **save_time(),
                force_n=grip.force_n,
                width_mm=grip.width_mm,
                applied=grip.applied,
                may_hold=new.may_hold,
                person_near=new.person_near,
                lift_start_mm=grip.lift_start_mm,
                force_limit_n=grip.limit_n,
                fault=new.fault,
                release_requested=new.release_requested,
                closing_interrupted=new.closing_interrupted,
            )
        )


def _nothing_held(grasp: GraspState, gripper: GripperState | None) -> bool:
    """Return whether it is certain that nothing is held; not while a grip from before a restart is undecided."""
    decided = grasp.adoption.done and not grasp.adoption.outdated
    return decided and gripper is not None and not gripper.holding


def _differs(one: _SavedGrasp, other: _SavedGrasp) -> bool:
    if one.grip is None or other.grip is None:
        return one != other
    moved_mm = abs(one.grip.width_mm - other.grip.width_mm)
    return moved_mm > WIDTH_STEP_MM or replace(one, grip=replace(one.grip, width_mm=other.grip.width_mm)) != other
