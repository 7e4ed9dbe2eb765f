"""The API's view of a running service: state, counters, frames and events, and the metrics made of them."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest
from loop_cell import Cell, play
from prometheus_client.parser import text_string_to_metric_families

from slipguard.control.state import Phase
from slipguard.daemon.api.daemon_api import FingerFrame
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import ReleaseRequest
from slipguard.daemon.api.state import State
from slipguard.daemon.loop.event_log import Event
from slipguard.errors import CommandRefused
from slipguard.web.metrics import prometheus_text


def samples(text: bytes) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Every sample by name and labels."""
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text.decode())
        for sample in family.samples
    }


def test_a_grasp_and_a_fault_as_the_page_and_prometheus_see_them() -> None:
    reported: dict[str, Any] = {}
    received: list[Event] = []

    async def scene(cell: Cell) -> None:
        handlers = RequestHandlers(cell.service)
        with pytest.raises(CommandRefused):
            await handlers.processed_frame("left")
        await cell.grasp()
        reported["state"], reported["tallies"] = await handlers.state(), await handlers.counters()
        reported["view"] = await handlers.processed_frame("left")
        assert cell.world is not None
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

    play(Cell("wrench", 1), scene)
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


def test_a_recorder_whose_thread_has_ended_is_not_reported_as_recording() -> None:
    recordings: list[dict[str, Any]] = []

    async def scene(cell: Cell) -> None:
        await cell.ready()
        handlers = RequestHandlers(cell.service)
        for dead in (False, True):
            recorder = SimpleNamespace(stopped=None, dead=dead, left_out=3)
            handlers.watch_recorder(recorder)  # type: ignore[misc,arg-type]
            recordings.append(json.loads(await handlers.state())["recording"])

    cell = Cell("wrench", 1)
    assert cell.service.config.recording.enabled
    play(cell, scene)
    assert recordings[0] == {"state": "on", "why": None, "left_out": 3}
    assert recordings[1]["state"] == "stopped"
    assert "the recorder thread has ended" in recordings[1]["why"]
