"""From a gel frame to a signed rotation with its uncertainty; pure functions and small state, no I/O but onnxruntime.

The path of one frame, `pipeline.Pipeline.process`:
    skipping            image unchanged: repeat the last estimate; no contact: skip the rest
    rotation_meter      contact moves as a whole: its texture alone, without the network
    segmenter, patch    network, contact patch; then image_quality
    rotation_meter      the texture since the reference
    estimate            the result: rotation and sigma, or `declined` with the reason

What the rotation is measured by, in the order of its use:
    rotation_meter      which contact is the reference, and when a later one replaces it
    texture_map         the gel's curvature in a frame, by which textures are compared
    texture_tracker     follows the reference's texture from frame to frame
        texture_template    the reference's texture, and which rotations look alike
        registration        one registration to it, and its sigma
        rotation_filter     which of similar rotations it is
        gel_memory          correction for an earlier imprint that the gel still shows
    shift_meter         the shift of the object at the grasp axis
    axis, skeleton      the axis of the mask by the paper's estimators: orientation, comparison

`from slipguard.perception import Pipeline, Estimate` is all that most programs need.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from slipguard.perception.estimate import Estimate
    from slipguard.perception.pipeline import Pipeline

__all__ = ["Estimate", "Pipeline"]


def __getattr__(name: str) -> Any:
    """Import on first use: the configuration needs only `settings`, without OpenCV."""
    if name in __all__:
        return getattr(import_module(f"{__name__}.{name.lower()}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
