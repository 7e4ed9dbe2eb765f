"""Shapes turned, shifted, scaled, mirrored and cut by the frame: what is read turns with them."""

from __future__ import annotations

import numpy as np

from slipguard.stress.family import FamilyResults, TrialFamily, TrialFunction
from slipguard.stress.map_checks import Map, compare
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.rotating_shapes import readings_of, rotation_held
from slipguard.stress.shapes import ALONG_U, ELONGATED, LONG_BAR, ShapePose, soft


def _cut(probability: Map) -> bool:
    """Whether the frame cuts the shape."""
    return bool(
        max(probability[0].max(), probability[-1].max(), probability[:, 0].max(), probability[:, -1].max()) > 0.1
    )


def _begin(product: ProductFunctions) -> TrialFunction:
    names = (*ELONGATED, "long bar")

    def trial(rng: np.random.Generator, seed: int, results: FamilyResults) -> None:
        name = names[seed % len(names)]
        shape = LONG_BAR if name == "long bar" else ELONGATED[name]
        spread = 45.0 if seed % 4 == 3 else 12.0
        mirrored = bool(rng.integers(2))
        a = ShapePose(rng.uniform(-180, 180), 59.5 + rng.uniform(-1, 1) * spread, 79.5 + rng.uniform(-1, 1) * spread,
                 rng.uniform(0.6, 1.2), mirrored)  # fmt: skip
        rotation = float(rng.uniform(-90, 90))
        b = ShapePose(a.angle_deg + rotation, 59.5 + rng.uniform(-1, 1) * spread, 79.5 + rng.uniform(-1, 1) * spread,
                 rng.uniform(0.6, 1.2), mirrored)  # fmt: skip
        maps = soft(shape, a), soft(shape, b)
        # What the frame leaves of a shape that is not symmetric has another axis: only the pipeline, which knows the
        # reference, can tell.
        whole = name in ALONG_U or name == "long bar" or not any(_cut(one) for one in maps)
        readings = readings_of(maps, product, results) if whole else None
        if readings is not None:
            before, now = readings
            compare(before, now, rotation, results)
            if name in ALONG_U:
                for reader, found in now.items():
                    results.check_angle(
                        f"{reader}, absolute", found.angle_deg, found.sigma_deg, b.angle_deg, axial=True
                    )
        rotation = float(rng.uniform(-25, 25))
        near = ShapePose(a.angle_deg + rotation, a.x_px + rng.uniform(-8, 8), a.y_px + rng.uniform(-8, 8),
                    a.scale * rng.uniform(0.95, 1.1), mirrored)  # fmt: skip
        rotation_held(shape, a, near, product, results, (None, None))

    return trial


EQUIVARIANCE = TrialFamily(
    "equivariance",
    "shapes turned, shifted, scaled, mirrored, cut by the frame",
    20_000,
    11.0,
    _begin,
    min_answered_share=0.85,
)
