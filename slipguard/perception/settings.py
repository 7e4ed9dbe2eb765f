"""What a user may set about perception: the `[perception]` section of config.toml."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict

EstimatorName = Literal["fused", "registration", "moments", "ellipse", "pca", "skeleton"]


class PerceptionSettings(BaseModel):
    """Frozen, unknown keys refused. Areas are in frame pixels (240 x 320), angles in degrees."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)

    model: Annotated[Path, Strict(False)] | None = None
    """Segmentation network (.onnx); None: the one shipped."""
    estimator: EstimatorName = "fused"
    """How the turn is told: one of the four orientation estimators, registration to the reference, or all fused."""
    reference: Literal["stable", "first"] = "stable"
    """The reference is the first frame of a stable contact area, or the first frame with contact."""
    threshold: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    """Probability above which a pixel is contact; None: what the network's maker found best."""
    min_area_px: Annotated[int, Field(ge=20, le=20_000)] = 200
    """Smaller regions are specks: 200 px is about 0.6 mm2."""
    round_aspect: Annotated[float, Field(ge=1.0, le=2.0)] = 1.15
    """A patch whose long axis is less than this many times its short one is round: it has no readable axis."""
    sigma_max_deg: Annotated[float, Field(ge=0.5, le=30.0)] = 6.0
    """An angle less certain than this is declined."""
    gate_sigma: Annotated[float, Field(ge=3.0, le=30.0)] = 7.0
    """How many standard deviations of noise one block of the picture may differ without contact."""
    skip_unchanged: bool = True
    """Reuse the last answer while the picture differs from the measured one by no more than noise."""
    skip_second_finger: bool = True
    """Do not look at the finger that sees less while the surer one sees no change."""
    refresh_s: Annotated[float, Field(ge=0.0, le=0.25)] = 0.25
    """An unchanged picture, or a finger not looked at, is measured again after this time at the latest."""


@dataclass(frozen=True, slots=True)
class Skips:
    """What a frame does not need: the network without contact or on an unchanged picture, thinning of a round patch."""

    no_contact: bool = True
    unchanged: bool = True
    round: bool = True


ALL_SKIPS = Skips()
