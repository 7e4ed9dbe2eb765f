"""Draws the animation at the top of README.md: the same simulated lift without and with the guard.

Rotation, force, height and gel images are those of the simulated lifts. Object, fingers and table are a sketch; the
fall after the drop is drawn, not simulated.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.sim.catalogue import find_object
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.scenario import scenario
from slipguard.sim.sensor_unit import SensorUnit
from slipguard.sim.world import WorldTruth
from slipguard.sim_lifts.campaign import CampaignSettings, run_campaign
from slipguard.sim_lifts.lift_record import LiftRecord

Image = NDArray[np.uint8]
STEP_S: Final = 0.08
BEFORE_S, AFTER_S = 0.25, 1.2
WIDTH_PX, HEIGHT_PX = 300, 240
GEL_PX = (102, 136)
SCENE_PX, TABLE_Y_PX, MM_PX = (155, WIDTH_PX - 50), 212, 0.78
"""Left and right end, table, pixels per millimeter."""
ROD_MM, HEAD_MM = 12.0, 34.0
FINGER_PX = np.array((6.0, 32.0))
WHITE, INK, GRAY = (255, 255, 255), (50, 45, 40), (170, 165, 160)
BAR_BGR, HEAD_BGR, FINGER_BGR, GOOD_BGR, BAD_BGR = (
    (196, 148, 84),
    (150, 100, 50),
    (90, 85, 80),
    (80, 140, 40),
    (50, 50, 200),
)
QUALITY = 70


@dataclass(frozen=True)
class OneLift(CampaignSettings):
    """One lift of one object."""

    name: str = "wrench"

    def objects(self) -> list[tuple[str, int]]:
        """Return the object with the seed of its scenario."""
        return [(self.name, self.seed)]


def draw_animation(to: Path, name: str, seed: int) -> None:
    """Write the animation as WebP."""
    settings = OneLift(name=name, seed=seed, realtime=False)
    sides = [
        LiftPanel(run_virtual(run_campaign(replace(settings, guarded=guarded), lambda _: None))[0], guarded)
        for guarded in (False, True)
    ]
    length_s = max(side.length_s for side in sides)
    frames = [np.hstack([side.draw(step * STEP_S) for side in sides]) for step in range(int(length_s / STEP_S))]
    animation = cv2.Animation()
    animation.frames = frames
    animation.durations = [round(1000 * STEP_S)] * (len(frames) - 1) + [2500]
    if not cv2.imwriteanimation(str(to), animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY]):
        raise OSError(f"{to} cannot be written")


class LiftPanel:
    """One side of the animation. length_s: from shortly before the lift to shortly after its end."""

    def __init__(self, record: LiftRecord, guarded: bool) -> None:
        self._record, self._guarded = record, guarded
        self._scenario, self._item = scenario(record.object_name, 0), find_object(record.object_name)
        lift_s = next(now.time_s for now in record.truth if now.height_mm > 0.1)
        self._from_s, self._end_s = lift_s - BEFORE_S, min(record.ended_at_s, record.truth[-1].time_s)
        self.length_s = self._end_s - self._from_s + AFTER_S
        self._times_s = [now.time_s for now in record.truth]

    def draw(self, after_s: float) -> Image:
        """Return the panel at a time after the begin."""
        now_s = self._from_s + after_s
        truth = self._record.truth[max(0, bisect_right(self._times_s, min(now_s, self._end_s)) - 1)]
        dropped = self._record.outcome == "dropped" and now_s > self._end_s
        panel = np.full((HEIGHT_PX, WIDTH_PX, 3), WHITE, np.uint8)
        _text(panel, "with slipguard" if self._guarded else "without slipguard", (14, 26), 0.6, INK)
        self._draw_scene(panel, truth, 4905.0 * (now_s - self._end_s) ** 2 if dropped else 0.0)
        panel[44 : 44 + GEL_PX[1], 14 : 14 + GEL_PX[0]] = self._gel(None if dropped else truth)
        rotation_deg = truth.rotation_deg - self._record.truth[0].rotation_deg
        _text(
            panel,
            "dropped" if dropped else f"rotation {abs(rotation_deg):.0f} deg",
            (14, 204),
            0.5,
            self._color(dropped),
        )
        _text(panel, f"grip {truth.force_n:.0f} N", (14, 226), 0.5, INK)
        return panel

    def _color(self, dropped: bool) -> tuple[int, int, int]:
        return BAD_BGR if dropped else GOOD_BGR if self._guarded else INK

    def _gel(self, truth: WorldTruth | None) -> Image:
        view = GelView("")
        if truth is not None and truth.in_contact:
            depth_mm = self._item.press_mm * math.sqrt(truth.force_n / 40.0)
            view = GelView(self._record.object_name, angle_deg=truth.angle_deg, depth_mm=depth_mm)
        image = GelCamera(SensorUnit(), seed=0).draw(view)  # always the same noise, which costs no bytes
        return np.asarray(cv2.resize(image, GEL_PX, interpolation=cv2.INTER_AREA), np.uint8)

    def _draw_scene(self, panel: Image, truth: WorldTruth, fallen_mm: float) -> None:
        """Draw a rod with its mass at the end; the distance of the mass from the fingers is the object's."""
        reach_mm, leftwards = self._item.com_offset_mm, self._scenario.lever_sign > 0
        cv2.line(panel, (SCENE_PX[0] - 12, TABLE_Y_PX), (WIDTH_PX - 8, TABLE_Y_PX), GRAY, 2, cv2.LINE_AA)
        angle = math.radians(truth.rotation_deg - self._record.truth[0].rotation_deg) + math.pi * leftwards
        along = np.array((math.cos(angle), -math.sin(angle)))
        across = np.array((along[1], -along[0]))
        up_mm = truth.height_mm + HEAD_MM / 2 + 4
        grip = np.array((SCENE_PX[leftwards], TABLE_Y_PX - MM_PX * up_mm))
        lowest_y = grip[1] + MM_PX * (max(0.0, along[1]) * (reach_mm + HEAD_MM / 2) + abs(across[1]) * HEAD_MM / 2)
        fallen_px = min(MM_PX * (fallen_mm + truth.slip_mm), max(0.0, TABLE_Y_PX - lowest_y))
        at = grip + np.array((0.0, fallen_px))

        def box(from_mm: float, to_mm: float, thick_mm: float, color: tuple[int, int, int]) -> None:
            ends = [
                at + MM_PX * (end * along + side * across * thick_mm / 2)
                for end, side in ((from_mm, -1), (to_mm, -1), (to_mm, 1), (from_mm, 1))
            ]
            cv2.fillPoly(panel, [np.round(np.array(ends)).astype(np.int32)], color, cv2.LINE_AA)

        box(-10.0, reach_mm, ROD_MM, BAR_BGR)
        box(reach_mm - HEAD_MM / 2, reach_mm + HEAD_MM / 2, HEAD_MM, HEAD_BGR)
        cv2.rectangle(
            panel, _pixel(grip - FINGER_PX), _pixel(grip + FINGER_PX * (1.0, 0.25)), FINGER_BGR, 2, cv2.LINE_AA
        )


def _pixel(place: NDArray[np.float64]) -> tuple[int, int]:
    return round(float(place[0])), round(float(place[1]))


def _text(panel: Image, text: str, where: tuple[int, int], scale: float, color: tuple[int, int, int]) -> None:
    cv2.putText(panel, text, where, cv2.FONT_HERSHEY_SIMPLEX, scale, color, 1, cv2.LINE_AA)
