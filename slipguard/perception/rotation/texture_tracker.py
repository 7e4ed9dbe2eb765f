"""Tracks the texture since the reference, by way of a key image if force or shear has changed the contact.

Every frame is registered to the reference's own texture. If that has changed too much a key image is used instead,
taken while the reference was still certain. The key's own uncertainty is part of the result's, keys are never taken
from keys, and the reference is preferred as soon as it fits again: nothing drifts.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from slipguard.perception.contact.patch import Patch
from slipguard.perception.declined import DeclineReason, explain
from slipguard.perception.rotation.fusion import AGREE_SIGMAS, RotationEstimate
from slipguard.perception.rotation.gel_memory import SHARE_MAX, ImprintMemory
from slipguard.perception.rotation.period_count import PeriodCount
from slipguard.perception.rotation.texture_map import REDUCTION, TextureMap
from slipguard.perception.rotation.texture_registration import (
    ALIKE_MIN,
    APART_DEG,
    UNEVEN_MAX,
    TextureFit,
    TexturePose,
    fit_texture,
    likely_rotations_deg,
    sigma_deg,
)
from slipguard.perception.rotation.texture_template import TextureTemplate, make_texture_template

KEY_NEEDED_DEG = 1.5
"""Sigma of the reference's texture above which a key is used. Shear deforms a contact evenly: the reference's sigma is
then larger, but its error smaller, than that of a key taken on the way."""
KEY_SIGMA_DEG = 1.2
"""A key is taken only while sigma is below this."""
KEY_ALIKE = 0.93
"""A key is taken only if the texture's correlation with the reference is below this."""
KEY_STEP = 1.2
"""A key replaces another one only at a sigma larger by this factor."""
MEMORY_ALIKE = 0.85
"""The gel's memory is estimated only while the texture's correlation with the reference is above this."""
RETRY_DEG = 4.0
"""If the contour's rotation differs by more than this, the texture is also searched for there."""
CENTER_PX, FITS_TOO = 3.0, 2.0
"""If the contact's center is further than this (texture pixels) from where the texture was found, the texture is also
searched for there. It fits at both places unless its lack of correlation is larger at one by this factor."""
BOWED_MAX = 0.3
"""A texture is that of a bowed edge if a rotation with some shift changes it by less than this share (of squares) of
what the two change alone: 0.09 to 0.26 for a bowed knife, 0.25 to 0.4 for rods, 0.4 to 1 for most others."""
DOUBTED_DEG, AWAY_DEG, FITS_AWAY = 2.0, 20.0, 1.4
"""A texture with a larger sigma is also searched for from this far to either side: a coin whose rim is stronger than
its letters fits nearly as well at all rotations between. It fits there too unless its lack of correlation is larger by
the third number: 1.0 to 1.3 for such coins, 1.5 and more for contacts with a clear rotation."""
UNIQUE = 0.1
"""After a gap, the texture's correlation must exceed that at every other rotation by this."""
SEARCH_S = 0.06
"""After a search of all rotations that found nothing, the next one follows this much later: it takes longer than all
other work of a frame."""


@dataclass(frozen=True, slots=True)
class TrackedTexture:
    """Rotation since the reference by the texture, and the shift of the reference's center.

    shift_px: frame pixels right and down. deformation: factor on sigmas; 1 if the contact has not deformed.
    smooth: the direction (right, down; of length 1) along which the texture shows no shift; None if there is none.
    shared_deg: sigma by uneven deformation and by memory that is only possible, which the contour has as well.
    twist_deg: sigma by a middle that has rotated differently, which the contour has as well; not part of `rotation`.
    lean: how much stronger the reference's texture has become on one side; 0 if unknown.
    fit: its registration to the reference; None if a key was used.
    """

    rotation: RotationEstimate
    deformation: float
    shift_px: tuple[float, float] | None = None
    smooth: tuple[float, float] | None = None
    shared_deg: float = 0.0
    twist_deg: float = 0.0
    lean: float = 0.0
    fit: TextureFit | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Key:
    """A texture and the reference's pose when it was taken. at_px: the reference's center from the key's."""

    template: TextureTemplate
    rotation_deg: float
    sigma_deg: float
    shift_px: tuple[float, float]
    at_px: tuple[float, float]


