"""What a DIGIT is asked for: its section of config.toml."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

Level = Annotated[int, Field(ge=0, le=15)]
Levels = tuple[Level, Level, Level]


def _serial(given: str) -> str:
    if not (given.isascii() and given.isalnum()):
        raise ValueError("letters and digits, as printed on the sensor")
    return given


class DigitSettings(BaseModel):
    """serial: as printed on the sensor, D followed by five digits. pixels: "auto" prefers YUYV."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    only_one: ClassVar = ("serial",)
    serial: Annotated[str, AfterValidator(_serial)]
    fps: Literal[30, 60] = 60
    pixels: Literal["auto", "YUYV", "MJPG"] = "auto"
    led_rgb: Levels = (15, 15, 15)
    stall_ms: Annotated[float, Field(ge=50.0, le=5000.0)] = 250.0
