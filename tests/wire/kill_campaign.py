"""The daemon of an emulated cell, killed at random moments of a lift and started again, many times."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from cell_rig import Cell, Process, patient_config, patiently, pause, until, wait_for

from slipguard.daemon.api.client import Client
from slipguard.daemon.api.requests import CalibrateRequest, GraspRequest, LiftRequest, LowerRequest, ReleaseRequest

LIFT_S = 4.5
"""A lift of 80 mm, with a stop for slip, and a moment of holding."""
DEAD_S = 0.8
LOOSER_N = 0.5
KEPT_DEG = 3.0
MOST_PATIENT = """watchdog_hz = 2
[guard.tuning]
frames_timeout_s = 5
gripper_timeout_s = 5
arm_timeout_s = 5
cycle_timeout_s = 5
tighten_effect_timeout_s = 10
stuck_timeout_s = 10
closing_timeout_s = 30
"""
"""What another program on this machine does to the doubles' time is not what is looked at."""


@dataclass(frozen=True, slots=True)
class Kill:
    """One kill and what came after. at_s: after the lift was asked for; dead_s: until the next daemon was started.

    guarding_s: from the start of the process until it guarded what it found held; cpu_s: its own work until then.
    rotation_deg: the true rotation at the kill; true_deg, estimated_deg: the true and the estimated
    rotation once guarding again.
    """

    at_s: float
    phase: str
    height_mm: float
    force_n: float
    guarding_s: float
    cpu_s: float
    rotation_deg: float
    true_deg: float
    estimated_deg: float

    @property
    def rotation_kept(self) -> bool:
        """The rotation counts from where the object was gripped, not from where the daemon was killed."""
        return abs(self.estimated_deg - self.true_deg) < KEPT_DEG


@contextmanager
def running(cell: Cell, number: int) -> Iterator[tuple[Process, Client]]:
    """A daemon as a process, asked nothing yet; killed at the end if it still runs."""
    process = Process(
        cell.folder, f"run-{number}", "run", "--config", patient_config(cell, MOST_PATIENT, 5000), "--log-json"
    )
    try:
        # Not before it listens: until it has noticed, the web process of a killed daemon answers for it.
        until(lambda: "slipguard starts" in process.said, "it does not start", lambda: process.said, every_s=0.01)
        with Client(cell.folder / "slipguard.sock") as client:
            yield process, client
    finally:
        process.kill()


def campaign(cell: Cell, kills: int, seed: int) -> Iterator[Kill]:
    """Grasp, lift, kill, start, check, put down; `kills` times. Every deviation is an AssertionError."""
    rng = np.random.default_rng(seed)
    calibrated = False
    for number in range(kills):
        at_s, dead_s = float(rng.uniform(0.0, LIFT_S)), float(rng.uniform(0.0, DEAD_S))
        releases = len(cell.events("released"))
        with running(cell, 2 * number) as (process, client):
            wait_for(client, lambda state: not state["waiting_for"], "the devices are not ready")
            if not calibrated:
                patiently(lambda: client.submit(CalibrateRequest()))
                calibrated = True
            patiently(lambda: client.submit(GraspRequest()))
            wait_for(client, firm, "no grip")
            patiently(lambda: client.submit(LiftRequest()))
            pause(at_s)
            phase = client.state()["phase"]
            before = cell.truth()[-1]
            process.kill()
        pause(dead_s)
        started_s = time.time()
        with running(cell, 2 * number + 1) as (process, client):
            guarding_s, cpu_s = guarded_at_s(process) - started_s, process.cpu_s
            estimated_deg = wait_for(client, estimated_firm, "not firm")["rotation"]["rotation_deg"]
            after = cell.truth()[-1]
            assert len(cell.events("released")) == releases, f"kill {number}: the jaws opened"
            assert not after["dropped"], f"kill {number}: it fell: {after}"
            assert after["force"] >= before["force"] - LOOSER_N, f"kill {number}: looser: {before} {after}"
            yield Kill(
                at_s,
                phase,
                before["height"],
                after["force"],
                guarding_s,
                cpu_s,
                before["rotation"],
                after["rotation"],
                estimated_deg,
            )
            put_down(cell, client)
            assert len(cell.events("released")) == releases + 1


def firm(state: dict[str, Any]) -> bool:
    return state["phase"] == "holding" and not state["gripper"]["moving"] and not state["slipping"]


def estimated_firm(state: dict[str, Any]) -> bool:
    return firm(state) and state["rotation"] is not None


def guarded_at_s(process: Process) -> float:
    """When a fresh daemon began to guard the held object, by its log: rotation is estimated, slip is acted on."""

    def lines() -> list[dict[str, Any]]:
        assert process.running, process.said
        return [json.loads(line) for line in process.said.splitlines() if line.startswith("{") and line.endswith("}")]

    def holding() -> list[str]:
        return [line["timestamp"] for line in lines() if line.get("event") == "phase" and line["now"] == "holding"]

    until(holding, "not guarding", lambda: process.said[-2000:])
    assert any("rotation estimated" in line["event"] for line in lines()), process.said
    return datetime.fromisoformat(holding()[0]).timestamp()


def put_down(cell: Cell, client: Client) -> None:
    """Down to the table, and open."""
    wait_for(client, lambda state: not state["waiting_for"] and firm(state), "not firm")
    height_mm = cell.truth()[-1]["height"]
    if height_mm > 1.0:
        patiently(lambda: client.submit(LowerRequest(height_mm=height_mm)))
        wait_for(client, lambda state: firm(state) and cell.truth()[-1]["height"] < 1.0, "still up")
    client.submit(ReleaseRequest(confirm=True))
    wait_for(client, lambda state: state["phase"] == "idle" and state["gripper"]["width_mm"] > 80.0, "no release")


def report(kills: list[Kill], folder: Path) -> str:
    """Figures in one line."""
    times = sorted(kill.guarding_s for kill in kills)
    cpu = sorted(kill.cpu_s for kill in kills)
    kept = sum(kill.rotation_kept for kill in kills)
    phases = {phase: sum(kill.phase == phase for kill in kills) for phase in sorted({kill.phase for kill in kills})}
    p50, p99 = times[len(times) // 2], times[min(len(times) - 1, int(0.99 * len(times)))]
    return (
        f"{len(kills)} kills in {phases}: all held; guarding again after p50 {p50:.2f} s, p99 {p99:.2f} s, longest "
        f"{times[-1]:.2f} s (its own work p50 {cpu[len(cpu) // 2]:.2f} s; {os.cpu_count()} cores, load "
        f"{os.getloadavg()[0]:.1f}); rotation counted on within {KEPT_DEG:g}° in {kept}"
    )
