"""The API of a running service: state, counters, frames, events, metrics, and the state of a cell without an arm."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest
from loop_cell import Cell, on_cell
from prometheus_client.parser import text_string_to_metric_families
from rich.console import Console

from slipguard.cli.state_view import state_table
from slipguard.config import Config, parse_config
from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.control.state import Phase
from slipguard.daemon.api.daemon_api import FingerFrame
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import ReleaseRequest
from slipguard.daemon.api.snapshot import snapshot
from slipguard.daemon.api.state import NewEstimates, State
from slipguard.daemon.loop.event_log import Event
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.daemon.loop.worker import FixedLatencyWorker
from slipguard.daemon.run import build_service
from slipguard.devices import DriverContext
from slipguard.errors import CommandRefused, ConfigError
from slipguard.sim.world import World
from slipguard.web.metrics import prometheus_text
from slipguard_drivers.no_arm import NoArm


def samples(text: bytes) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Every sample by name and labels."""
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text.decode())
        for sample in family.samples
    }


@on_cell("wrench", 1)
async def test_a_grasp_and_a_fault_as_the_page_and_prometheus_see_them(cell: Cell) -> None:
    reported: dict[str, Any] = {}
    received: list[Event] = []
    handlers = RequestHandlers(cell.service)
    with pytest.raises(CommandRefused):
        await handlers.processed_frame("left")
    await cell.grasp()
    reported["state"], reported["tallies"] = await handlers.state(), await handlers.counters()
    reported["view"] = await handlers.processed_frame("left")
    sequence = (await handlers.frame("left")).frame.sequence
    assert (await handlers.frame("left", after=sequence)).frame.sequence == sequence + 1, "waits for the next"
    assert (await handlers.frame("left", after=sequence - 1)).frame.sequence == sequence + 1, "does not wait"
    unsubscribe = handlers.subscribe(received.append)
    before = len(received)
    assert before > 0, "the messages of before"
    cell.world.faults.fail("left", "stall")
    cell.world.faults.fail("right", "stall")
    await cell.until(lambda: cell.phase is Phase.FAULT)
    with pytest.raises(CommandRefused, match=r"no (new )?frame of the left finger"):
        await handlers.frame("left", after=cell.service.fingers["left"].capture.counts.frames)
    unsubscribe()
    await handlers.submit(ReleaseRequest(confirm=True))
    reported["after"] = received[before:]
    reported["faulty"] = prometheus_text(await handlers.state(), await handlers.counters())
    State.model_validate_json(reported["state"])
    view: FingerFrame = reported["view"]
    assert view.serial == "SIM-L"
    assert view.frame.image.shape == (320, 240, 3)
    (fault,) = [event for event in reported["after"] if event.level == "fault"]
    assert fault.code == "frames lost"
    assert fault.what_to_do
    assert not any("releas" in event.text for event in reported["after"]), "no event arrives after that"

    found = samples(prometheus_text(reported["state"], reported["tallies"]))
    state = json.loads(reported["state"])
    assert found["slipguard_force_newtons", ()] == pytest.approx(state["gripper"]["force_n"])
    assert found["slipguard_target_force_newtons", ()] == pytest.approx(state["target_force_n"])
    assert found["slipguard_phase", (("phase", "holding"),)] == 1.0
    assert found["slipguard_frames_total", (("finger", "left"),)] == state["fingers"]["left"]["counts"]["frames"]
    assert found["slipguard_frames_lost_total", (("finger", "left"), ("reason", "torn"))] == 0.0
    assert found["slipguard_stream_restarts_total", (("finger", "left"),)] == 0.0
    assert found["slipguard_device_ready", (("device", "arm"),)] == 1.0
    assert found["slipguard_device_answers_total", (("device", "gripper"),)] > 10
    assert found["slipguard_recording", ()] == 0.0
    assert found["slipguard_build_info", (("version", state["version"]),)] == 1.0
    assert found["slipguard_reaction_seconds_count", ()] > 50
    assert (
        found["slipguard_reaction_seconds_bucket", (("le", "+Inf"),)] == found["slipguard_reaction_seconds_count", ()]
    )
    slow = found["slipguard_reaction_seconds_sum", ()] / found["slipguard_reaction_seconds_count", ()]
    assert slow == pytest.approx(0.006, rel=0.3), "the stated latency"
    assert found["slipguard_fault", ()] == 0.0

    faulty = samples(reported["faulty"])
    assert faulty["slipguard_faults_total", (("code", "frames lost"),)] == 1.0
    assert faulty["slipguard_device_ready", (("device", "left"),)] == 0.0
    assert faulty["slipguard_frames_lost_total", (("finger", "left"), ("reason", "stalled"))] >= 1.0
    assert ("slipguard_rotation_degrees", ()) not in faulty, "an unknown value is no number"


