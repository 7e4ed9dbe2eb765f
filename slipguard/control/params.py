"""What a user may set about the grip: the `[guard]` section of config.toml."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from slipguard.config_errors import at_key
from slipguard.limit_surface import GRAVITY_M_S2, Pad, force_needed_n

Force = Annotated[float, Field(ge=1.0, le=235.0)]
"""Newtons per finger; 235 N is what the strongest supported gripper applies."""
FINGERS = 2
MODEL_RESERVE = 1.3
"""Over the force of the limit surface: a gripper may be a tenth weaker than it says, a lift adds a tenth of load."""
BLIND_FORCE_N = 100.0


def _blind_force_n(given: dict[str, Any]) -> float:
    """Where none is given: 100 N, but no softer than the first grip and never above the budget."""
    return float(min(max(BLIND_FORCE_N, given.get("first_force_n", 0.0)), given.get("force_max_n", BLIND_FORCE_N)))


class GuardParams(BaseModel):
    """Frozen, unknown keys refused. Forces are per finger, angles in degrees, times in seconds.

    "turn" is the turn since the reference taken when the object was gripped.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    mode: Literal["lift", "guard"] = "lift"
    """lift: slipguard closes, lifts, guards, lowers. guard: another program moves the arm; it is only paused."""

    first_force_n: Force = 40.0
    """First grip; gentle, for the guard tightens where it is not enough."""
    force_max_n: Force = 130.0
    """Never grip harder: the budget of gel and object. No limit of the gel is published; this holds 1 kg at 100 mm."""
    blind_force_n: Force = Field(default_factory=_blind_force_n)
    """Grip before lifting where the turn cannot be seen (a round contact). Not given: 100, `force_max_n` at most."""
    on_blind: Literal["grip", "refuse"] = "grip"
    """Where the turn cannot be seen: grip to `blind_force_n`, or refuse to lift."""

    friction: Annotated[float, Field(ge=0.05, le=2.0)] | None = None
    """Between object and gel. Given with `mass_kg`, the first grip and the first tightening are computed from both."""
    mass_kg: Annotated[float, Field(gt=0.0, le=20.0)] | None = None
    lever_mm: Annotated[float, Field(ge=0.0, le=500.0)] = 0.0
    """From the grip to the object's centre of mass, level; used with the two above."""

    closing_timeout_s: Annotated[float, Field(ge=0.5, le=30.0)] = 5.0
    """A gripper that has not closed on anything by then is at fault; 85 mm at 20 mm/s take 4.3 s."""
    reference_timeout_s: Annotated[float, Field(ge=0.2, le=10.0)] = 1.0
    """How long to wait for a stable contact whose axis can be read."""

    probe_height_mm: Annotated[float, Field(ge=0.0, le=100.0)] = 15.0
    """First part of a lift, slow: what turns still has its far end on the table."""
    probe_speed_mm_s: Annotated[float, Field(ge=1.0, le=250.0)] = 20.0
    lift_height_mm: Annotated[float, Field(ge=1.0, le=800.0)] = 100.0
    lift_speed_mm_s: Annotated[float, Field(ge=1.0, le=250.0)] = 50.0
    lower_speed_mm_s: Annotated[float, Field(ge=1.0, le=250.0)] = 30.0

    rest_level_deg: Annotated[float, Field(ge=0.1, le=10.0)] = 0.3
    """A turn beyond this, and beyond the sensor's own noise, is slip while the arm stands."""
    lift_off_level_deg: Annotated[float, Field(ge=0.1, le=10.0)] = 0.4
    """... and beyond this (2.5 times, in a firm grip) while it lifts off, until tightened once. Stiff pads: 0.3-0.6."""
    level_deg: Annotated[float, Field(ge=0.5, le=10.0)] = 2.0
    """A turn below this is never slip while the arm moves."""
    level_sigmas: Annotated[float, Field(ge=1.0, le=10.0)] = 3.0
    """... nor one below this many standard deviations of the estimate,"""
    level_max_deg: Annotated[float, Field(ge=0.5, le=20.0)] = 5.0
    """... but an unsure estimate does not raise the level beyond this."""
    level_growth: Annotated[float, Field(ge=1.0, le=3.0)] = 2.0
    """Each tightening multiplies the level, by 4 at most: the firmer the grip, the likelier the gel only winds up."""
    rate_deg_s: Annotated[float, Field(ge=0.5, le=100.0)] = 8.0
    """Slip turns at least this fast; a wound-up gel comes to rest."""
    creep_deg: Annotated[float, Field(ge=1.0, le=30.0)] = 6.0
    """A turn beyond this is slip at any rate."""
    slide_mm: Annotated[float, Field(ge=0.1, le=5.0)] = 0.5
    """A slide downwards below this is never slip."""
    slide_rate_mm_s: Annotated[float, Field(ge=0.1, le=50.0)] = 3.0
    slide_creep_mm: Annotated[float, Field(ge=0.2, le=10.0)] = 2.0
    """A slide beyond this is slip at any rate."""
    frames: Annotated[int, Field(ge=1, le=10)] = 2
    """So many measured frames in a row must show the slip."""

    firm_share: Annotated[float, Field(ge=0.1, le=1.0)] = 0.7
    """First tightening, at least to this share of `force_max_n`: a budget leaves room over what the object needs."""
    firm_level_deg: Annotated[float, Field(ge=1.0, le=30.0)] = 6.0
    """Tightened once, a grip may let the gel wind up so far when it takes over the weight."""
    first_step: Annotated[float, Field(ge=1.05, le=3.0)] = 1.3
    """... and as a multiple of the present force: one large step loses less angle than many small ones."""
    next_step: Annotated[float, Field(ge=1.02, le=3.0)] = 1.25
    """Each further tightening while it goes on."""
    rate_step_per_100_deg_s: Annotated[float, Field(ge=0.0, le=2.0)] = 0.25
    """Added to either multiple for each 100 deg/s of turning."""
    hold_off_s: Annotated[float, Field(ge=0.02, le=1.0)] = 0.15
    """From a step to its effect, until that has been measured while the jaws close: queue 32 ms, dead time 20-60 ms."""
    stop_on_slip: bool = True
    """Stop the arm while an object slips; in lift mode the lift goes on when it is calm."""
    on_budget_spent: Literal["stop", "lower"] = "stop"
    """Where all of `force_max_n` does not hold: stop the arm, or (lift mode) go back slowly to where the lift began."""
    give_up_rotation_deg: Annotated[float, Field(ge=5.0, le=90.0)] = 45.0
    """An object turned beyond this is not being held: grip to the budget, stop the arm, say so."""
    calm_s: Annotated[float, Field(ge=0.05, le=5.0)] = 0.3
    """Slip is over when nothing has moved for so long and the gripper is at rest."""
    calm_deg: Annotated[float, Field(ge=0.1, le=5.0)] = 1.0
    """What counts as not moving: half the noise of a static estimate at least."""

    release_width_mm: Annotated[float, Field(ge=1.0, le=200.0)] = 85.0
    """How far a release opens the jaws; the gripper clips it to its stroke."""

    lost_s: Annotated[float, Field(ge=0.02, le=2.0)] = 0.1
    """Contact gone in both fingers, or nothing between them, for so long: the object is lost."""
    frames_timeout_s: Annotated[float, Field(ge=0.05, le=5.0)] = 0.3
    """No good frame from either finger for so long is a fault."""
    untrusted_s: Annotated[float, Field(ge=0.1, le=10.0)] = 1.0
    """The fingers contradict each other, or neither can tell the turn any more, for so long: a fault."""
    gripper_timeout_s: Annotated[float, Field(ge=0.1, le=5.0)] = 0.4
    arm_timeout_s: Annotated[float, Field(ge=0.1, le=5.0)] = 0.4
    """Silence of a device for so long is a fault."""
    stuck_s: Annotated[float, Field(ge=0.5, le=10.0)] = 2.0
    """A lift or lowering that gains no height, or a gripper that does not open, for so long is a fault."""
    loop_late_s: Annotated[float, Field(ge=0.05, le=5.0)] = 0.5
    """Nothing was decided for so long: a fault."""
    help_s: Annotated[float, Field(ge=0.2, le=10.0)] = 1.5
    """Tightening must have stopped the turning within this time; 20 N at 64 N/s and one loop delay take 0.5 s."""

    @property
    def modelled_n(self) -> float | None:
        """The force per finger that friction, mass and lever ask for, with a reserve; None where they are not given."""
        if self.friction is None or self.mass_kg is None:
            return None
        load_n = self.mass_kg * GRAVITY_M_S2 / FINGERS
        return MODEL_RESERVE * force_needed_n(load_n, 1e-3 * self.lever_mm, self.friction, Pad())

    @model_validator(mode="after")
    def _model_whole(self) -> GuardParams:
        if (self.friction is None) is not (self.mass_kg is None):
            missing, given = ("friction", "mass_kg") if self.friction is None else ("mass_kg", "friction")
            raise at_key(missing, None, f"missing; it and {given} go together: give both, or neither")
        needed_n = self.modelled_n
        if needed_n is not None and needed_n > self.force_max_n:
            raise at_key(
                "force_max_n",
                self.force_max_n,
                f"friction ({self.friction:g}), mass_kg ({self.mass_kg:g}) and lever_mm ({self.lever_mm:g}) ask for "
                f"{needed_n:.0f} N; raise it where object and gel bear that, or leave friction and mass_kg out",
            )
        return self

    @model_validator(mode="after")
    def _forces_in_order(self) -> GuardParams:
        for key, force_n in (("first_force_n", self.first_force_n), ("blind_force_n", self.blind_force_n)):
            if force_n > self.force_max_n:
                raise at_key(key, force_n, f"at most force_max_n ({self.force_max_n:g}); lower it, too")
        if self.blind_force_n < self.first_force_n:
            raise at_key("blind_force_n", self.blind_force_n, f"at least first_force_n ({self.first_force_n:g})")
        if self.level_max_deg < self.level_deg:
            raise at_key("level_max_deg", self.level_max_deg, f"at least level_deg ({self.level_deg:g})")
        if self.on_budget_spent == "lower" and self.mode == "guard":
            raise at_key(
                "on_budget_spent",
                self.on_budget_spent,
                'for mode = "lift"; in guard mode the arm belongs to another program: leave it at "stop"',
            )
        return self
