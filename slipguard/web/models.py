"""The responses of the API, as the OpenAPI document describes them. Requests: `slipguard.daemon.api.requests`."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict


class ApiResponse(BaseModel):
    """Base of all responses. They may gain keys; clients ignore the keys they do not know."""

    model_config = ConfigDict(extra="allow")


class MessageResponse(ApiResponse):
    """The request was accepted."""

    message: str


class ErrorResponse(ApiResponse):
    """The request failed; the reason in one line."""

    error: str


class HealthyResponse(ApiResponse):
    """The daemon is healthy."""

    status: Literal["ok"]


class AccessInfo(ApiResponse):
    """Whether this client may send commands."""

    control: bool


class PageLink(MessageResponse):
    """A link that gives one browser control over the page; it works once, for `valid_s`."""

    url: str
    valid_s: float


class BackgroundImageInfo(ApiResponse):
    """A background image of one finger: noise and mean level in gray levels, per color channel."""

    frames: int
    noise_bgr: list[float]
    level_bgr: list[float]


class StoredBackgrounds(ApiResponse):
    """Background images of one finger's sensor, oldest first. serial: None if the sensor was not found yet."""

    serial: str | None
    versions: list[dict[str, Any]]


class CalibrationResponse(MessageResponse):
    """The background images that were taken, by finger."""

    fingers: dict[str, BackgroundImageInfo]


class FaultState(ApiResponse):
    """The latched fault: what was observed, and what the operator should do."""

    code: str
    observed: str
    what_to_do: str


class StateResponse(ApiResponse):
    """The daemon's complete state. Times: its monotonic clock. Forces: newtons per finger. Angles: degrees."""

    version: str
    phase: str
    mode: Literal["lift", "guard"]
    guarding: bool
    slipping: bool
    stopped_by_request: bool
    target_force_n: float
    fault: FaultState | None
    rotation: dict[str, Any] | None
    gripper: dict[str, Any] | None
    arm: dict[str, Any] | None
    has_arm: bool
    fingers: dict[str, dict[str, Any]]
    devices: dict[str, dict[str, Any]]
    waiting_for: list[str]
    deadlines_missed: int
    events: list[dict[str, Any]]
