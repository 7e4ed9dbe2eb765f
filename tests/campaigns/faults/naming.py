"""When a fault can be seen by a daemon that looks well, and whether the log has named it by then.

A fault counts as unnamed when it could be seen for `WITHIN_S`, added up, and no line since its beginning names it with
its device. It can be seen while the daemon runs, and unless:
- a graver fault of the same device hides it (`RANKS`), or one that undoes it, or the sensor is being opened again;
- light and mirrored pictures: nothing is held, for only then does a finger's word count; mirrored ones also until both
  fingers have seen more than `TELLING_DEG`, and if both are, for then they agree;
- an arm that is stuck: until it has gained no height for `stuck_timeout_s` though it was told to, which is what stuck means;
- an object that was taken: no camera shows the empty fingers, and the jaws have not yet closed or the gripper is not
  heard; nor where the guard was not holding it;
- a killed daemon: until the next one has heard the gripper, if it holds something.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from slipguard.control.state import AT_STAKE, MOVING, Phase
from tests.campaigns.faults.kinds import RANKS, PlannedFault
from tests.campaigns.faults.rig import CampaignCell

WITHIN_S = 0.5
TELLING_DEG = 2.0
SLACK_S = 0.011
"""One turn of the loop, and of who looks at it."""
GUARDED = frozenset({Phase.LIFTING, Phase.HOLDING, Phase.LOWERING})
_BLINDS = frozenset({"disconnect", "stall", "corrupt", "frozen", "stamps_ahead", "stamps_behind", "light"})


@dataclass(slots=True)
class Standing:
    """An arm that should move: since when, and at which height."""

    since_s: float = 0.0
    height_mm: float = 0.0


@dataclass(slots=True)
class WatchedFault:
    """One fault from its beginning on. seen_s: how long it could be seen so far."""

    plan: PlannedFault
    began_s: float
    seen_s: float = 0.0
    named_after_s: float | None = None
    active: bool = True
    held: bool = False
    """The guard was holding the object as it was taken."""
    standing: Standing = field(default_factory=Standing)

    @property
    def due(self) -> bool:
        """It had to be named: it could be seen, were it for no longer than it took to name it."""
        return self.plan.kind.needs_a_name and (self.seen_s > 0.0 or self.named_after_s is not None)

    @property
    def unnamed(self) -> bool:
        """Could be seen for long enough, and was not named in that time."""
        after_s = self.seen_s if self.named_after_s is None else self.named_after_s
        return self.due and after_s > WITHIN_S + SLACK_S

    def hear(self, line: str) -> None:
        """A line of the log."""
        kind = self.plan.kind
        if kind.needs_a_name and self.named_after_s is None and kind.words.search(line):
            self.named_after_s = self.seen_s

    def look(self, rig: CampaignCell, passed_s: float) -> None:
        """`passed_s` more have passed."""
        if self.active and self.named_after_s is None and rig.alive and can_be_seen(self, rig):
            self.seen_s += passed_s


def can_be_seen(watched: WatchedFault, rig: CampaignCell) -> bool:
    """Whether a daemon that looks well could see it now."""
    kind, service = watched.plan.kind, rig.service
    if kind.device in ("left", "right"):
        return _camera(kind.device, kind.fault, rig)
    if kind.device in ("gripper", "arm"):
        if _hidden(kind.device, kind.fault, rig):
            return False
        return kind.fault != "stuck" or _stuck(watched.standing, rig)
    if kind.device == "object":
        return watched.held and (_camera_shows_nothing(rig) or _jaws_closed(rig))
    if kind.device == "daemon":
        gripper = service.gripper.newest
        return gripper is not None and gripper.holding
    return True


def _camera(finger: str, fault: str, rig: CampaignCell) -> bool:
    if fault == "duplicate" or _hidden(finger, fault, rig):
        return False
    if fault != "disconnect" and rig.service.fingers[finger].health.state == "disconnected":
        return False
    held = rig.service.phase in GUARDED or (rig.service.phase is Phase.FAULT and rig.service.state.gripped)
    if fault == "light":
        return held
    if fault == "mirrored":
        return held and len(rig.mirrored) == 1 and _both_rotated(rig)
    return True


def _hidden(device: str, fault: str, rig: CampaignCell) -> bool:
    active = set(rig.world.faults.active(device))
    if {"stamps_ahead", "stamps_behind"} <= active and fault.startswith("stamps"):
        return True  # they cancel
    rank = RANKS[device]
    return fault in rank and any(graver in active for graver in rank[: rank.index(fault)])


def _both_rotated(rig: CampaignCell) -> bool:
    newest = [finger.newest for finger in rig.service.fingers.values()]
    rotations = [abs(one.estimate.angle_deg or 0.0) for one in newest if one is not None]
    observation = rig.service.observation
    both = observation is not None and observation.fused is not None and len(observation.fused.fingers) == 2
    return both and len(rotations) == 2 and min(rotations) > TELLING_DEG


def _stuck(standing: Standing, rig: CampaignCell) -> bool:
    """Told to move, and at one height for `stuck_timeout_s`."""
    service = rig.service
    moves = service.phase in MOVING and service.state.slip is None and service.arm.newest is not None
    height_mm = rig.truth.height_mm
    if not moves or abs(height_mm - standing.height_mm) >= 1.0:
        standing.since_s, standing.height_mm = rig.now_s, height_mm
    return rig.now_s - standing.since_s >= rig.params.guard.tuning.stuck_timeout_s


def _camera_shows_nothing(rig: CampaignCell) -> bool:
    """One camera at least is well, and none claims a contact that is not there."""
    clear = 0
    for finger in ("left", "right"):
        faults = rig.world.faults.active(finger)
        if "light" in faults and not faults & {"disconnect", "stall", "corrupt", "frozen"}:
            return False
        clear += not faults & _BLINDS and rig.service.fingers[finger].health.ready
    return clear > 0


def _jaws_closed(rig: CampaignCell) -> bool:
    gripper = rig.service.gripper.newest
    return gripper is not None and rig.service.gripper.health.ready and gripper.closed_on_nothing


def holding(rig: CampaignCell) -> bool:
    """The guard holds something, or believes so."""
    phase, state = rig.service.phase, rig.service.state
    return rig.alive and (
        (phase in AT_STAKE and phase is not Phase.CLOSING) or (phase is Phase.FAULT and state.gripped)
    )
