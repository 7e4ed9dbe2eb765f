"""When a daemon can observe a fault, and whether the log has named it by then.

A fault is unnamed if it was observable for `WITHIN_S` in total and no log line since its begin names it with its
device. It is observable while the daemon runs, unless:
- a more severe fault of the same device hides it (`RANKS`), or one that cancels it, or the sensor is being reopened;
- light and mirrored images: nothing is held, so a finger's estimate does not count; mirrored images also until both
  fingers have seen more than `OBSERVABLE_DEG`, and if both are mirrored, because they agree then;
- a stuck arm: until it has gained no height for `stuck_timeout_s` although commanded to move;
- an object taken away: no camera shows the empty fingers, and the jaws have not closed yet or the gripper does not
  respond; nor if the guard was not holding it;
- a killed daemon: until the next one has read the gripper's state, if it holds something.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from slipguard.control.state import AT_STAKE, MOVING, Phase
from tests.campaigns.faults.campaign_cell import CampaignCell
from tests.campaigns.faults.kinds import RANKS, PlannedFault

WITHIN_S = 0.5
OBSERVABLE_DEG = 2.0
SLACK_S = 0.011
"""One cycle of the loop and of the observer."""
GUARDED = frozenset({Phase.LIFTING, Phase.HOLDING, Phase.LOWERING})
_NO_IMAGE = frozenset({"disconnect", "stall", "corrupt", "frozen", "stamps_ahead", "stamps_behind", "light"})


@dataclass(slots=True)
class NoProgress:
    """An arm that should move but does not: since when, and at which height."""

    since_s: float = 0.0
    height_mm: float = 0.0


@dataclass(slots=True)
class MonitoredFault:
    """One fault since its begin. observable_s: how long it was observable so far."""

    plan: PlannedFault
    began_s: float
    observable_s: float = 0.0
    named_after_s: float | None = None
    active: bool = True
    held: bool = False
    """The guard was holding the object when the fault began."""
    no_progress: NoProgress = field(default_factory=NoProgress)

    @property
    def due(self) -> bool:
        """Whether it had to be named: it was observable, at least until it was named."""
        return self.plan.kind.must_be_named and (self.observable_s > 0.0 or self.named_after_s is not None)

    @property
    def unnamed(self) -> bool:
        """Whether it was observable for long enough and not named in that time."""
        after_s = self.observable_s if self.named_after_s is None else self.named_after_s
        return self.due and after_s > WITHIN_S + SLACK_S

    def read_line(self, line: str) -> None:
        """Check whether a log line names the fault."""
        kind = self.plan.kind
        if kind.must_be_named and self.named_after_s is None and kind.words.search(line):
            self.named_after_s = self.observable_s

    def update(self, cell: CampaignCell, passed_s: float) -> None:
        """Add the time passed, if the fault was observable and not named."""
        if self.active and self.named_after_s is None and cell.alive and is_observable(self, cell):
            self.observable_s += passed_s


def is_observable(fault: MonitoredFault, cell: CampaignCell) -> bool:
    """Return whether a daemon could observe the fault now."""
    kind, service = fault.plan.kind, cell.service
    if kind.device in ("left", "right"):
        return _camera(kind.device, kind.fault, cell)
    if kind.device in ("gripper", "arm"):
        if _hidden(kind.device, kind.fault, cell):
            return False
        return kind.fault != "stuck" or _stuck(fault.no_progress, cell)
    if kind.device == "object":
        return fault.held and (_camera_shows_nothing(cell) or _jaws_closed(cell))
    if kind.device == "daemon":
        gripper = service.gripper.newest
        return gripper is not None and gripper.holding
    return True


def _camera(finger: str, fault: str, cell: CampaignCell) -> bool:
    if fault == "duplicate" or _hidden(finger, fault, cell):
        return False
    if fault != "disconnect" and cell.service.fingers[finger].health.state == "disconnected":
        return False
    held = cell.service.phase in GUARDED or (cell.service.phase is Phase.FAULT and cell.service.state.grip.closed)
    if fault == "light":
        return held
    if fault == "mirrored":
        return held and len(cell.mirrored) == 1 and _both_rotated(cell)
    return True


def _hidden(device: str, fault: str, cell: CampaignCell) -> bool:
    active = set(cell.world.faults.active(device))
    if {"stamps_ahead", "stamps_behind"} <= active and fault.startswith("stamps"):
        return True  # they cancel each other
    rank = RANKS[device]
    return fault in rank and any(severe in active for severe in rank[: rank.index(fault)])


def _both_rotated(cell: CampaignCell) -> bool:
    newest = [finger.newest for finger in cell.service.fingers.values()]
    rotations = [abs(one.estimate.rotation_deg or 0.0) for one in newest if one is not None]
    observation = cell.service.observation
    both = observation is not None and observation.fused is not None and len(observation.fused.fingers) == 2
    return both and len(rotations) == 2 and min(rotations) > OBSERVABLE_DEG


def _stuck(no_progress: NoProgress, cell: CampaignCell) -> bool:
    """Return whether the arm was commanded to move and has kept its height for `stuck_timeout_s`."""
    service = cell.service
    moves = service.phase in MOVING and service.state.held.slip is None and service.arm.newest is not None
    height_mm = cell.truth.height_mm
    if not moves or abs(height_mm - no_progress.height_mm) >= 1.0:
        no_progress.since_s, no_progress.height_mm = cell.now_s, height_mm
    return cell.now_s - no_progress.since_s >= cell.params.guard.tuning.stuck_timeout_s


def _camera_shows_nothing(cell: CampaignCell) -> bool:
    """Return whether at least one camera works and none shows a false contact."""
    clear = 0
    for finger in ("left", "right"):
        faults = cell.world.faults.active(finger)
        if "light" in faults and not faults & {"disconnect", "stall", "corrupt", "frozen"}:
            return False
        clear += not faults & _NO_IMAGE and cell.service.fingers[finger].health.ready
    return clear > 0


def _jaws_closed(cell: CampaignCell) -> bool:
    gripper = cell.service.gripper.newest
    return gripper is not None and cell.service.gripper.health.ready and gripper.closed_on_nothing


def holding(cell: CampaignCell) -> bool:
    """Return whether the guard holds an object, or assumes so."""
    phase, state = cell.service.phase, cell.service.state
    return cell.alive and (
        (phase in AT_STAKE and phase is not Phase.CLOSING) or (phase is Phase.FAULT and state.grip.closed)
    )
