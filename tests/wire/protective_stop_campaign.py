"""Protective stops of an emulated cell's robot at random moments of a lift, many times."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from cell_rig import Cell, patiently, pause, until, wait_for
from kill_campaign import LIFT_S, LOOSER_N, firm, running

from slipguard.daemon.api.client import Client
from slipguard.daemon.api.requests import (
    CalibrateRequest,
    ClearRequest,
    GraspRequest,
    LiftRequest,
    LowerRequest,
    ReleaseRequest,
)
from slipguard.errors import SlipguardError

UNLOCK_S = 5.0
"""A protective stop can be unlocked this long after it began, no sooner."""
SLOW_MM_S = 20.0
SPEED_TOLERANCE_MM_S = 5.0
FORCE_TOLERANCE_N = 0.5


@dataclass(frozen=True, slots=True)
class StoppedLift:
    """One lift with a protective stop.

    Args:
        at_s: time from the request of the lift to the stop.
        phase, height_mm, force_n: at the stop. needed_n: the force that holds the object there.
        refused: the dashboard refused to end the paused script during the stop.
        resumed: a person continued the paused script at the panel as soon as the stop was unlocked.
        controlled_s: from the unlocking until the arm was under control again.
        lowered_s: duration of the way down. speed_mm_s: its highest true speed.
        rotation_deg: largest true rotation from the stop to the table.
    """

    at_s: float
    phase: str
    height_mm: float
    force_n: float
    needed_n: float
    refused: bool
    resumed: bool
    controlled_s: float
    lowered_s: float
    speed_mm_s: float
    rotation_deg: float


def stopped_lifts(cell: Cell, count: int, seed: int) -> Iterator[StoppedLift]:
    """Grasp, lift, stop, unlock, clear, lower, release; `count` times. Every deviation is an AssertionError."""
    rng = np.random.default_rng(seed)
    with running(cell, 0) as (_, client):
        wait_for(client, lambda state: not state["waiting_for"], "the devices are not ready")
        patiently(lambda: client.submit(CalibrateRequest()))
        for _ in range(count):
            yield stopped_lift(cell, client, rng)


def stopped_lift(cell: Cell, client: Client, rng: np.random.Generator) -> StoppedLift:
    """One of them."""
    at_s, refused = float(rng.uniform(0.0, LIFT_S)), bool(rng.random() < 0.5)
    resumed = refused and bool(rng.random() < 0.5)  # otherwise, `play` would start another program
    patiently(lambda: client.submit(GraspRequest()))
    wait_for(client, firm, "no grip")
    patiently(lambda: client.submit(LiftRequest()))
    begun_s = time.monotonic()
    pause(at_s)
    phase = client.state()["phase"]
    if refused:
        cell.order("fault arm.refuse_stop")
    cell.order("fault arm.protective_stop")
    stopped_s = time.monotonic()
    state = state_where(client, lambda state: state["fault"], "the stop is not noticed")
    assert state["fault"]["code"] == "arm in protective stop", state["fault"]
    pause(1.0)
    before = cell.truth()[-1]
    assert "protective stop" in cell.order("arm panel unlock"), "unlocked before 5 s are over"
    pause(max(0.0, stopped_s + UNLOCK_S + 0.1 - time.monotonic()))
    during = cell.truth()[-1]
    check_held(before, during, during["t"])
    assert during["height"] == before["height"], "the arm moved during the stop"
    assert during["force"] <= before["force"] + FORCE_TOLERANCE_N, "the force rose during the stop"
    unlocked_s = time.monotonic()
    if resumed:
        cell.process.send("arm panel unlock")
        cell.order("arm panel play")
        resumed = cell.events("started")[-1]["program"] != "shuttle.urp"
        if not resumed:  # the driver was faster, so this has started the robot's own program
            cell.order("arm panel stop")
    else:
        assert ", normal," in cell.order("arm panel unlock")
    ready = state_where(client, under_control, "not under control again")
    controlled_s = time.monotonic() - unlocked_s
    after = cell.truth()[-1]
    assert after["force"] <= before["force"] + FORCE_TOLERANCE_N, "the force rose before `clear`"
    assert ready["fault"] is not None
    patiently(lambda: client.submit(ClearRequest()))
    wait_for(client, firm, "not firm after `clear`")
    lowered_s, asked_s = 0.0, cell.truth()[-1]["t"]
    if cell.truth()[-1]["height"] > 1.0:
        patiently(lambda: client.submit(LowerRequest()))
        wait_for(client, lambda state: firm(state) and cell.truth()[-1]["height"] < 1.0, "still up")
        lowered_s = time.monotonic() - asked_s
    truth = [line for line in cell.truth() if line["t"] >= before["t"]]
    for line in truth:
        check_held(before, line, asked_s)
    down = [line for line in truth if line["t"] >= asked_s]
    speed_mm_s = highest_speed_mm_s(down)
    assert speed_mm_s < SLOW_MM_S + SPEED_TOLERANCE_MM_S, f"lowered at {speed_mm_s:.0f} mm/s"
    cell.order("clear arm.protective_stop")
    cell.order("clear arm.refuse_stop")
    client.submit(ReleaseRequest(confirm=True))
    wait_for(client, lambda state: state["phase"] == "idle" and state["gripper"]["width_mm"] > 80.0, "no release")
    rotation_deg = max(abs(line["rotation"]) for line in truth)
    return StoppedLift(
        at_s=stopped_s - begun_s,
        phase=phase,
        height_mm=before["height"],
        force_n=before["force"],
        needed_n=before["needed"],
        refused=refused,
        resumed=resumed,
        controlled_s=controlled_s,
        lowered_s=lowered_s,
        speed_mm_s=speed_mm_s,
        rotation_deg=rotation_deg,
    )


def check_held(before: dict[str, Any], line: dict[str, Any], asked_s: float) -> None:
    """Check that the object is held at least as firmly as at the stop."""
    assert not line["dropped"], f"it fell: {line}"
    assert line["force"] >= before["force"] - LOOSER_N, f"looser: {before} {line}"


def under_control(state: dict[str, Any]) -> bool:
    arm = state["arm"]
    return not state["waiting_for"] and arm is not None and not (arm["protective_stop"] or arm["moving"])


def state_where(client: Client, good: Callable[[dict[str, Any]], object], otherwise: str) -> dict[str, Any]:
    """The first state that is as it should be, whether a fault is latched or not."""
    newest: dict[str, Any] = {}

    def reached() -> object:
        nonlocal newest
        try:
            newest = client.state()
        except SlipguardError:
            return False
        return good(newest)

    until(reached, otherwise, lambda: {key: newest.get(key) for key in ("phase", "fault", "waiting_for", "messages")})
    return newest


def highest_speed_mm_s(truth: list[dict[str, Any]]) -> float:
    """Highest speed between lines that are at least 0.1 s apart."""
    highest, start = 0.0, truth[0]
    for line in truth:
        if line["t"] - start["t"] >= 0.1:
            highest = max(highest, abs(line["height"] - start["height"]) / (line["t"] - start["t"]))
            start = line
    return highest


def report(lifts: list[StoppedLift]) -> str:
    """The figures, in a few lines."""
    phases = {phase: sum(one.phase == phase for one in lifts) for phase in sorted({one.phase for one in lifts})}
    up = [one for one in lifts if one.height_mm > 1.0]
    weak = sum(one.force_n < one.needed_n for one in up)
    control = sorted(one.controlled_s for one in lifts)
    rotation_deg = max(one.rotation_deg for one in lifts)
    return (
        f"{len(lifts)} protective stops in {phases}, {len(up)} of them with the object in the air ({weak} while it "
        f"slipped), {sum(one.refused for one in lifts)} with the end of the script refused until the unlocking, "
        f"{sum(one.resumed for one in lifts)} resumed at the panel: all held and lowered; under control again after "
        f"p50 {control[len(control) // 2]:.2f} s, longest {control[-1]:.2f} s; highest speed on the way down "
        f"{max(one.speed_mm_s for one in lifts):.0f} mm/s; largest rotation {rotation_deg:.1f}°"
    )