class TextureTracker:
    """Tracks one reference.

    Args:
        template: The reference's texture.
        rotated_unseen: Whether the object may have rotated by any angle since then.
    """

    def __init__(self, template: TextureTemplate, rotated_unseen: bool = False) -> None:
        self._first = template
        self._pose = TexturePose()
        self._uneven_pose: TexturePose | None = None
        self._key: _Key | None = None
        self._key_pose = TexturePose()
        self._memory = ImprintMemory()
        self._searched: tuple[float, TrackedTexture] = (-math.inf, _declined(DeclineReason.NO_REFERENCE))
        self.periods = PeriodCount(template, rotated_unseen)

    @property
    def remembers(self) -> bool:
        """Whether a part of the reference's imprint certainly stays in place: it also distorts the contour."""
        return self._memory.certain

    @property
    def round(self) -> bool:
        """Whether the texture shows a shift only."""
        return self._first.round_reason is not None

    def track(
        self,
        texture_map: TextureMap,
        patch: Patch,
        predicted_deg: float,
        axis: RotationEstimate,
        own_patch: bool = True,
    ) -> TrackedTexture:
        """Return the rotation since the reference, searched near the predicted one, or near the axis if ambiguous.

        own_patch: not that of an earlier frame: only then the texture may become the key, and each texture is searched
            at the patch's center, too.
        """
        if self.round or not self.periods.ambiguous:
            return self._search(texture_map, patch, predicted_deg, None, self.periods.gap_deg, own_patch)
        period = self.periods.period_deg or 0.0
        if axis.rotation_deg is None or axis.sigma_deg is None or AGREE_SIGMAS * axis.sigma_deg >= 0.5 * period:
            return _declined(DeclineReason.PERIOD_AMBIGUOUS)
        found = self._search(texture_map, patch, axis.rotation_deg, None, 0.0, own_patch)
        self.periods.ambiguous = found.rotation.rotation_deg is None
        return found

    def search_everywhere(
        self, texture_map: TextureMap, patch: Patch, predicted_deg: float, now_s: float
    ) -> TrackedTexture:
        """Return the rotation after a gap, in which the object may have rotated by any angle.

        All rotations are tried, about the present contact's center and about the last one. It is declined if the
        texture fits nearly as well at another rotation, the one before the gap included. A declined result counts for
        `SEARCH_S`, without a new search.
        """
        searched_s, found = self._searched
        if not 0.0 <= now_s - searched_s < SEARCH_S or found.rotation.rotation_deg is not None:
            found = self._try_everywhere(texture_map, patch, predicted_deg)
            self._searched = now_s, found
        return found

    def _try_everywhere(self, texture_map: TextureMap, patch: Patch, predicted_deg: float) -> TrackedTexture:
        first = self._first
        x, y = _moved_px(patch, first)
        starts = [replace(self._pose, rotation_deg=predicted_deg)]
        starts += [TexturePose(found_deg, x, y) for found_deg in likely_rotations_deg(first, texture_map, (x, y))]
        fits = sorted((fit_texture(first, texture_map, start) for start in starts), key=lambda fit: -fit.alike)
        best = fits[0]
        for other in fits[1:]:
            apart_deg = abs(math.remainder(other.pose.rotation_deg - best.pose.rotation_deg, 360.0))
            if best.declined is None and apart_deg > 0.5 * APART_DEG and other.alike > best.alike - UNIQUE:
                detail = f"{best.pose.rotation_deg:+.0f} and {other.pose.rotation_deg:+.0f} deg"
                several = RotationEstimate(None, None, explain(DeclineReason.SEVERAL_ROTATIONS, detail))
                return TrackedTexture(several, 1.0, shared_deg=best.uneven_deg, twist_deg=best.twist_deg)
        near_deg = predicted_deg + math.remainder(best.pose.rotation_deg - predicted_deg, 360.0)
        found = self._tracked(first, best, (best.pose.dx_px, best.pose.dy_px), near_deg, 0.0)
        if found.rotation.rotation_deg is not None:
            self._pose, self._uneven_pose, self.periods.ambiguous = best.pose, None, False
        return found

    def track_again(
        self,
        texture_map: TextureMap,
        patch: Patch,
        predicted_deg: float,
        found: TrackedTexture,
        contour: RotationEstimate,
        contour_shift_px: tuple[float, float],
    ) -> TrackedTexture:
        """Search near the contour's rotation if that is far from the first result; return the better result."""
        before_deg = predicted_deg if found.rotation.rotation_deg is None else found.rotation.rotation_deg
        if (
            self.round
            or self.periods.ambiguous
            or contour.rotation_deg is None
            or abs(contour.rotation_deg - before_deg) <= RETRY_DEG
        ):
            return found
        dx, dy = contour_shift_px
        start = TexturePose(contour.rotation_deg, dx / REDUCTION, dy / REDUCTION)
        second = self._search(texture_map, patch, predicted_deg, start, self.periods.gap_deg)
        sigma = second.rotation.sigma_deg
        return found if sigma is None or sigma >= (found.rotation.sigma_deg or 180.0) else second

    def take_key_if_due(self, texture_map: TextureMap, patch: Patch, found: TrackedTexture) -> None:
        """Make this texture the key if it has changed, but is certain, and found by the reference itself."""
        widened = found.rotation.widened(found.twist_deg)
        rotation, sigma, fit = widened.rotation_deg, widened.sigma_deg, found.fit
        if fit is None or rotation is None or sigma is None or found.shift_px is None or self.remembers:
            return
        newer = self._key is None or sigma > KEY_STEP * self._key.sigma_deg
        if newer and fit.alike < KEY_ALIKE and sigma_deg(fit) < KEY_SIGMA_DEG:
            shift = (found.shift_px[0] / REDUCTION, found.shift_px[1] / REDUCTION)
            self._take_key(texture_map, patch, rotation, sigma, shift)

    def _search(
        self,
        texture_map: TextureMap,
        patch: Patch,
        predicted_deg: float,
        start: TexturePose | None,
        gap_deg: float,
        own_patch: bool = True,
    ) -> TrackedTexture:
        """Register to the reference, or to the key if that is better. start: other than the last pose."""
        if start is None:
            start = self._uneven_pose or replace(self._pose, rotation_deg=predicted_deg)
        fit = fit_texture(self._first, texture_map, start)
        if own_patch or self._bowed:
            fit = self._fit_elsewhere(texture_map, patch, fit)
        fit = _doubted(self._first, texture_map, fit)
        # A prediction goes on at the last known rate: after some declined frames it may be at the next of many rays.
        self._uneven_pose = fit.pose if fit.uneven > UNEVEN_MAX and fit.alike >= ALIKE_MIN else None
        if fit.declined is None and fit.alike > MEMORY_ALIKE:
            self._memory.update(fit.ghost)
        found = self._tracked(self._first, fit, (fit.pose.dx_px, fit.pose.dy_px), fit.pose.rotation_deg, 0.0)
        found = replace(found, fit=fit)
        if self.round:
            self._pose = fit.pose if fit.alike > ALIKE_MIN else TexturePose()
            return found
        sigma = found.rotation.sigma_deg
        by_key = False
        own_sigma = sigma_deg(fit)  # possible memory of the gel does not call for a key, which it would spoil too
        if (sigma is None or own_sigma > KEY_NEEDED_DEG) and not self.remembers:
            key_found = self._search_key(texture_map, start.rotation_deg)
            if key_found is not None and (sigma is None or (key_found.rotation.sigma_deg or 180.0) < sigma):
                found, by_key = replace(key_found, lean=fit.lean), True
        rotation, sigma = found.rotation.rotation_deg, found.rotation.sigma_deg
        if rotation is None or sigma is None or found.shift_px is None:
            return found
        if self.periods.may_be_next(rotation - predicted_deg, gap_deg):
            return _declined(DeclineReason.PERIOD_AMBIGUOUS)
        shift = (found.shift_px[0] / REDUCTION, found.shift_px[1] / REDUCTION)
        self._pose = TexturePose(rotation, shift[0], shift[1]) if by_key else fit.pose
        if own_patch:
            self.take_key_if_due(texture_map, patch, found)
        return found

    def _fit_elsewhere(self, texture_map: TextureMap, patch: Patch, fit: TextureFit) -> TextureFit:
        """Search again where the contact's center is, and a bowed edge also where it was; return the better fit.

        A bowed edge that slides along itself while it rotates hardly changes: it fits at several rotations, of which
        sigma covers all.
        """
        if self.round:
            return fit
        starts = [_moved_px(patch, self._first)]
        if self._bowed:
            starts.append((0.0, 0.0))
        for x, y in starts:
            if math.hypot(x - fit.pose.dx_px, y - fit.pose.dy_px) < CENTER_PX:
                continue
            second = fit_texture(self._first, texture_map, replace(fit.pose, dx_px=x, dy_px=y))
            left, second_left = 1.0 - fit.alike, 1.0 - second.alike
            if second.declined is not None or second_left > FITS_TOO * left:
                continue
            fit = second if left > FITS_TOO * second_left else _covering(fit, second)
        return fit

    @cached_property
    def _bowed(self) -> bool:
        """Whether the texture hardly changes if it slides along itself while it rotates."""
        products = (self._first.motion[:3] @ self._first.motion[:3].T).astype(np.float64)
        size = np.sqrt(products.diagonal()) + 1e-9
        return self._first.smooth is None and bool(np.linalg.eigvalsh(products / size[:, None] / size)[0] < BOWED_MAX)

    def _search_key(self, texture_map: TextureMap, predicted_deg: float) -> TrackedTexture | None:
        key = self._key
        if key is None:
            return None
        start = replace(self._key_pose, rotation_deg=predicted_deg - key.rotation_deg)
        fit = _doubted(key.template, texture_map, fit_texture(key.template, texture_map, start))
        if fit.declined is not None:
            return None
        self._key_pose = fit.pose
        rotation = math.radians(fit.pose.rotation_deg)
        c, s = math.cos(rotation), math.sin(rotation)
        x, y = key.at_px
        shift = (
            key.shift_px[0] + fit.pose.dx_px + c * x + s * y - x,
            key.shift_px[1] + fit.pose.dy_px + c * y - s * x - y,
        )
        return self._tracked(key.template, fit, shift, key.rotation_deg + fit.pose.rotation_deg, key.sigma_deg)

    def _take_key(
        self, texture_map: TextureMap, patch: Patch, rotation_deg: float, sigma: float, shift_px: tuple[float, float]
    ) -> None:
        template = make_texture_template(texture_map, patch)
        if template is None:
            return
        first = self._first.center_px
        at = (first[0] + shift_px[0] - template.center_px[0], first[1] + shift_px[1] - template.center_px[1])
        self._key = _Key(template, rotation_deg, sigma, shift_px, at)
        self._key_pose = TexturePose()

    def _tracked(
        self,
        template: TextureTemplate,
        fit: TextureFit,
        shift_px: tuple[float, float],
        rotation_deg: float,
        key_sigma_deg: float,
    ) -> TrackedTexture:
        shift = (REDUCTION * shift_px[0], REDUCTION * shift_px[1])
        if template.round_reason is not None:
            return TrackedTexture(RotationEstimate(None, None, template.round_reason), 1.0, shift)
        if fit.declined is not None:
            no_rotation = TrackedTexture(RotationEstimate(None, None, fit.declined), fit.deformation)
            return replace(no_rotation, shared_deg=fit.uneven_deg, twist_deg=fit.twist_deg, lean=fit.lean)
        if self._memory.too_strong:
            detail = f"share {self._memory.share:.2f}, limit {SHARE_MAX:g}"
            return TrackedTexture(RotationEstimate(None, None, explain(DeclineReason.GEL_MEMORY, detail)), 1.0)
        smooth = None if template.smooth is None else rotated(template.smooth, fit.pose.rotation_deg)
        if self._first.smooth is not None:  # a shift invisible at the reference is invisible by any key
            smooth = rotated(self._first.smooth, rotation_deg)
        rotation = RotationEstimate(rotation_deg, math.hypot(key_sigma_deg, sigma_deg(fit)))
        shared_deg = fit.uneven_deg
        if template is self._first:
            if self._memory.certain:  # it explains the static pattern, and the rotation is corrected for it
                fit = replace(fit, static_bias_deg=0.0)
            rotation = self._memory.corrected(rotation_deg, sigma_deg(fit), fit.ghost)
            shared_deg = math.hypot(shared_deg, self._memory.possible_deg(rotation_deg, fit.ghost))
        return TrackedTexture(rotation, fit.deformation, shift, smooth, shared_deg, fit.twist_deg, fit.lean)


