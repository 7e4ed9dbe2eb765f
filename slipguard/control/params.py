"""The `[guard]` section of config.toml: what a user decides about the grip, and `[guard.tuning]` below it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from slipguard.config_errors import error_at_key
from slipguard.limit_surface import FINGER_COUNT, GRAVITY_M_S2, Pad, force_needed_n

Force = Annotated[float, Field(ge=1.0, le=235.0)]
"""Newtons per finger; 235 N is what the strongest supported gripper applies."""
MODEL_RESERVE = 1.3
"""Over the force of the limit surface: a gripper may be a tenth weaker than it reports, a lift adds a tenth of load."""
NO_ESTIMATE_FORCE_N = 100.0


MARGINS = {"gentle": 1.15, "firm": 1.6}


def _margin(given: object) -> object:
    """Return the margin of a name, and anything else as it is."""
    return MARGINS.get(given, given) if isinstance(given, str) else given


def _no_estimate_force_n(given: dict[str, Any]) -> float:
    """Return the default: 100 N, but not below the first force and not above the force limit."""
    limit_n = given.get("force_max_n", NO_ESTIMATE_FORCE_N)
    return float(min(max(NO_ESTIMATE_FORCE_N, given.get("first_force_n", 0.0)), limit_n))


class _Table(BaseModel):
    """Frozen; unknown keys are refused. Forces are per finger, angles in degrees, times in seconds."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, strict=True, use_attribute_docstrings=True
    )


class GuardTuning(_Table):
    """`[guard.tuning]`: thresholds, speeds and timeouts. "Rotation" is the rotation since the last rest."""

    slip_rate_deg_s: Annotated[float, Field(ge=0.5, le=100.0)] = 8.0
    """A rotation that is still this fast after a tightening shows that it had no effect."""

    tighten_delay_s: Annotated[float, Field(ge=0.02, le=1.0)] = 0.15
    """From a command to its effect, until measured while the jaws close: queue 32 ms, dead time 20-60 ms."""
    tighten_effect_timeout_s: Annotated[float, Field(ge=0.2, le=10.0)] = 1.5
    """Tightening must stop the rotation within this time; 20 N at 64 N/s and one loop delay take 0.5 s."""
    rotation_max_deg: Annotated[float, Field(ge=5.0, le=90.0)] = 45.0
    """Beyond this the object is not held: the controller applies the force limit, stops the arm and reports a fault."""

    lift_off_speed_mm_s: Annotated[float, Field(ge=1.0, le=250.0)] = 5.0
    """Speed of a lift until the object hangs: the load arrives no faster than the grip can follow."""
    lower_speed_mm_s: Annotated[float, Field(ge=1.0, le=250.0)] = 30.0
    """Speed of `lower` where the request gives none."""

    closing_timeout_s: Annotated[float, Field(ge=0.5, le=30.0)] = 5.0
    """A gripper that has not closed on an object in this time is at fault; 85 mm at 20 mm/s take 4.3 s."""
    reference_timeout_s: Annotated[float, Field(ge=0.2, le=10.0)] = 1.0
    """How long to wait after gripping for a stable contact whose rotation can be estimated."""
    lost_after_s: Annotated[float, Field(ge=0.02, le=2.0)] = 0.1
    """The object is lost after this time without contact in both fingers, or with nothing between the jaws."""
    frames_timeout_s: Annotated[float, Field(ge=0.05, le=5.0)] = 0.3
    """Fault if neither finger has delivered a good frame for this time."""
    estimate_timeout_s: Annotated[float, Field(ge=0.1, le=10.0)] = 1.0
    """Fault after this time with contradicting fingers, or without any rotation estimate."""
    gripper_timeout_s: Annotated[float, Field(ge=0.1, le=5.0)] = 0.4
    """Fault after this time without a response from the gripper."""
    arm_timeout_s: Annotated[float, Field(ge=0.1, le=5.0)] = 0.4
    """Fault after this time without a state from the arm."""
    stuck_timeout_s: Annotated[float, Field(ge=0.5, le=10.0)] = 2.0
    """Fault when a moving arm gains no height, or an opening gripper does not open, for this time."""
    cycle_timeout_s: Annotated[float, Field(ge=0.05, le=5.0)] = 0.5
    """Fault when two control steps are this far apart."""


