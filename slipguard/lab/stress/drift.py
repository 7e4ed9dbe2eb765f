"""A million tracked frames, and ten minutes of holding: what is held still stays where it is."""

from __future__ import annotations

import math

import numpy as np

from slipguard.lab.stress.family import Family, Notes, Trial
from slipguard.lab.stress.shapes import ELONGATED, Pose, roughness, soft
from slipguard.lab.stress.subject import FRAME_S, Finger, Subject
from slipguard.perception.track import axis_turn

DRIFT_DEG = 0.1
STRETCH_FRAMES = 1000
AXIS_NOISE_DEG = 0.3
REFERENCE_DEG = 37.0
SWING_DEG = 200.0
SWING_FRAMES = 12_000
"""The object swings slowly back and forth, over every seam."""
DRIFT = "drift of the tracked turn"
HOLDING = "drift of the whole pipeline"
ROUGH_PX = 0.1
HOLDING_FRAMES = 20


def _begin_tracking(subject: Subject) -> Trial:
    tracker = subject.tracker()
    started = False
    frame = 0

    def trial(rng: np.random.Generator, seed: int, notes: Notes) -> None:
        nonlocal frame, started
        if not started:
            tracker.start(0.0)
            started = True
        noise = rng.normal(0.0, AXIS_NOISE_DEG, STRETCH_FRAMES)
        off = 0.0
        for k in range(STRETCH_FRAMES):
            frame += 1
            now_s = frame * FRAME_S
            truth = SWING_DEG * math.sin(2.0 * math.pi * frame / SWING_FRAMES)
            axis = math.remainder(REFERENCE_DEG + truth + noise[k], 180.0)
            turn = axis_turn(axis, AXIS_NOISE_DEG, REFERENCE_DEG, 0.0, tracker.predicted_deg(now_s))
            accepted = tracker.accept(now_s, turn)
            if accepted.turn_deg is None:
                off = math.inf
                break
            off += accepted.turn_deg - truth - noise[k]
        mean = abs(off) / STRETCH_FRAMES
        if math.isfinite(mean):
            notes.limit(DRIFT, mean, DRIFT_DEG)
        else:
            notes.failed("nan" if math.isnan(mean) else "limit", f"{DRIFT}: lost at frame {frame}")

    return trial


def _begin_holding(subject: Subject) -> Trial:
    names = ("bar", "ellipse", "key", "hook")
    fingers = {name: Finger(subject) for name in names}
    counts = dict.fromkeys(names, 0)
    stretch: dict[str, list[float]] = {name: [] for name in names}

    def trial(rng: np.random.Generator, seed: int, notes: Notes) -> None:
        # The force creeps up and down and so does the outline; the object does not turn.
        name = names[seed % len(names)]
        for _ in range(HOLDING_FRAMES):
            scale = 1.0 + 0.04 * math.sin(counts[name] / 700.0)
            first = counts[name] == 0
            shown = soft(ELONGATED[name], Pose(25.0, scale=scale), None if first else roughness(rng, ROUGH_PX))
            counts[name] += 1
            answer = notes.attempt("pipeline", fingers[name].see, shown)
            if answer is None:
                return
            notes.angle("pipeline", answer.angle_deg, answer.sigma_deg, 0.0, axial=False)
            if answer.angle_deg is not None and math.isfinite(answer.angle_deg):
                stretch[name].append(answer.angle_deg)
        if len(stretch[name]) >= STRETCH_FRAMES:
            notes.limit(HOLDING, abs(float(np.mean(stretch[name]))), DRIFT_DEG)
            stretch[name].clear()

    return trial


TRACKING = Family(
    "drift", "a million tracked frames over every seam", 1000, 9.0, _begin_tracking, STRETCH_FRAMES, continuous=True
)
HOLD = Family(
    "holding",
    "ten minutes of 60 frames a second, held still under a creeping force",
    36_000 // HOLDING_FRAMES,
    40.0,
    _begin_holding,
    HOLDING_FRAMES,
    continuous=True,
)
