"""What each single estimator would have said of the patches that the guard saw."""

from __future__ import annotations

from dataclasses import dataclass

from slipguard.devices import Frame
from slipguard.lab.lift_record import PICTURE_SIGN, Measured
from slipguard.perception.angle import ESTIMATORS, estimate
from slipguard.perception.axial import axial_difference_deg
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.regions import Patch


@dataclass(frozen=True, slots=True, eq=False)
class SeenPatch:
    """A contact patch and when its frame was captured."""

    finger: str
    captured_at_s: float
    patch: Patch


class PatchKeeper:
    """A pipeline that hands every patch it measured on to a list."""

    def __init__(self, finger: str, pipeline: Pipeline, kept: list[SeenPatch]) -> None:
        self._finger = finger
        self._pipeline = pipeline
        self._kept = kept

    def process(self, frame: Frame) -> Estimate:
        """What the pipeline says."""
        answer = self._pipeline.process(frame)
        patch = self._pipeline.last_patch
        if patch is not None and answer.skipped is None and self._pipeline.has_reference:
            self._kept.append(SeenPatch(self._finger, frame.captured_at_s, patch))
        return answer

    def reset_reference(self) -> None:
        """Forget the reference."""
        self._pipeline.reset_reference()


def turns_by_estimator(seen: list[SeenPatch], from_s: float, to_s: float) -> dict[str, list[list[Measured]]]:
    """Per estimator and finger, the turn since its first patch in the span, in the left picture's sign, unwrapped.

    Where an estimator declines, there is no entry.
    """
    patches = {
        finger: [one for one in seen if one.finger == finger and from_s <= one.captured_at_s <= to_s]
        for finger in PICTURE_SIGN
    }
    return {name: [_turns(patches[finger], name, sign) for finger, sign in PICTURE_SIGN.items()] for name in ESTIMATORS}


def _turns(seen: list[SeenPatch], name: str, sign: float) -> list[Measured]:
    turns: list[Measured] = []
    turn_deg, last_deg = 0.0, None
    for one in seen:
        now = estimate(one.patch, name)
        if now.angle_deg is None or now.sigma_deg is None:
            continue
        if last_deg is not None:
            turn_deg += axial_difference_deg(now.angle_deg, last_deg)
        last_deg = now.angle_deg
        turns.append(Measured(one.captured_at_s, sign * turn_deg, now.sigma_deg))
    return turns
