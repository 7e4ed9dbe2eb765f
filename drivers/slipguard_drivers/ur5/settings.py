"""What a user may set about the arm: the `[arm.ur5]` table of config.toml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator


def _one_word(given: str) -> str:
    if given.split() != [given]:
        raise ValueError("a name or an address, without blanks")
    return given


class Ur5Settings(BaseModel):
    """Frozen, unknown keys refused. What one mode does not need is not looked at in it."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    host: Annotated[str, Field(min_length=1), AfterValidator(_one_word)]
    """The controller's address."""

    speed_max_mm_s: Annotated[float, Field(gt=0.0, le=250.0)] = 250.0
    acceleration_mm_s2: Annotated[float, Field(ge=50.0, le=2500.0)] = 500.0
    stop_mm_s2: Annotated[float, Field(ge=500.0, le=10000.0)] = 2500.0
    watchdog_hz: Annotated[float, Field(ge=2.0, le=15.0)] = 4.0
    """Lift mode: the robot stops by itself when it hears nothing for 1 / watchdog_hz seconds."""
    registers: Literal["lower", "upper"] = "lower"
    """Lift mode: use RTDE registers 0-23 or 24-47; the others are free for a fieldbus or another program."""

    stop_by: Literal["dashboard_pause", "digital_output"] = "dashboard_pause"
    """Guard mode: how the arm is stopped: its program is paused, or it is told by a digital output."""
    digital_output: Annotated[int, Field(ge=0, le=7)] | None = None
    """Guard mode: the standard digital output that asks the program to stop."""
    pulse_ms: Annotated[float, Field(ge=20.0, le=10_000.0)] = 500.0
    """Guard mode: how long that output stays high."""

    @model_validator(mode="after")
    def _output_named(self) -> Ur5Settings:
        if self.stop_by == "digital_output" and self.digital_output is None:
            raise ValueError('stop_by = "digital_output" needs its number: digital_output = 0 to 7')
        return self
