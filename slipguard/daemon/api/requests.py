"""Requests to the daemon. Each is defined once, here.

The same object is the HTTP body, the argument of the client, and the argument of the handler.
"""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

CALIBRATION_TIMEOUT_S = 30.0
ACTIVATION_TIMEOUT_S = 20.0
EXECUTE_WITHIN_S = 4.0
"""A request that has not begun by then is never executed: the client is about to report it as failed."""

FROM_CONFIG = "Default: from the configuration."
Force = Annotated[float | None, Field(gt=0.0, le=235.0, description=f"Newtons per finger. {FROM_CONFIG}")]
Height = Annotated[float | None, Field(gt=0.0, le=2000.0, description=f"Millimeters. {FROM_CONFIG}")]
Speed = Annotated[float | None, Field(gt=0.0, le=250.0, description=f"Millimeters per second. {FROM_CONFIG}")]
Width = Annotated[float | None, Field(ge=0.0, le=200.0, description="Millimeters between the jaws.")]


class DaemonRequest(BaseModel):
    """Base of all requests. Unknown keys, infinite numbers and numbers in quotes are refused.

    kind: the request's name; its HTTP route is `POST /<kind>`. response_timeout_s: how long the daemon may take.
    An optional field that is None takes its value from the configuration.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)
    kind: ClassVar[str]
    response_timeout_s: ClassVar[float] = 5.0


class GraspRequest(DaemonRequest):
    """Close gently on the object between the jaws."""

    kind = "grasp"
    force_n: Force = None
    force_limit_n: Annotated[
        float | None,
        Field(
            gt=0.0,
            le=235.0,
            description="For a fragile object: newtons per finger that are never exceeded while it is held.",
        ),
    ] = None


class LiftRequest(DaemonRequest):
    """Lift the held object; the response comes when the lift has begun."""

    kind = "lift"
    height_mm: Height = None
    speed_mm_s: Speed = None


class StopRequest(DaemonRequest):
    """Stop the arm at once and keep the grip, in every state and before all other requests.

    A held object stays guarded: when it slips, the grip is tightened. Closing jaws are halted; a release goes on.
    Requests that still wait are refused. Nothing else moves until the next request.
    """

    kind = "stop"


class LowerRequest(DaemonRequest):
    """Lower the held object, by default by the height it was lifted; the response comes when the motion has begun."""

    kind = "lower"
    height_mm: Height = None
    speed_mm_s: Speed = None


class GuardRequest(DaemonRequest):
    """Switch the guard on or off."""

    kind = "guard"
    on: Annotated[bool, Field(description="on: tighten when the object slips. off: only report.")]


class MoveJawsRequest(DaemonRequest):
    """Move the jaws for another program. Never opens on a held object and never lowers its grip force.

    Without a force, that of the first grip is used. The width may be omitted while an object is held. In lift mode an
    object gripped this way is not guarded until the guard is switched on.
    """

    kind = "gripper"
    width_mm: Width = None
    force_n: Force = None


def _check_confirmed(confirm: bool) -> bool:
    if not confirm:
        raise ValueError("must be true: the jaws open, and a held object drops")
    return confirm


Confirmation = Annotated[
    bool,
    Field(json_schema_extra={"const": True}, description="Must be true, because it is dangerous."),
    AfterValidator(_check_confirmed),
]


class ReleaseRequest(DaemonRequest):
    """Open the jaws, in every state, including faults; they never close. A held object drops: support it first.

    A gripper that is not active, as after a loss of power, opens slowly and fully. It must then be activated.
    """

    kind = "release"
    confirm: Confirmation
    width_mm: Width = None


class ActivateRequest(DaemonRequest):
    """Activate the gripper, as each time after it was switched on. Refused while an object may be held.

    The jaws open and close fully, at full speed and force, and press the gels against each other: take the gels off
    their sensors first, or tie something soft over each. Empty the jaws and keep your hands out.
    """

    kind = "activate"
    response_timeout_s = ACTIVATION_TIMEOUT_S
    confirm: Confirmation
    force: Annotated[bool, Field(description="Also if a finger sees contact: the gels are covered or taken off.")] = (
        False
    )


class ClearRequest(DaemonRequest):
    """Clear a latched fault whose cause is gone; a held object stays held."""

    kind = "clear"


class CalibrateRequest(DaemonRequest):
    """Take and store the background image of each finger. The jaws must be open and empty."""

    kind = "calibrate"
    response_timeout_s = CALIBRATION_TIMEOUT_S
    force: Annotated[bool, Field(description="Also if the stored image indicates contact.")] = False
    new_gel: Annotated[bool, Field(description="The gels were replaced: count wear from this image on.")] = False


def _integer(number: object) -> object:
    """Convert 3.0 to 3: JSON does not distinguish them."""
    return int(number) if isinstance(number, float) and number.is_integer() else number


class RestoreBackgroundRequest(DaemonRequest):
    """Use an older background image of a finger's sensor again, given by its number."""

    kind = "background"
    response_timeout_s = CALIBRATION_TIMEOUT_S
    finger: Literal["left", "right"]
    number: Annotated[int, Field(ge=1, le=1_000_000), BeforeValidator(_integer)]


REQUESTS: dict[str, type[DaemonRequest]] = {
    request.kind: request
    for request in (
        GraspRequest,
        LiftRequest,
        LowerRequest,
        StopRequest,
        GuardRequest,
        MoveJawsRequest,
        ReleaseRequest,
        ActivateRequest,
        ClearRequest,
        RestoreBackgroundRequest,
        CalibrateRequest,
    )
}
"""All requests by their kind."""
