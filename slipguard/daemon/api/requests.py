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

Force = Annotated[float, Field(gt=0.0, le=235.0, description="Newtons per finger.")]
Height = Annotated[float, Field(gt=0.0, le=2000.0, description="Millimeters.")]
Speed = Annotated[float, Field(gt=0.0, le=250.0, description="Millimeters per second.")]
Width = Annotated[float, Field(ge=0.0, le=200.0, description="Millimeters between the jaws.")]


class DaemonRequest(BaseModel):
    """Base of all requests. Unknown keys, infinite numbers and numbers in quotes are refused.

    kind: the request's name; its HTTP route is `POST /<kind>`. response_timeout_s: how long the daemon may take.
    An optional field that is None takes its value from the configuration.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)
    kind: ClassVar[str]
    response_timeout_s: ClassVar[float] = 5.0


class GraspRequest(DaemonRequest):
    """Close on the object between the jaws. force_limit_n: for this object alone, below that of the configuration."""

    kind = "grasp"
    force_n: Force | None = None
    force_limit_n: Force | None = None


class LiftRequest(DaemonRequest):
    """Lift the held object. The response comes when the lift has begun."""

    kind = "lift"
    height_mm: Height | None = None
    speed_mm_s: Speed | None = None


class StopRequest(DaemonRequest):
    """Stop the arm at once and keep the grip, in every state and before all other requests.

    Requests that still wait are refused, but for a release. A held object stays guarded; nothing else moves until the
    next request.
    """

    kind = "stop"


class LowerRequest(DaemonRequest):
    """Lower the held object, by default by the height it was lifted."""

    kind = "lower"
    height_mm: Height | None = None
    speed_mm_s: Speed | None = None


class GuardRequest(DaemonRequest):
    """Switch the guard: on, it tightens when the object slips; off, it only reports."""

    kind = "guard"
    on: bool


class MoveJawsRequest(DaemonRequest):
    """Move the jaws for another program. Never opens on a held object and never lowers its grip force."""

    kind = "gripper"
    width_mm: Width | None = None
    force_n: Force | None = None


def _check_confirmed(confirm: bool) -> bool:
    if not confirm:
        raise ValueError("must be true: the jaws open, and a held object drops")
    return confirm


Confirmation = Annotated[bool, Field(json_schema_extra={"const": True}), AfterValidator(_check_confirmed)]


class ReleaseRequest(DaemonRequest):
    """Open the jaws, in every state. A held object drops, so `confirm` must be true."""

    kind = "release"
    confirm: Confirmation
    width_mm: Width | None = None


class ActivateRequest(DaemonRequest):
    """Activate the gripper; the response comes when it is active. Refused while an object may be held.

    The jaws open and close fully, at full speed and force, so `confirm` must be true: they are empty and the gels
    protected. force: also if a finger sees contact (the gels are covered or taken off).
    """

    kind = "activate"
    response_timeout_s = ACTIVATION_TIMEOUT_S
    confirm: Confirmation
    force: bool = False


class ClearRequest(DaemonRequest):
    """Clear a latched fault whose cause is gone."""

    kind = "clear"


class CalibrateRequest(DaemonRequest):
    """Take and store the background images of both fingers.

    force: also if a stored image indicates contact (the light may have changed). new_gel: the gels were replaced; their
    wear is counted from this image on.
    """

    kind = "calibrate"
    response_timeout_s = CALIBRATION_TIMEOUT_S
    force: bool = False
    new_gel: bool = False


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