@on_cell("wrench", 1, guard={"force_max_n": 120.0}, fps=30.0, latency_s=0.006)
async def test_the_state_has_rates_ages_and_latencies_and_every_estimate_is_streamed(cell: Cell) -> None:
    await cell.grasp()
    received: list[NewEstimates] = []
    unsubscribe = cell.handlers.subscribe_estimates(lambda new: received.append(NewEstimates.model_validate_json(new)))
    await asyncio.sleep(3.0)
    steady = cell.handlers.snapshot()
    unsubscribe()
    cell.world.faults.fail("left", "stall")
    await asyncio.sleep(3.0)
    stalled = cell.handlers.snapshot()
    assert steady.limits.force_max_n == 120.0
    for finger in steady.fingers.values():
        assert finger.frames_per_s == pytest.approx(30.0, abs=1.5)
        assert 0.02 < finger.age_s < 0.12
    assert steady.latency.p50_ms == pytest.approx(6.0, abs=1.0)
    assert steady.latency.p50_ms <= steady.latency.p99_ms < 20.0
    assert cell.now_s - 0.02 <= stalled.now_s <= cell.now_s
    assert stalled.fingers["left"].frames_per_s == 0.0
    assert stalled.fingers["left"].age_s > 2.0
    assert stalled.fingers["right"].frames_per_s > 20.0
    assert [new.number for new in received] == list(range(len(received)))
    for name in ("left", "right"):
        times_s = [new.fingers[name].captured_at_s for new in received if name in new.fingers]
        assert len(times_s) == pytest.approx(90, abs=5)
        assert times_s == sorted(set(times_s))
    assert all(new.at_s - new.fingers[name].captured_at_s < 0.12 for new in received for name in new.fingers)
    assert received[-1].rotation is not None
    assert received[-1].rotation.rotation_deg is not None


def config(tmp_path: Path) -> Config:
    raw: dict[str, Any] = {name: {"driver": "fake", "fake": {"draw": "inline"}} for name in ("left", "right")}
    raw |= {"gripper": {"driver": "fake"}, "arm": {"driver": "none"}, "guard": {"mode": "guard"}}
    return parse_config(raw | {"state": {"directory": str(tmp_path)}}, where="test")


def test_lift_and_lower_are_refused_and_the_state_shows_no_arm(tmp_path: Path) -> None:
    async def main() -> State:
        service = build_service(
            config(tmp_path), world=World(seed=0), make_worker=lambda name: FixedLatencyWorker(0.006)
        )
        try:
            for kind in (RequestKind.LIFT, RequestKind.LOWER):
                with pytest.raises(CommandRefused, match=rf"cannot {kind}: there is no arm \(\[arm\] driver"):
                    await service.request(ControlRequest(kind))
            return snapshot(service, {})
        finally:
            service.close()

    state = run_virtual(main())
    assert (state.arm, state.has_arm) == (None, False)
    console = Console(width=80, highlight=False, color_system=None)
    with console.capture() as capture:
        console.print(state_table(state))
    assert 'arm none (arm.driver = "none")' in " ".join(capture.get().split())


def test_it_is_at_rest_and_never_moves() -> None:
    async def main() -> None:
        arm = NoArm(NoArm.Settings(), DriverContext("arm", mode="guard"))
        await arm.open()
        state = await arm.state()
        assert not any((state.moving, state.protective_stop, state.emergency_stop, state.motion_known))
        await arm.stop()
        with pytest.raises(CommandRefused, match="there is no arm"):
            await arm.lift(10.0, 10.0)
        (check,) = [result async for result in arm.diagnose(owned=False)]
        assert "only the grip is guarded" in check.observed
        await arm.close()

    run_virtual(main())


def test_lift_mode_needs_an_arm() -> None:
    with pytest.raises(ConfigError, match='set mode = "guard"'):
        NoArm(NoArm.Settings(), DriverContext("arm", mode="lift"))
