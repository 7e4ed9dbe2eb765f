"""What a real contact does that an imprint of a rigid object rotating in the image plane does not.

Three effects: the object is tilted out of the image plane and rolls on the gel; the gel shears and twists under load,
so that parts of the imprint lag behind the object; the gel remembers past imprints.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slipguard.errors import InputError
from slipguard.sim.raster import Field, f32

TILT_MAX_DEG = 12.0
TILT_FLOOR_MM = -5.0
"""Depth of the rasters of tilted objects: what a tilt of `TILT_MAX_DEG` lifts from 16 mm away to the gel's reach."""
_NEAR_MM = 1e-3


@dataclass(frozen=True, slots=True)
class GelEffects:
    """Deviation of one imprint from that of a rigid object in the image plane; the defaults are no deviation.

    The true rotation of the object is the view's `angle_deg`, however the imprint deforms.

    Attributes:
        pitch_deg: tilt that brings the object's +u side closer to the gel. The object rolls without sliding: on a
            curved side the contact moves along it. The force on the gel stays the same.
        roll_deg: the same for the +v side.
        twist_deg: the middle of the contact, which sticks, rotates with the object; the gel around it lags behind by up
            to this angle. A soft gel twists 9-17 degrees before any slip (G 0.14 MPa, 20 N, friction 0.6: inferred
            from torque = 16/3 G a^3 angle, Johnson, Contact Mechanics, 1985, section 3.9).
        shear_mm: the gel around the middle lags behind the object's shift by up to this, right and up. About 0.7 mm at
            a tangential load of 5 N on a contact of radius 5 mm (Johnson 1985, section 7.2).
        stick_mm: radius of the sticking middle. Partial slip starts at the rim and moves inwards as the load grows:
            radius * (1 - load / (friction * force))^(1/3) (Cattaneo 1938, Mindlin 1949; Johnson 1985, section 7.2).
    """

    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    twist_deg: float = 0.0
    shear_mm: tuple[float, float] = (0.0, 0.0)
    stick_mm: float = 3.0

    def check(self) -> None:
        """Raise InputError if a value is not finite or out of range."""
        values = (self.pitch_deg, self.roll_deg, self.twist_deg, *self.shear_mm, self.stick_mm)
        if not all(map(math.isfinite, values)) or self.stick_mm <= 0.0:
            raise InputError(f"effects must be finite, stick_mm above 0: {self}")
        if max(abs(self.pitch_deg), abs(self.roll_deg)) > TILT_MAX_DEG:
            raise InputError(f"an object is tilted by at most {TILT_MAX_DEG:g} degrees: {self}")

    @property
    def tilted(self) -> bool:
        return self.pitch_deg != 0.0 or self.roll_deg != 0.0

    @property
    def deformed(self) -> bool:
        return self.twist_deg != 0.0 or self.shear_mm != (0.0, 0.0)

    def undeformed(self, right_mm: Field, up_mm: Field) -> tuple[Field, Field]:
        """Return where the imprint's points would be without twist and shear, from where they are.

        Args:
            right_mm, up_mm: from the object's origin.
        """
        radius = np.hypot(right_mm, up_mm)
        inner = f32(np.float32(self.stick_mm) / np.maximum(radius, np.float32(max(self.stick_mm, _NEAR_MM))))
        # Displacement of an elastic half-space outside a rigid circular stamp: twisted (Reissner and Sagoci 1944),
        # and pushed sideways (the part without direction; Johnson 1985, section 3.7). 1 on the stamp.
        sine = np.arcsin(inner)
        sheared = f32(1.0 - (2.0 / math.pi) * sine)
        twisted = f32(1.0 - (2.0 / math.pi) * (sine - inner * np.sqrt(1.0 - inner * inner)))
        right = right_mm + np.float32(self.shear_mm[0]) * sheared
        up = up_mm + np.float32(self.shear_mm[1]) * sheared
        lag = f32(math.radians(self.twist_deg) * twisted)
        c, s = np.cos(lag), np.sin(lag)
        return f32(c * right - s * up), f32(s * right + c * up)


@dataclass(frozen=True, slots=True)
class GelMemory:
    """Memory of a gel for past imprints: image = (1 - share) * imprint now + share * past imprints, fading.

    No published figures for the DIGIT's gel were found: the ranges of the trials are a guess.

    Attributes:
        share: 0 for none.
        fade_s: time constant of the past; infinite: the imprint that `GelCamera.settle` kept stays.
        frame_s: time between two frames.
    """

    share: float
    fade_s: float = math.inf
    frame_s: float = 1.0 / 60.0