def _doubted(template: TextureTemplate, texture_map: TextureMap, fit: TextureFit) -> TextureFit:
    """Search an uncertain texture from both sides, too; sigma covers all rotations at which it fits as well."""
    if fit.declined is not None or math.hypot(sigma_deg(fit), fit.twist_deg) <= DOUBTED_DEG:
        return fit
    for by_deg in (-AWAY_DEG, AWAY_DEG):
        start = replace(fit.pose, rotation_deg=fit.pose.rotation_deg + by_deg)
        other = fit_texture(template, texture_map, start)
        if other.declined is None and 1.0 - other.alike <= FITS_AWAY * (1.0 - fit.alike):
            fit = _covering(fit, other)
    return fit


def _covering(fit: TextureFit, other: TextureFit) -> TextureFit:
    """Return the fit with a sigma that covers the rotation of another one, too."""
    apart_deg = other.pose.rotation_deg - fit.pose.rotation_deg
    return replace(fit, spread_deg=math.hypot(fit.spread_deg, apart_deg))


def _moved_px(patch: Patch, first: TextureTemplate) -> tuple[float, float]:
    """Return how far the contact's center has moved, texture pixels right and down."""
    (x, y), (before_x, before_y) = patch.center_px, first.center_px
    return x / REDUCTION - before_x, y / REDUCTION - before_y


def _declined(reason: DeclineReason) -> TrackedTexture:
    return TrackedTexture(RotationEstimate(None, None, reason), 1.0)


def rotated(direction: tuple[float, float], rotation_deg: float) -> tuple[float, float]:
    """Rotate a direction (right, down) counter-clockwise as seen in the image."""
    c, s = math.cos(math.radians(rotation_deg)), math.sin(math.radians(rotation_deg))
    return c * direction[0] + s * direction[1], c * direction[1] - s * direction[0]
