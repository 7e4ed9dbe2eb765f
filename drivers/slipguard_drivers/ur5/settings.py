"""The table `[arm.ur5]` of config.toml."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator


def _without_blanks(text: str) -> str:
    if text.split() != [text]:
        raise ValueError("must be a host name or an address, without blanks")
    return text


class Ur5Settings(BaseModel):
    """Settings of a UR arm; each mode ignores the other mode's settings."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    host: Annotated[str, Field(min_length=1), AfterValidator(_without_blanks)]
    """The controller's address."""

    speed_max_mm_s: Annotated[float, Field(gt=0.0, le=250.0)] = 250.0
    """Speed limit; 250 is the usual one near people."""
    acceleration_mm_s2: Annotated[float, Field(ge=50.0, le=2500.0)] = 500.0
    """Acceleration of a lift."""
    stop_mm_s2: Annotated[float, Field(ge=500.0, le=10000.0)] = 2500.0
    """Deceleration of a stop."""
    watchdog_hz: Annotated[float, Field(ge=2.0, le=15.0)] = 4.0
    """Lift mode: the robot stops by itself if it receives nothing for 1 / watchdog_hz seconds."""
    registers: Literal["lower", "upper"] = "lower"
    """Lift mode: use RTDE registers 0-23 or 24-47; the others stay free for a fieldbus or another program."""

    stop_by: Literal["dashboard_pause", "digital_output"] = "dashboard_pause"
    """Guard mode: stop the arm by pausing its program, or by a digital output that its program reads."""
    digital_output: Annotated[int, Field(ge=0, le=7)] | None = None
    """Guard mode: the standard digital output that asks the program to stop."""
    pulse_ms: Annotated[float, Field(ge=20.0, le=10_000.0)] = 500.0
    """Guard mode: how long that output stays high."""

    @model_validator(mode="after")
    def _output_is_named(self) -> Ur5Settings:
        if self.stop_by == "digital_output" and self.digital_output is None:
            raise ValueError('stop_by = "digital_output" needs a number: digital_output = 0 to 7')
        return self
