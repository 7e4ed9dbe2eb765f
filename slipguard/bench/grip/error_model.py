"""The figures of the error model, by object: printed by `python -m tests.campaigns fit-perception-errors` (five grasps each)."""

from __future__ import annotations

from slipguard.bench.grip.modeled_perception import SightError

ERRORS: dict[str, SightError] = {
    "bar": SightError(0.020, 0.0042, 0.029, 0.056, 0.0000),
    "wedge": SightError(0.118, 0.0135, 0.210, 0.231, 0.0000),
    "wrench": SightError(0.015, 0.0007, 0.026, 0.038, 0.0000),
    "knife_edge": SightError(0.046, 0.0199, 0.326, 0.192, 0.0000),
    "key": SightError(0.013, 0.0013, 0.022, 0.046, 0.0000),
    "screwdriver": SightError(0.032, 0.0057, 0.045, 0.436, 0.0000),
    "cap": SightError(0.016, 0.0009, 0.010, 0.039, 0.0000),
    "ball": SightError(0.067, 0.0185, 0.145, 0.253, 0.0000),
    "hook": SightError(0.088, 0.0447, 0.320, 0.300, 0.0000),
}
"""noise_deg, bias_per_deg, bias_deg, sigma_deg, declined."""
