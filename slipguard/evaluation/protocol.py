"""The protocol of an experiment as a TOML file: which objects are lifted, how often and how."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from slipguard.config_errors import describe_validation_error
from slipguard.errors import InputError


class _ProtocolPart(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ProtocolObject(_ProtocolPart):
    """One object. seen: images of it were used in training. hard: why it is difficult, such as "heavy"."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,40}$")]
    seen: bool = False
    hard: str = ""
    grip_force_n: Annotated[float, Field(ge=1.0, le=235.0)] | None = None
    """Initial grip force; None: the protocol's."""


class LiftProtocol(_ProtocolPart):
    """Every object is lifted `repeats` times. As in the paper the guard is off: rotation is measured, not stopped.

    Attributes:
        rotation_deg: the planned rotations are spread evenly over this range. On a real cell they depend on how the
            object is placed: a lift by `lift_height_mm` rotates an object whose far end stays on the table by
            asin(height / twice the distance from the grip to the center of mass).
        camera_side: the external camera is behind this finger, so it sees the same direction of rotation.
    """

    name: str = "grasp and lift"
    objects: Annotated[tuple[ProtocolObject, ...], Field(min_length=1, max_length=200)]
    repeats: Annotated[int, Field(ge=1, le=100)] = 5
    guard: bool = False
    seed: Annotated[int, Field(ge=0)] = 0
    rotation_deg: tuple[float, float] = (5.0, 40.0)
    lift_height_mm: Annotated[float, Field(ge=1.0, le=800.0)] = 60.0
    lift_speed_mm_s: Annotated[float, Field(ge=1.0, le=250.0)] = 40.0
    hold_s: Annotated[float, Field(ge=0.2, le=60.0)] = 0.8
    grip_force_n: Annotated[float, Field(ge=1.0, le=235.0)] | None = None
    marker_side_mm: Annotated[float, Field(ge=5.0, le=300.0)] = 40.0
    camera_side: Literal["left", "right"] = "left"

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        low, high = self.rotation_deg
        if not 0.0 < low <= high <= 60.0:
            raise ValueError(f"rotation_deg [{low:g}, {high:g}]: must be increasing, above 0 and at most 60")
        names = [one.name for one in self.objects]
        if len(set(names)) < len(names):
            raise ValueError("an object is named twice; use `repeats` instead")
        return self

    def lifts(self) -> list[PlannedLift]:
        """Return all lifts in order: every object once, then again; its repeats cover the range of rotations."""
        low, high = self.rotation_deg
        rng = np.random.default_rng(self.seed)
        planned: list[PlannedLift] = []
        for repeat in range(self.repeats):
            for index, item in enumerate(self.objects):
                share = ((index + repeat) % self.repeats + rng.uniform()) / self.repeats
                planned.append(PlannedLift(len(planned), item, repeat, low + share * (high - low)))
        return planned


@dataclass(frozen=True, slots=True)
class PlannedLift:
    """One lift to be done. target_deg: the planned rotation."""

    number: int
    item: ProtocolObject
    repeat: int
    target_deg: float

    @property
    def stem(self) -> str:
        """Name of its files, without suffix."""
        return f"{self.number + 1:03d}-{self.item.name}-{self.repeat + 1}"


SIMULATED = LiftProtocol(
    name="45 lifts of 9 objects, simulated",
    objects=(
        ProtocolObject(name="bar", hard="heavy"),
        ProtocolObject(name="wedge"),
        ProtocolObject(name="wrench"),
        ProtocolObject(name="knife_edge"),
        ProtocolObject(name="screwdriver"),
        ProtocolObject(name="hook"),
        ProtocolObject(name="ball", hard="saturating"),
        ProtocolObject(name="hammer", seen=True),
        ProtocolObject(name="pen", seen=True),
    ),
)
"""Seven objects not used in training and two that were, five lifts each, as in the paper's Table III."""


def read_protocol(path: Path) -> LiftProtocol:
    """Return the protocol of a file; raise InputError if it is not valid."""
    try:
        raw: dict[str, Any] = tomllib.loads(path.read_text())
        return LiftProtocol.model_validate(raw)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML: {error}") from None
    except ValidationError as error:
        raise InputError(f"{path}: {describe_validation_error(error, LiftProtocol)}") from None
