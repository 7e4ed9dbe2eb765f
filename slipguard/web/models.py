"""What may be sent to the API and what it answers: checked on the way in, described in the OpenAPI document."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, field_validator

Force = Annotated[float, Field(gt=0.0, le=235.0, description="Newtons per finger.")]
Height = Annotated[float, Field(gt=0.0, le=2000.0, description="Millimetres.")]
Speed = Annotated[float, Field(gt=0.0, le=250.0, description="Millimetres a second.")]
Width = Annotated[float, Field(ge=0.0, le=200.0, description="Millimetres between the jaws.")]


class Body(BaseModel):
    """Base of all bodies: no unknown keys, no infinities, no numbers in quotes."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class Nothing(Body):
    """An empty object, or no body at all."""


class Grasp(Body):
    """force_n: per finger; None: from the configuration."""

    force_n: Force | None = None


class Move(Body):
    """Of the arm; None: from the configuration."""

    height_mm: Height | None = None
    speed_mm_s: Speed | None = None


class GuardSwitch(Body):
    """Act on slip, or only watch."""

    on: bool


class Jaws(Body):
    """Another program's grip."""

    width_mm: Width | None = None
    force_n: Force | None = None


class Release(Body):
    """Opening drops what is held, so it must be confirmed."""

    confirm: Annotated[bool, Field(json_schema_extra={"const": True})]
    width_mm: Width | None = None

    @field_validator("confirm")
    @classmethod
    def _confirmed(cls, confirm: bool) -> bool:
        if not confirm:
            raise ValueError("must be true: opening drops what is held")
        return confirm


class Calibrate(Body):
    """force: also where a stored image says that there is contact. new_gel: wear is counted from now on."""

    force: bool = False
    new_gel: bool = False


def _whole(number: object) -> object:
    """In JSON 3.0 is the integer 3."""
    return int(number) if isinstance(number, float) and number.is_integer() else number


class GoBack(Body):
    """An older no-contact image of a finger's sensor, by its number."""

    finger: Literal["left", "right"]
    number: Annotated[int, Field(ge=1, le=1_000_000), BeforeValidator(_whole)]


class ApiResponse(BaseModel):
    """Base of all answers. They may grow: a client leaves alone what it does not know."""

    model_config = ConfigDict(extra="allow")


class MessageResponse(ApiResponse):
    """A command was taken on."""

    said: str


class ErrorResponse(ApiResponse):
    """Why something could not be done."""

    error: str


class HealthyResponse(ApiResponse):
    """The daemon is well."""

    status: Literal["ok"]


class AccessInfo(ApiResponse):
    """Whether whoever asks may also command."""

    control: bool


class PageLink(MessageResponse):
    """A link that gives one browser control over the page; it works once, and not for long."""

    url: str
    valid_s: float


class BackgroundImageInfo(ApiResponse):
    """Of one finger."""

    frames: int
    noise_bgr: list[float]
    level_bgr: list[float]


class StoredBackgrounds(ApiResponse):
    """Of one finger's sensor, oldest first; serial: None where it was not seen yet."""

    serial: str | None
    versions: list[dict[str, Any]]


class CalibrationResponse(MessageResponse):
    """The no-contact images taken, by finger."""

    fingers: dict[str, BackgroundImageInfo]


class FaultNow(ApiResponse):
    """What is wrong, and what to do about it."""

    code: str
    observed: str
    what_to_do: str


class StateResponse(ApiResponse):
    """Everything the daemon knows now. Times are of its monotonic clock, forces newtons per finger, angles degrees."""

    version: str
    phase: str
    mode: Literal["lift", "guard"]
    guarding: bool
    slipping: bool
    target_force_n: float
    fault: FaultNow | None
    rotation: dict[str, Any] | None
    gripper: dict[str, Any] | None
    arm: dict[str, Any] | None
    fingers: dict[str, dict[str, Any]]
    devices: dict[str, dict[str, Any]]
    waiting_for: list[str]
    deadlines_missed: int
    said: list[str]
