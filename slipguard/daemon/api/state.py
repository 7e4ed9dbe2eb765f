"""What the daemon reports, described once: API, page, `ctl state`, metrics and doctor read these models.

Times are seconds on the daemon's monotonic clock, forces newtons per finger, angles degrees. A model may gain keys;
clients ignore those that they do not know. A number that is not finite is null.
"""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.reports import Fault
from slipguard.control.state import Phase
from slipguard.daemon.loop.capture import FrameCounts
from slipguard.daemon.loop.device_health import Health
from slipguard.daemon.loop.event_log import Event
from slipguard.daemon.loop.gel_condition import GelCondition
from slipguard.daemon.store.background_images import BackgroundVersion
from slipguard.devices import ArmState, GripperState
from slipguard.perception.estimate import Estimate


class ApiModel(BaseModel):
    """Base of all responses."""

    model_config = ConfigDict(extra="allow", use_attribute_docstrings=True)


class Limits(ApiModel):
    """Limits of this grasp, from the configuration and the request."""

    first_force_n: float
    force_max_n: float
    rotation_max_deg: float
    lift_height_mm: float


class FingerState(ApiModel):
    """One finger's sensor and its newest estimate."""

    serial: str | None
    """None until the sensor was opened."""
    estimate: Estimate | None
    frames_per_s: float
    """Estimates per second."""
    age_s: float | None
    """Since the newest processed frame was captured."""
    counts: FrameCounts
    remarks: list[str]
    """Deviations from the configuration, as text."""
    gel: GelCondition | None
    """None until the untouched gel was compared with its background image."""


class Latency(ApiModel):
    """Of the newest `count` times."""

    p50_ms: float
    p99_ms: float
    count: int


class RoundTrips(ApiModel):
    """How long the newest reads of the device's state took."""

    gripper: Latency | None
    arm: Latency | None


class RecordingState(ApiModel):
    """Whether the daemon records, and why not. left_out: values for which the disk was too slow."""

    state: Literal["on", "stopped", "off"] = "off"
    why: str | None = None
    left_out: int = 0


class State(ApiModel):
    """The complete state of the daemon."""

    version: str
    now_s: float | None
    """Start of the last cycle of the loop."""
    mode: Literal["lift", "guard"]
    config_problem: str | None
    """Why the configuration file is not in use."""
    phase: Phase
    guarding: bool
    slipping: bool
    putting_down: bool
    stopped_by_request: bool
    target_force_n: float
    load_over_capacity: float | None = None
    """Load over what the present grip holds, the most probable value; null while nothing is guarded."""
    limits: Limits
    no_rotation_reason: str | None
    fault: Fault | None
    """The latched fault."""
    rotation: FusedEstimate | None
    """The estimate of both fingers together; null without fresh frames."""
    gripper: GripperState | None
    arm: ArmState | None
    has_arm: bool
    lifted_mm: float | None
    """Height of the arm above where the lift began."""
    fingers: dict[str, FingerState]
    devices: dict[str, Health]
    round_trips: RoundTrips
    latency: Latency | None
    """From receiving a frame until its command was sent or found unnecessary."""
    waiting_for: list[str]
    """One line for each device that is not ready."""
    deadlines_missed: int
    events: list[Event]
    """The newest infos and warnings, oldest first; a fault is in `fault`."""
    last_slip: Event | None
    """The newest event of the kind `slip`: what slipped, and the tightening that followed."""
    recording: RecordingState


class NewEstimates(ApiModel):
    """One message of the stream of estimates: what one cycle of the loop was the first to use."""

    number: int
    """Rises by one with each message: a gap means that this client was too slow."""
    at_s: float
    """When the cycle began."""
    rotation: FusedEstimate | None
    """The estimate of both fingers together, as the controller used it."""
    fingers: dict[str, Estimate]
    """The new estimates, by finger, each with the time at which its frame was captured."""


class MessageResponse(ApiModel):
    """The request was accepted."""

    message: str


class ErrorResponse(ApiModel):
    """The request failed; the reason in one line."""

    error: str


class HealthyResponse(ApiModel):
    """The daemon is healthy."""

    status: Literal["ok"]


class AccessInfo(ApiModel):
    """Whether this client may send commands."""

    control: bool


class PageLink(MessageResponse):
    """A link that gives one browser control over the page; it works once, for `valid_s`."""

    url: str
    valid_s: float


class BackgroundImageInfo(ApiModel):
    """A background image of one finger: noise and mean level in gray levels, per color channel."""

    frames: int
    noise_bgr: list[float]
    level_bgr: list[float]


class StoredBackgrounds(ApiModel):
    """Background images of one finger's sensor, oldest first. serial: None if the sensor was not found yet."""

    serial: str | None
    versions: list[BackgroundVersion]


class CalibrationResponse(MessageResponse):
    """The background images that were taken, by finger."""

    fingers: dict[str, BackgroundImageInfo]
