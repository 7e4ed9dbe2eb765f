"""The relief followed since the reference, over a later key picture where force or shear has changed the contact.

Every frame is laid over the reference's own relief. Where that has become another one, a key picture stands in, taken
while the reference's was still sure. Its own uncertainty is part of the answer's, keys are never taken from keys, and
the reference is preferred as soon as its relief is seen again: nothing drifts.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from slipguard.perception.contact.patch import Patch
from slipguard.perception.rotation.period import LOOK_DEG, may_be_next, period_deg
from slipguard.perception.rotation.texture_map import REDUCTION, TextureMap
from slipguard.perception.rotation.texture_registration import (
    TextureFit,
    TexturePose,
    TextureTemplate,
    fit_texture,
    make_texture_template,
)
from slipguard.perception.rotation.texture_sigma import sigma_deg

SURE_DEG = 1.5
"""A turn told this surely by the reference's relief needs no key. Shear deforms a contact evenly: the reference's sigma
is larger then, but its error less, than that of a key taken on the way."""
KEY_SIGMA_DEG = 1.2
"""A key is taken only while the turn is known this well."""
KEY_ALIKE = 0.93
"""... and only where the relief has become this unlike the reference's."""
KEY_STEP = 1.2
"""... and less certain than the last key by this."""
AMBIGUOUS_PERIOD = "lost count of a relief that repeats itself"


@dataclass(frozen=True, slots=True)
class TrackedTexture:
    """Turn since the reference, shift of the reference's centre (frame pixels right and down); declined: why not.

    unlike: 1 where the contact is as it was, more the more it has deformed. smooth: the direction (right, down; of
    length 1) along which the relief tells no shift; None where there is none.
    """

    rotation_deg: float | None
    sigma_deg: float | None
    shift_px: tuple[float, float] | None
    unlike: float
    declined: str | None = None
    smooth: tuple[float, float] | None = None

    def shift(self, outline_px: Callable[[], tuple[float, float]]) -> tuple[float, float]:
        """The shift; what the relief does not tell of it is the outline's. Frame pixels right and down."""
        if self.shift_px is None:
            return outline_px()
        if self.smooth is None:
            return self.shift_px
        (dx, dy), (x, y), (along_x, along_y) = self.shift_px, outline_px(), self.smooth
        missing = (x - dx) * along_x + (y - dy) * along_y
        return dx + missing * along_x, dy + missing * along_y


@dataclass(frozen=True, slots=True, eq=False)
class _Key:
    """A relief and where the reference was when it was taken. at_px: the reference's centre from the key's."""

    texture: TextureTemplate
    rotation_deg: float
    sigma_deg: float
    shift_px: tuple[float, float]
    at_px: tuple[float, float]


