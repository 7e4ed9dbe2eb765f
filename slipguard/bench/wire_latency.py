"""Latency from a frame's time stamp to the last byte of the command on the serial line, stage by stage.

The daemon runs in this process, the emulated cell in another one. Both read CLOCK_MONOTONIC, and the emulated gripper
logs when each byte arrived. A slip gives few commands, and a 99th percentile needs hundreds: the controller
therefore adds a small force step now and then while it holds an object.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import random
import tempfile
import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slipguard.config import Config, parse_config
from slipguard.control.control_step import ControlState, control_step
from slipguard.control.messages import HoldForce, Observation, StepOutput
from slipguard.control.params import GuardParams
from slipguard.control.state import Phase
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import CalibrateRequest, GraspRequest
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.service import Service
from slipguard.daemon.run import build_service
from slipguard.errors import SlipguardError
from slipguard.tools.cell_process import CellProcess
from slipguard.tools.sample_statistics import percentiles_ms
from slipguard.tools.waiting import running_service, wait_until

STEP_N = 0.85
"""A little more than one count of the force register (0.843 N)."""
PAUSE_S = (0.12, 0.20)
"""Random pause between two commands: no fixed phase to cameras and polls, and the gripper comes to rest."""


@dataclass(slots=True)
class ForceProbe:
    """One command: its force, the capture time of its frame, and the time of the decision."""

    force_n: float
    captured_at_s: float
    decided_at_s: float


@dataclass(slots=True)
class ProbingController:
    """A replacement for `control_step` that adds force steps. left: the number of steps still to add."""

    left: int
    probes: list[ForceProbe] = field(default_factory=list)
    _due_s: float = 0.0
    _captured_at_s: float = 0.0
    _random: random.Random = field(default_factory=lambda: random.Random(0))

    def __call__(
        self, state: ControlState, observation: Observation, params: GuardParams
    ) -> tuple[ControlState, StepOutput]:
        """Return the state and the command of one control step."""
        state, output = control_step(state, observation, params)
        fused = observation.fused
        if fused is None or fused.captured_at_s <= self._captured_at_s:
            return state, output
        self._captured_at_s = fused.captured_at_s
        force_n = state.grasp.grip.target_n + STEP_N
        settled = state.grasp.phase is Phase.HOLDING and state.grasp.held.slip is None and output.hold_force_n is None
        if (
            not settled
            or self.left <= 0
            or observation.now_s < self._due_s
            or force_n > observation.gripper_limits_n[1]
        ):
            return state, output
        self.left -= 1
        self._due_s = observation.now_s + self._random.uniform(*PAUSE_S)
        self.probes.append(ForceProbe(force_n, fused.captured_at_s, observation.now_s))
        grasp = state.grasp.with_target(force_n, observation.now_s)
        return replace(state, grasp=grasp), replace(output, gripper=HoldForce(force_n))


HOST = f"127.90.{os.getpid() >> 8 & 255}.{os.getpid() % 254 + 1}"
"""An address of this machine that differs between processes, because two measurements may run at once."""
COMMAND_BYTES, BITS_PER_BYTE = 15, 10
STOP, GO = "0100", "0900"
"""First register of the two writes of a tightening."""
READY_S, GRIP_S, COMMAND_S, REST_S = 40.0, 20.0, 5.0, 0.5
STAGES = (
    "camera and USB: exposure to frame received",
    "perception: frame to estimate",
    "controller: estimate to command",
    "line: the pending request completes",
    "line: state request, the manual's 5 ms pause, stop",
    "line: stop confirmed, then go",
    "line: 15 bytes of go",
)
OWN = "slipguard's share: frame received to command"
TOTAL = "exposure to the command's last byte on the wire"


@dataclass(frozen=True, slots=True)
class LatencyOptions:
    """commands: number to measure. baud: of the serial line; 0: unlimited. fps: of the cameras."""

    commands: int = 200
    baud: int = 115200
    fps: int = 60
    object_name: str = "wrench"


@dataclass(frozen=True, slots=True)
class StageLatency:
    """Latency statistics of one stage in milliseconds."""

    p50_ms: float
    p99_ms: float
    largest_ms: float


@dataclass(frozen=True, slots=True)
class LatencyReport:
    """The result. commands: those whose bytes were all found in the gripper's log."""

    options: LatencyOptions
    commands: int
    frames: int
    stages: Mapping[str, StageLatency]


@dataclass(slots=True)
class _CommandTimes:
    """Times of one command in the daemon, by the loop's clock."""

    probe: ForceProbe
    received_at_s: float
    ready_at_s: float
    decided_at_s: float
    called_at_s: float = 0.0


