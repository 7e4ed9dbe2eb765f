"""The `[perception]` section of config.toml."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict

EstimatorName = Literal["registration", "moments", "ellipse", "pca", "skeleton"]


class PerceptionSettings(BaseModel):
    """Frozen, unknown keys refused. Areas are in frame pixels (240 x 320), angles in degrees."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, strict=True, use_attribute_docstrings=True
    )

    model: Annotated[Path, Strict(False)] | None = None
    """Segmentation network (.onnx). Default: the one shipped."""
    estimator: EstimatorName = "registration"
    """How the rotation is estimated: registration to the reference, or the axis of the mask by one of four estimators,
    for comparison."""
    reference: Literal["stable", "first"] = "stable"
    """The reference is the first frame of a stable contact area, at most 0.1 s late, or the first with contact."""
    threshold: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    """Probability above which a pixel is contact. Default: the threshold stored in the network file."""
    min_area_px: Annotated[int, Field(ge=20, le=20_000)] = 200
    """Smaller regions are ignored: 200 px is about 0.6 mm2."""
    round_aspect: Annotated[float, Field(ge=1.0, le=2.0)] = 1.15
    """A patch is round, without a readable axis, if long axis / short axis is below this."""
    sigma_max_deg: Annotated[float, Field(ge=0.5, le=30.0)] = 6.0
    """A rotation with a larger sigma is declined."""
    gate_noise_factor: Annotated[float, Field(ge=3.0, le=30.0)] = 7.0
    """Difference from the background image, in standard deviations of noise, above which a block may be contact."""
    skip_unchanged: bool = True
    """Reuse the last estimate while the image differs from the measured one by no more than noise."""
    skip_second_finger: bool = True
    """Skip the finger with the larger sigma while the other finger's image does not change."""
    refresh_s: Annotated[float, Field(ge=0.0, le=0.25)] = 0.25
    """An unchanged image, or a skipped finger, is measured again after this time at the latest."""
