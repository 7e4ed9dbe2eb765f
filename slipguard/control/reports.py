"""What the controller reports to people: messages, refusals and faults. Every text stands here, with an identifier."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, StrEnum

AFTER_INTERRUPTION = "with no hand near the jaws, grasp again; or support what is between them, then release"


@dataclass(frozen=True, slots=True)
class Message:
    """One line for log and page. name: its identifier, which does not depend on the figures."""

    name: str
    text: str

    def __str__(self) -> str:
        return self.text


class Text(Enum):
    """The texts of messages and refusals, with places for values."""

    # the grip
    CLOSING = "closing with {force_n:.0f} N"
    CLOSED_ON_NOTHING = "the gripper closed on nothing"
    GRIPPED = "gripped"
    HOLDING = "holding with {force}, rotation estimated"
    HOLDING_BY_ONE_FINGER = "holding with {force}, rotation estimated by one finger only ({note})"
    GRIPPING_FOR_CONTACT = (
        "a contact of {radius_mm:.1f} mm radius needs {needed_n:.0f} N: gripping with {force_n:.0f} N"
    )
    NO_ESTIMATE = "no rotation estimate ({why})"
    NO_ESTIMATE_GRIP = "no rotation estimate ({why}): gripping with {force_n:.0f} N"
    GUARDING_FOUND = "an object is held with {force}: guarding"
    # slip
    TIGHTENING = "{what}: tightening from {from_n:.0f} N to {to_n:.0f} N"
    AT_FORCE_LIMIT = "{what}: {force_n:.0f} N is the force limit"
    SETTLED = "settled at {force_n:.0f} N"
    # after a restart
    WAITING_FOR_FINGER = "an object is already held with {force}: waiting for a finger"
    TAKEN_OVER = "an object is already held with {force}: taken over as it is"
    TAKEN_OVER_WITH_KNOWN_FORCE = (
        "an object is already held with {force}: taken over with the {known_n:.0f} N from before the restart"
    )
    TAKEN_OVER_AND_REPEATED = (
        "an object is already held with {force}: taken over; the {known_n:.0f} N requested before the restart "
        "are commanded again"
    )
    NOT_HELD_ANY_MORE = (
        "before the restart an object was held with {known_n:.0f} N at {width_mm:.0f} mm; the gripper reports none now"
    )
    # the arm
    LIFTING = "lifting by {height_mm:g} mm"
    LOWERING = "lowering by {height_mm:.0f} mm"
    ARRIVED = "at {height_mm:.0f} mm, holding"
    ARM_CONTINUES = "the arm continues"
    PUTTING_DOWN = "putting the object down by {height_mm:.0f} mm"
    PUT_DOWN = "put down where the lift began; support it if it can tip over, then release it"
    PUT_DOWN_STOPPED = "putting down stopped"
    NOT_PUT_DOWN_AFTER_STOP = "not put down: stopped by request"
    NO_WAY_DOWN = "not put down: the height where the lift began is unknown"
    STOPPED = "stopped by request"
    STOPPED_CLOSING = STOPPED + "; the closing was interrupted: " + AFTER_INTERRUPTION
    STOPPED_RELEASING = STOPPED + "; the jaws open all the same, as requested before"
    JAWS_HALTED = "a person may be near: the moving jaws are halted"
    # release
    RELEASING = "releasing, as requested"
    RELEASING_WHEN_ARM_STANDS = "releasing, as requested: when the arm stands, after {wait_s:g} s at the latest"
    RELEASED = "released: the jaws have opened from {from_mm:.0f} to {to_mm:.0f} mm, and no finger sees contact"
    RELEASED_ARM_UNKNOWN = RELEASED + "; the arm has not reported that it stands"
    NOTHING_RELEASED = "nothing was held; the jaws are {to_mm:.0f} mm apart"
    ACTIVATE_NEXT = "before the next grasp the gripper must be activated: {hint}"
    # activation
    ACTIVATING = "activating the gripper: the jaws open and close fully"
    # guarding
    GUARDING = "guarding"
    GUARDING_IN_FAULT = "guarding; the fault stays latched until it is cleared"
    GUARDING_HELD = "guarding the object held with {force}"
    WILL_GUARD = "will guard the next object that is gripped"
    NOT_GUARDING = "not guarding: slip has no effect on grip and arm"
    # another program's grip
    MOVING_JAWS = "moving the jaws to {width_mm:g} mm with {force_n:.0f} N"
    MOVING_JAWS_UNGUARDED = MOVING_JAWS + "; an object they grip is not guarded until `guard on`"
    HOLDING_AS_REQUESTED = "holding with {force_n:.0f} N, as requested"
    HOLDING_UNGUARDED = HOLDING_AS_REQUESTED + "; not guarded until `guard on`"
    # clear
    CLEARED_EMPTY = "cleared; nothing is held"
    CLEARED_INACTIVE = "cleared; no finger sees contact, and the gripper is not active: {hint}"
    CLEARED_INTERRUPTED = "cleared; the closing was interrupted: " + AFTER_INTERRUPTION
    CLEARED_HOLDING = "cleared; holding with {force}"
    # the fingers
    FINGER_NOTE = "{note}"
    FINGER_NOTE_OVER = "no longer: {note}"
    CONTACT_LATE = (
        "{fingers}: contact was seen {late_s:.2f} s after the grip: check whether the images are late (camera, cable)"
    )
    # refusals
    FAULT_LATCHED = "a fault is latched ({code}); clear it first"
    NOT_IN_PHASE = "cannot {verb} while {phase}; {hint}"
    NOT_IN_GUARD_MODE = "cannot {verb}: in guard mode the arm belongs to another program"
    NOT_WHILE_SLIPPING = "cannot {verb}: the object is slipping; wait until it has settled"
    GRIP_NOT_FIRM = "cannot {verb}: the grip is not firm yet; retry in a moment"
    ARM_MISSING = "cannot {verb}: the arm is not connected; see its health in `slipguard ctl state`"
    ARM_STATE_OLD = (
        "cannot {verb}: the arm's newest state is {age_ms:.0f} ms old, the limit is {limit_ms:.0f} ms; try again, and "
        "check the arm's network cable if it persists"
    )
    NOT_UPRIGHT = (
        "cannot {verb}: the arm is mounted {how}: its accelerometer measures up {tilt_deg:.0f}° from the z axis of its "
        "base, along which it would move, and the limit is {limit_deg:g}°; mount it upright, or let another program "
        "move it ([guard] mode = 'guard')"
    )
    ARM_STOPPED = "cannot {verb}: the arm is in a protective or emergency stop; end that first"
    GRIPPER_MISSING = "the gripper is not connected; see its health in `slipguard ctl state`"
    GRIPPER_NOT_READY = "the gripper is not ready ({why})"
    ALREADY_ACTIVE = "the gripper is already activated"
    MAY_HOLD = (
        "cannot activate: {why}, so an object may be held, and the jaws would close on it and drop it; support it, "
        "then use `slipguard ctl release`, which only opens"
    )
    ALREADY_HELD = "an object is already held; `guard on` guards it; to open the jaws, support it, then release"
    LIMIT_BELOW_GRIPPER = "the force limit of {limit_n:g} N is below the {weakest_n:g} N this gripper applies at least"
    ABOVE_FORCE_LIMIT = "{force_n:g} N is above the force limit of {limit_n:g} N"
    NOT_WITHIN_FORCE_LIMIT = "{force_n:g} N is not within the force limit of {limit_n:g} N"
    NO_ESTIMATE_REFUSED = "no rotation estimate ({why}); grip it elsewhere, or set on_no_estimate = 'grip'"
    WAY_DOWN_UNKNOWN = (
        "the way down is unknown (no lift since it was gripped, or the arm is not above where it began); give a height"
    )
    NOTHING_HELD = "nothing is held; grasp something first"
    NOTHING_HELD_IN_FAULT = "nothing is held; clear, then grasp something first"
    INTERRUPTED = "the closing was interrupted and the jaws apply 0 N; " + AFTER_INTERRUPTION
    INTERRUPTED_IN_FAULT = "the closing was interrupted and the jaws apply 0 N; clear, and " + AFTER_INTERRUPTION
    GIVE_WIDTH_OR_FORCE = "give a width, a force or both"
    GIVE_WIDTH = "nothing is held: give the width the jaws shall move to"
    WOULD_DROP = "an object is held and opening would drop it; support it, then use release"
    NO_FAULT = "no fault is latched"
    BEING_PUT_DOWN = "the object is being put down; clear when the arm stands"
    CAUSE_PERSISTS = "the cause persists: {fault}"
    HOLD_UNKNOWN = "the gripper is not connected, so it is unknown what it holds"
    HOLD_UNKNOWN_YET = "the gripper is moving, so it is unknown what it will hold; retry in a moment"

    def message(self, **values: object) -> Message:
        """Return the message with its values filled in."""
        return Message(self.name.lower(), self.value.format(**values))


class FaultCode(StrEnum):
    """Names of faults, for the log, the API and the page."""

    FRAMES_LOST = "frames lost"
    FINGERS_BLIND = "fingers blind"
    ESTIMATE_UNTRUSTED = "estimate untrusted"
    GRIPPER_SILENT = "gripper silent"
    GRIPPER_FAULT = "gripper fault"
    GRIPPER_STUCK = "gripper stuck"
    NOT_RELEASED = "not released"
    ARM_SILENT = "arm silent"
    ARM_STOPPED = "arm in protective stop"
    ARM_EMERGENCY = "arm in emergency stop"
    ARM_STUCK = "arm stuck"
    LOOP_LATE = "loop late"
    MACHINE_BUSY = "machine too busy"
    TIGHTENING_INEFFECTIVE = "tightening has no effect"
    FORCE_LIMIT_REACHED = "force limit reached"
    ROTATED_TOO_FAR = "rotated too far"
    NOT_SETTLED = "not settled"
    OBJECT_LOST = "object lost"


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault.

    Args:
        code: its name.
        observed: what was measured, with values and limits.
        what_to_do: one sentence for the person at the cell.
    """

    code: FaultCode
    observed: str
    what_to_do: str

    def __str__(self) -> str:
        return f"{self.code}: {self.observed}; {self.what_to_do}"

    def message(self) -> Message:
        """Return the fault as a message."""
        return Message(f"fault: {self.code}", str(self))