class TextureTracker:
    """Follows one reference. texture: its relief."""

    def __init__(self, texture: TextureTemplate) -> None:
        self._first = texture
        self._pitch: tuple[float | None] | None = None
        self._pose = TexturePose()
        self._key: _Key | None = None
        self._key_pose = TexturePose()

    @property
    def period_deg(self) -> float | None:
        """The turn after which the relief looks like itself, None for no such turn; found when it is first asked."""
        if self._pitch is None:
            self._pitch = (period_deg(self._first),)
        return self._pitch[0]

    def follow(
        self,
        relief: TextureMap,
        patch: Patch,
        predicted_deg: float,
        start: tuple[float, tuple[float, float]] | None = None,
        *,
        possible_rotation_deg: float = 0.0,
    ) -> TrackedTexture:
        """The turn since the reference, from where the track leads.

        start: another turn and shift (frame pixels right and down) to look from; None: from where the track leads.
        possible_rotation_deg: how far from there the contact may have come since it was last seen.
        """
        pose = replace(self._pose, rotation_deg=predicted_deg)
        if start is not None:
            pose = TexturePose(start[0], start[1][0] / REDUCTION, start[1][1] / REDUCTION)
        answer = fit_texture(self._first, relief, pose)
        found = self._followed(
            self._first, answer, (answer.pose.dx_px, answer.pose.dy_px), answer.pose.rotation_deg, 0.0
        )
        laid = answer
        if found.sigma_deg is None or found.sigma_deg > SURE_DEG:
            by_key = self._by_key(relief, pose.rotation_deg)
            if by_key is not None and (found.sigma_deg is None or (by_key[0].sigma_deg or 180.0) < found.sigma_deg):
                found, laid = by_key
        if found.rotation_deg is None or found.sigma_deg is None or found.shift_px is None:
            return found
        if self.leaps(found.rotation_deg - predicted_deg, possible_rotation_deg):
            return TrackedTexture(None, None, None, 1.0, AMBIGUOUS_PERIOD)
        shift = (found.shift_px[0] / REDUCTION, found.shift_px[1] / REDUCTION)
        if laid is not answer:
            self._pose = TexturePose(found.rotation_deg, shift[0], shift[1])
        else:
            self._pose = answer.pose
        newer = self._key is None or found.sigma_deg > KEY_STEP * self._key.sigma_deg
        if laid is answer and newer and laid.alike < KEY_ALIKE and found.sigma_deg < KEY_SIGMA_DEG:
            self._take_key(relief, patch, found.rotation_deg, found.sigma_deg, shift)
        return found

    def leaps(self, by_deg: float, possible_rotation_deg: float) -> bool:
        """Whether what repeats, found so far from where the track led, may be a step on."""
        if not may_be_next(by_deg, possible_rotation_deg, LOOK_DEG):  # not even of the finest
            return False
        return self.period_deg is not None and may_be_next(by_deg, possible_rotation_deg, self.period_deg)

    def _by_key(self, relief: TextureMap, predicted_deg: float) -> tuple[TrackedTexture, TextureFit] | None:
        key = self._key
        if key is None:
            return None
        laid = fit_texture(key.texture, relief, replace(self._key_pose, rotation_deg=predicted_deg - key.rotation_deg))
        if laid.declined is not None:
            return None
        self._key_pose = laid.pose
        rotation = math.radians(laid.pose.rotation_deg)
        c, s = math.cos(rotation), math.sin(rotation)
        x, y = key.at_px
        shift = (
            key.shift_px[0] + laid.pose.dx_px + c * x + s * y - x,
            key.shift_px[1] + laid.pose.dy_px + c * y - s * x - y,
        )
        return self._followed(key.texture, laid, shift, key.rotation_deg + laid.pose.rotation_deg, key.sigma_deg), laid

    def _take_key(
        self, relief: TextureMap, patch: Patch, rotation_deg: float, sigma: float, shift_px: tuple[float, float]
    ) -> None:
        texture = make_texture_template(relief, patch)
        if texture is None:
            return
        first = self._first.center_px
        at = (first[0] + shift_px[0] - texture.center_px[0], first[1] + shift_px[1] - texture.center_px[1])
        self._key = _Key(texture, rotation_deg, sigma, shift_px, at)
        self._key_pose = TexturePose()

    def _followed(
        self,
        texture: TextureTemplate,
        laid: TextureFit,
        shift_px: tuple[float, float],
        rotation_deg: float,
        key_sigma_deg: float,
    ) -> TrackedTexture:
        if laid.declined is not None:
            return TrackedTexture(None, None, None, laid.unlike, laid.declined)
        shift = (REDUCTION * shift_px[0], REDUCTION * shift_px[1])
        smooth = None if texture.smooth is None else _rotated(texture.smooth, laid.pose.rotation_deg)
        if self._first.smooth is not None:  # what it has not told at the start no key knows, either
            smooth = _rotated(self._first.smooth, rotation_deg)
        return TrackedTexture(
            rotation_deg, math.hypot(key_sigma_deg, sigma_deg(laid)), shift, laid.unlike, smooth=smooth
        )


def _rotated(way: tuple[float, float], rotation_deg: float) -> tuple[float, float]:
    """A direction (right, down) turned counter-clockwise as seen."""
    c, s = math.cos(math.radians(rotation_deg)), math.sin(math.radians(rotation_deg))
    return c * way[0] + s * way[1], c * way[1] - s * way[0]