class GuardParams(_Table):
    """`[guard]`: what a user decides. config.toml has the same sentences."""

    mode: Literal["lift", "guard"] = "lift"
    """Who moves the arm: "lift" if slipguard does, "guard" if another program does and slipguard may only pause it."""

    first_force_n: Force = 40.0
    """First grip; lower it for fragile objects, raise it if every lift begins with a slip."""
    force_max_n: Force = 130.0
    """Force limit; set it to what gel and object bear. For the gel no limit is published; this holds 1 kg at 100 mm."""
    no_estimate_force_n: Force = Field(default_factory=_no_estimate_force_n)
    """Grip before a lift without a rotation estimate (round contacts), and of a carried object whose estimate is lost;
    raise it for heavy ones. Default: 100, within the two forces above."""
    margin: Annotated[float, Field(ge=1.05, le=3.0), BeforeValidator(_margin)] = 1.3
    """What the grip holds over its load, or "gentle" (1.15) or "firm" (1.6): a larger margin grips harder and slips
    less. A force limit for one object is an option of `slipguard ctl grasp`."""
    on_no_estimate: Literal["grip", "refuse"] = "grip"
    """Without a rotation estimate: grip with that force, or "refuse" if the lift must not happen unguarded."""

    friction: Annotated[float, Field(ge=0.05, le=2.0)] | None = None
    """Between object and gel; give it with `mass_kg` if both are known: the grip suits the load before the lift."""
    mass_kg: Annotated[float, Field(gt=0.0, le=20.0)] | None = None
    """Of the object; give it together with `friction`."""
    lever_mm: Annotated[float, Field(ge=0.0, le=500.0)] = 0.0
    """From the grip to the center of mass, horizontally; give it with those two if the object is held off-center."""

    lift_height_mm: Annotated[float, Field(ge=1.0, le=800.0)] = 100.0
    """Height of a lift that is requested without one; change it to suit your task."""
    lift_speed_mm_s: Annotated[float, Field(ge=1.0, le=250.0)] = 50.0
    """Lower it for heavy objects: a slow lift gives the gripper time to tighten."""
    release_width_mm: Annotated[float, Field(ge=1.0, le=200.0)] = 85.0
    """How far a release opens the jaws, within the gripper's stroke; lower it if wide open jaws hit something."""

    stop_on_slip: bool = True
    """Stop the arm while the object slips; set it to false if a stop of the arm is worse than slip."""
    on_force_limit: Literal["stop", "lower"] = "stop"
    """Slip at the force limit: "stop" the arm, or (lift mode) "lower" slowly to where the lift began."""

    tuning: GuardTuning = GuardTuning()

    def limited(self, force_limit_n: float | None) -> GuardParams:
        """Return the parameters with a lower force limit; None, or one that is not lower, changes nothing."""
        if force_limit_n is None or force_limit_n >= self.force_max_n:
            return self
        forces = ("first_force_n", "force_max_n", "no_estimate_force_n")
        return self.model_copy(update={name: min(getattr(self, name), force_limit_n) for name in forces})

    def modelled_n(self, pad: Pad | None = None) -> float | None:
        """Return the force per finger that friction, mass and lever require, with a reserve; None if not given.

        pad: with the contact as seen; the default needs the least.
        """
        if self.friction is None or self.mass_kg is None:
            return None
        load_n = self.mass_kg * GRAVITY_M_S2 / FINGER_COUNT
        return MODEL_RESERVE * force_needed_n(load_n, 1e-3 * self.lever_mm, self.friction, pad or Pad())

    @model_validator(mode="after")
    def _model_complete(self) -> GuardParams:
        if (self.friction is None) is not (self.mass_kg is None):
            missing, given = ("friction", "mass_kg") if self.friction is None else ("mass_kg", "friction")
            raise error_at_key(missing, None, f"missing; it and {given} go together: give both, or neither")
        needed_n = self.modelled_n()
        if needed_n is not None and needed_n > self.force_max_n:
            raise error_at_key(
                "force_max_n",
                self.force_max_n,
                f"friction ({self.friction:g}), mass_kg ({self.mass_kg:g}) and lever_mm ({self.lever_mm:g}) require "
                f"{needed_n:.0f} N; raise it if object and gel bear that, or leave friction and mass_kg out",
            )
        return self

    @model_validator(mode="after")
    def _forces_in_order(self) -> GuardParams:
        for key, force_n in (("first_force_n", self.first_force_n), ("no_estimate_force_n", self.no_estimate_force_n)):
            if force_n > self.force_max_n:
                raise error_at_key(key, force_n, f"at most force_max_n ({self.force_max_n:g}); lower it, too")
        if self.no_estimate_force_n < self.first_force_n:
            least = f"at least first_force_n ({self.first_force_n:g})"
            raise error_at_key("no_estimate_force_n", self.no_estimate_force_n, least)
        if self.on_force_limit == "lower" and self.mode == "guard":
            raise error_at_key(
                "on_force_limit",
                self.on_force_limit,
                'for mode = "lift"; in guard mode the arm belongs to another program: leave it at "stop"',
            )
        return self
