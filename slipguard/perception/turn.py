"""The turn and shift of a patch since the reference, and when a patch becomes the reference."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2

from slipguard.perception.estimate import Orientation
from slipguard.perception.regions import Patch
from slipguard.perception.register import NOT_SAME, Pose, Registrar, Registration
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.stages import StageClock
from slipguard.perception.template import Template, make_template
from slipguard.perception.track import Tracker, Turn, axis_turn, checked, pooled

STABLE_FRAMES = 5
STABLE_SHARE = 0.05
"""The contact area is stable when the last five frames differ by less than this share of it."""
MISFIT_SIGMAS = 1.5
"""An axis whose outline is not the reference's any more is off by so many times the turn that fits the misfit."""
NO_REFERENCE = "no reference yet"
UNSURE = "too uncertain"


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """What turns are measured against. axes: by estimator. Centre and area in frame pixels."""

    axes: Mapping[str, Orientation]
    template: Template
    centre_px: tuple[float, float]
    area_px: int


class TurnMeter:
    """Takes the reference and measures every patch against it. frame_px: frame pixels per network pixel."""

    def __init__(self, settings: PerceptionSettings, frame_px: float) -> None:
        self._settings = settings
        self._frame_px = frame_px
        self.reference: Reference | None = None
        self.tracker = Tracker()
        self._pose = Pose()
        self._areas: deque[int] = deque(maxlen=STABLE_FRAMES)

    def lost(self) -> None:
        """There is no contact: a reference not yet taken needs a new run of stable frames."""
        self._areas.clear()

    def measure(
        self, patch: Patch, axes: Mapping[str, Orientation], now_s: float, clock: StageClock
    ) -> tuple[Turn, tuple[float, float] | None]:
        """Turn and shift (frame pixels right and down) since the reference, which this patch may become.

        axes: the patch's axis by each estimator used; each is compared with its own answer for the reference.
        """
        self._take_reference(patch, axes, now_s)
        reference = self.reference
        if reference is None:
            return Turn(None, None, NO_REFERENCE), None
        predicted = self.tracker.predicted_deg(now_s)
        known = reference.axes
        turn = pooled([_between(known[name], axis, predicted) for name, axis in axes.items() if name in known])
        shift_px = _difference(_centre_px(patch), reference.centre_px)
        if self._settings.estimator in ("fused", "registration"):
            laid = self._laid_over(reference, patch, turn, predicted)
            registered = Turn(None, None, laid.declined)
            if laid.declined == NOT_SAME and turn.turn_deg is not None and turn.sigma_deg is not None:
                # An outline that has become another one has moved its axis too.
                turn = Turn(turn.turn_deg, math.hypot(turn.sigma_deg, MISFIT_SIGMAS * laid.misfit_deg))
            if laid.declined is None:
                self._pose = laid.pose
                registered = Turn(laid.pose.turn_deg, laid.sigma_deg)
                shift_px = (laid.pose.dx_px * self._frame_px, laid.pose.dy_px * self._frame_px)
            turn = registered if self._settings.estimator == "registration" else checked(registered, turn)
            clock.mark("register")
        if turn.sigma_deg is not None and turn.sigma_deg > self._settings.sigma_max_deg:
            turn = Turn(None, None, UNSURE)
        turn = self.tracker.accept(now_s, turn)
        return turn, shift_px

    def _take_reference(self, patch: Patch, axes: Mapping[str, Orientation], now_s: float) -> None:
        if self.reference is not None:
            return
        self._areas.append(patch.area_px)
        if self._settings.reference == "stable":
            largest, smallest = max(self._areas), min(self._areas)
            if len(self._areas) < STABLE_FRAMES or largest - smallest >= STABLE_SHARE * largest:
                return
        self.reference = Reference(dict(axes), make_template(patch), _centre_px(patch), patch.area_px)
        self.tracker.start(now_s)
        self._pose = Pose()

    def _laid_over(self, reference: Reference, patch: Patch, turn: Turn, predicted_deg: float) -> Registration:
        """The patch laid over the reference, from where the track leads or from where its axis points."""
        registrar = Registrar(reference.template, patch)
        best = registrar.fit(replace(self._pose, turn_deg=predicted_deg))
        if turn.turn_deg is None or abs(turn.turn_deg - best.pose.turn_deg) < 4.0:
            return best
        dx, dy = _difference(_centre_px(patch), reference.centre_px)
        other = registrar.fit(Pose(turn.turn_deg, dx / self._frame_px, dy / self._frame_px))
        better = other.declined is None and (best.declined is not None or other.residual < best.residual)
        return other if better else best


def _between(reference: Orientation, now: Orientation, near_deg: float) -> Turn:
    """The turn between two answers of one estimator."""
    if reference.angle_deg is None or reference.sigma_deg is None:
        return Turn(None, None, reference.declined)
    if now.angle_deg is None or now.sigma_deg is None:
        return Turn(None, None, now.declined)
    return axis_turn(now.angle_deg, now.sigma_deg, reference.angle_deg, reference.sigma_deg, near_deg)


def _centre_px(patch: Patch) -> tuple[float, float]:
    """Centre of the patch in frame pixels, right and down."""
    m = cv2.moments(patch.mask, True)
    return patch.to_frame(m["m10"] / m["m00"], m["m01"] / m["m00"])


def _difference(now: tuple[float, float], before: tuple[float, float]) -> tuple[float, float]:
    return (now[0] - before[0], now[1] - before[1])
