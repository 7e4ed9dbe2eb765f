"""Follows the reference's texture: registers it, and decides which of similar rotations it shows."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

from slipguard.perception.estimate import DeclineReason, RotationEstimate, explain
from slipguard.perception.gel_memory import ImprintMemory
from slipguard.perception.registration import Registration, TexturePose, register
from slipguard.perception.rotation_filter import Hypothesis, RotationFilter
from slipguard.perception.texture_map import REDUCTION, TextureMap
from slipguard.perception.texture_template import (
    CAPTURE_DEG,
    SIMILAR_APART_DEG,
    STARTS_MAX,
    TextureTemplate,
    correlation_curve,
    maxima_deg,
    similar_deg,
)

SEARCH_S = 0.06
"""After a search that found nothing, or little, the next one follows this much later: it takes longer than all other
work of a frame."""
FOUND_ALIKE = 0.7
"""Smallest correlation of a texture that is found by a search: another object's may correlate by chance. With a smaller
one near the expected rotation, it may also be elsewhere: it is searched."""
MEMORY_ALIKE = 0.85
"""The gel's memory is estimated only while the texture's correlation with the reference is above this."""


@dataclass(frozen=True, slots=True)
class TrackedTexture:
    """Rotation of the texture since the reference, and the shift of the reference's center.

    shift_px: frame pixels right and down; None if unknown. best: the registration it comes from.
    """

    rotation: RotationEstimate
    best: Registration
    shift_px: tuple[float, float] | None = None


class TextureTracker:
    """Follows one reference. template: its texture. rotations: the filter that holds its rotation."""

    def __init__(self, template: TextureTemplate, rotations: RotationFilter) -> None:
        self._template = template
        self._rotations = rotations
        self._pose = TexturePose()
        self._memory = ImprintMemory()
        self._searched: tuple[float, TrackedTexture | None] = (-math.inf, None)

    @property
    def round(self) -> bool:
        """Whether the texture shows a shift only."""
        return self._template.round_reason is not None

    @property
    def smooth(self) -> bool:
        """Whether the texture shows no shift in one direction."""
        return self._template.smooth is not None

    @cached_property
    def similar_deg(self) -> list[float]:
        """The rotations after which the texture is similar to itself, without 0."""
        return [] if self.round else similar_deg(self._template)

    def track(self, texture_map: TextureMap, center_px: tuple[float, float], now_s: float) -> TrackedTexture:
        """Return the rotation since the reference in the frame of `now_s`.

        center_px: the contact's center, frame pixels: a search of all rotations begins there.
        """
        start = replace(self._pose, rotation_deg=self._rotations.predicted_deg(now_s))
        if self.round:
            best = register(self._template, texture_map, start)
            self._pose = best.pose if best.alike > MEMORY_ALIKE else TexturePose(start.rotation_deg)
            return self._tracked(RotationEstimate(None, None, best.declined), best)
        searched_s, last = self._searched
        pausing = 0.0 <= now_s - searched_s < SEARCH_S
        lost = self._rotations.reach_deg(now_s) > CAPTURE_DEG
        if lost and pausing and last is not None:
            return last
        found = self._near(texture_map, start)
        searches = lost or (max(one.alike for one in found) < FOUND_ALIKE and not pausing)
        if searches:
            self._search(found, texture_map, start, center_px, now_s)
        found = [one for one in found if one.declined is None] or found
        best = max(found, key=lambda one: one.alike)
        declined = best.declined or (self._by_chance(best, start, now_s) if searches else None)
        if declined is None:
            self._add_similar(found, texture_map, best, now_s)
            rotation = self._rotations.update(
                now_s, [Hypothesis(one.pose.rotation_deg, _log_likelihood(one)) for one in found]
            )
            if rotation.declined is None or self._rotations.others_deg:
                last_deg = self._rotations.last_deg
                best = next(one for one in found if one.pose.rotation_deg == last_deg)
                self._pose = best.pose
        else:
            rotation = RotationEstimate(None, None, declined)
        tracked = self._tracked(rotation, best)
        if searches:
            self._searched = now_s, tracked if rotation.declined else None
        return tracked

    def _near(self, texture_map: TextureMap, start: TexturePose) -> list[Registration]:
        """Return the registrations from the expected rotation of every hypothesis, at least one."""
        found: list[Registration] = []
        for by_deg in (0.0, *self._rotations.others_deg):
            one = replace(start, rotation_deg=start.rotation_deg + by_deg)
            _add(found, register(self._template, texture_map, one))
        return found

    def _search(
        self,
        found: list[Registration],
        texture_map: TextureMap,
        start: TexturePose,
        center_px: tuple[float, float],
        now_s: float,
    ) -> None:
        """Add the registrations from the rotations at which the texture correlates best, within reach."""
        x, y = self._template.center_px
        moved = center_px[0] / REDUCTION - x, center_px[1] / REDUCTION - y
        curve = correlation_curve(self._template, texture_map, moved)
        reach_deg = max(self._rotations.reach_deg(now_s), CAPTURE_DEG)
        for likely_deg in maxima_deg(curve, start.rotation_deg, reach_deg)[:STARTS_MAX]:
            _add(found, register(self._template, texture_map, TexturePose(likely_deg, *moved)))

    def _add_similar(
        self, found: list[Registration], texture_map: TextureMap, best: Registration, now_s: float
    ) -> None:
        """Add the registrations at rotations that the texture cannot tell from the best one and the motion allows."""
        here_deg, credible = best.pose.rotation_deg, self._rotations.credible
        if not credible(now_s, here_deg, (-SIMILAR_APART_DEG, SIMILAR_APART_DEG)):
            return
        for by_deg in sorted(credible(now_s, here_deg, self.similar_deg), key=abs)[:STARTS_MAX]:
            similar = register(self._template, texture_map, replace(best.pose, rotation_deg=here_deg + by_deg))
            if similar.declined is None:
                _add(found, similar)

    def _by_chance(self, best: Registration, start: TexturePose, now_s: float) -> str | None:
        """Return why the best registration after a gap may be by chance; None if it is near the expected rotation."""
        near = abs(best.pose.rotation_deg - start.rotation_deg) < CAPTURE_DEG
        if best.alike >= FOUND_ALIKE or (near and self._rotations.reach_deg(now_s) < 180.0 and not self.similar_deg):
            return None
        detail = f"texture correlates by {best.alike:.2f}, limit {FOUND_ALIKE:.2f} after a gap"
        return explain(DeclineReason.CONTACT_CHANGED, detail)

    def _tracked(self, rotation: RotationEstimate, best: Registration) -> TrackedTexture:
        """Return a rotation with its sigma, corrected for the gel's memory, and the shift."""
        pose = best.pose
        shift = (REDUCTION * pose.dx_px, REDUCTION * pose.dy_px)
        if rotation.rotation_deg is None:
            return TrackedTexture(rotation, best, shift if self.round else None)
        if best.alike > MEMORY_ALIKE:
            self._memory.update(best.ghost)
        return TrackedTexture(self._memory.corrected(best.rotation_deg, best.sigma_deg, best.ghost), best, shift)


def _log_likelihood(found: Registration) -> float:
    """Return the log likelihood of a pose: of the independent points' squares, the share that it does not explain."""
    return -0.5 * found.information * (1.0 - min(max(found.alike, 0.0), 1.0) ** 2)


def _add(found: list[Registration], one: Registration) -> None:
    """Add a registration; of two at the same rotation the better one stays."""
    for k, other in enumerate(found):
        if abs(other.pose.rotation_deg - one.pose.rotation_deg) < SIMILAR_APART_DEG:
            if one.alike > other.alike:
                found[k] = one
            return
    found.append(one)