async def measure(options: LatencyOptions, on_progress: Callable[[str, float], None]) -> LatencyReport:
    """Grip an object and tighten it `commands` times, each time after a frame. on_progress(what, share done)."""
    with tempfile.TemporaryDirectory(prefix="slipguard-wire-") as folder:
        cell = CellProcess(
            Path(folder),
            *("--host", HOST, "--object", options.object_name, "--baud", str(options.baud), "--fps", str(options.fps)),
            "--activated",
            "--robot-on",
        )
        try:
            on_progress("starting the emulated cell", 0.0)
            await cell.start()
            probe = ProbingController(0)
            service = build_service(config_without_skipping(cell.config), controller=probe)
            async with running_service(service) as running:
                sent = await _probe(service, probe, options.commands, running, on_progress)
                frames = sum(finger.capture.counts.frames for finger in service.fingers.values())
            log = await cell.order("gripper log 10000")
        finally:
            await cell.stop()
    writes = [entry for entry in map(json.loads, log.splitlines()) if entry["event"] == "write"]
    return _evaluate(options, sent, writes, frames)


def config_without_skipping(path: Path) -> Config:
    """Return the cell's configuration without skipping and with a force limit that allows all steps."""
    raw = tomllib.loads(path.read_text())
    raw["guard"] |= {"force_max_n": 235}
    raw["perception"] = {"skip_unchanged": False}
    return parse_config(raw, where=str(path))


async def _probe(
    service: Service,
    probe: ProbingController,
    commands: int,
    running: asyncio.Task[None],
    on_progress: Callable[[str, float], None],
) -> list[_CommandTimes]:
    on_progress("waiting for the devices", 0.0)
    await grip(service, running)
    sent: list[_CommandTimes] = []

    def decided(decision: Decision) -> None:
        if len(probe.probes) > len(sent) and decision.output.hold_force_n is not None:
            newest = [finger.newest for finger in service.fingers.values() if finger.newest is not None]
            last = max(newest, key=lambda one: one.ready_at_s)
            now_s = asyncio.get_running_loop().time()
            sent.append(_CommandTimes(probe.probes[-1], last.received_at_s, last.ready_at_s, now_s))

    def called(since_handed_s: float) -> None:
        if sent and not sent[-1].called_at_s:
            sent[-1].called_at_s = asyncio.get_running_loop().time()

    service.observers.append(decided)
    service.hold_observers.append(called)
    probe.left = commands
    while probe.left > 0:
        on_progress("tightening step by step", 1.0 - probe.left / commands)
        wanted = probe.left - 1

        def given(wanted: int = wanted) -> bool:
            return probe.left <= wanted or service.phase is Phase.FAULT

        await wait_until(
            running,
            given,
            COMMAND_S,
            lambda: f"no command was issued (phase {service.phase}). Run the measurement again",
        )
        if service.phase is Phase.FAULT:
            raise SlipguardError(f"the guard stopped: {service.state.fault}. Run the measurement again")
    await asyncio.sleep(REST_S)
    return sent


async def grip(service: Service, running: asyncio.Task[None]) -> None:
    """Calibrate, then grasp the object between the jaws. Raises SlipguardError if the grip does not become firm."""
    handlers = RequestHandlers(service)

    def ready() -> bool:
        return not service.waiting_for

    await wait_until(running, ready, READY_S, lambda: "; ".join(service.waiting_for))
    await handlers.submit(CalibrateRequest())
    await wait_until(running, ready, READY_S, lambda: "; ".join(service.waiting_for))
    await handlers.submit(GraspRequest())
    await wait_until(
        running, lambda: service.ready_to_lift, GRIP_S, lambda: f"no firm grip, {service.state.fault or service.phase}"
    )


def _evaluate(
    options: LatencyOptions, sent: list[_CommandTimes], writes: list[dict[str, Any]], frames: int
) -> LatencyReport:
    """Find stop and go of each command in the gripper's log by their times."""
    wire_s = COMMAND_BYTES * BITS_PER_BYTE / options.baud if options.baud else 0.0
    rows = []
    for one, following in zip(sent, [*sent[1:], None], strict=True):
        ends_s = following.called_at_s if following is not None else math.inf
        last = {
            entry["registers"][0]: float(entry["last_byte_s"])
            for entry in writes
            if one.called_at_s <= entry["last_byte_s"] < ends_s
        }
        if one.called_at_s and {STOP, GO} <= set(last):
            daemon = (one.probe.captured_at_s, one.received_at_s, one.ready_at_s, one.decided_at_s, one.called_at_s)
            rows.append((*daemon, last[STOP] - wire_s, last[GO] - wire_s, last[GO]))
    if not rows:
        raise SlipguardError("no command arrived at the emulated gripper. Run the measurement again")
    marks = np.array(rows)
    found = dict(zip(STAGES, map(_spread, np.diff(marks, axis=1).T), strict=True))
    found[TOTAL] = _spread(marks[:, -1] - marks[:, 0])
    found[OWN] = _spread(marks[:, 3] - marks[:, 1])
    return LatencyReport(options, len(rows), frames, found)


def _spread(times_s: NDArray[np.float64]) -> StageLatency:
    return StageLatency(*percentiles_ms(times_s), float(times_s.max() * 1e3))
