"""An arm on a wall, on the ceiling or at a tilt is noticed by its accelerometer and does not lift."""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Literal

import pytest
from cell_rig import cell, daemon, patiently, wait_for
from ur_scene import own_address, until

from slipguard.daemon.api.requests import CalibrateRequest, GraspRequest, LiftRequest
from slipguard.diagnosis import CheckStatus
from slipguard.errors import CommandRefused
from slipguard_drivers.ur5.diagnostics import check_payload
from slipguard_drivers.ur5.mounting import READINGS_MAX
from slipguard_drivers.ur5.state_monitor import UP_EVERY, StateMonitor
from slipguard_emulators.ur5.emulator import UrEmulator
from slipguard_emulators.ur5.rtde import OUTPUTS

HOST = own_address(36)


@asynccontextmanager
async def monitored(
    series: Literal["e", "cb3"], mounting_deg: float, before: Callable[[UrEmulator], object] = lambda controller: None
) -> AsyncIterator[tuple[UrEmulator, StateMonitor]]:
    settings = UrEmulator.Settings(host=HOST, series=series, ready=True, mounting_deg=mounting_deg)
    controller, monitor = UrEmulator(settings), StateMonitor("arm", HOST)
    await controller.start()
    before(controller)
    try:
        await monitor.open()
        yield controller, monitor
    finally:
        await monitor.close()
        await controller.stop()


@pytest.mark.parametrize("series", ["e", "cb3"])
@pytest.mark.parametrize(("mounting_deg", "up"), [(0.0, (0, 0, 1)), (90.0, (0, 1, 0)), (180.0, (0, 0, -1))])
async def test_up_is_known_from_the_first_state(
    series: Literal["e", "cb3"], mounting_deg: float, up: tuple[float, float, float]
) -> None:
    async with monitored(series, mounting_deg) as (_, monitor):
        assert monitor.arm_state().up == pytest.approx(up, abs=1e-6)


@pytest.mark.parametrize("series", ["e", "cb3"])
async def test_a_motion_does_not_change_it(series: Literal["e", "cb3"]) -> None:
    """The program moves up and down; each reversal reads as up to 2.5 m/s2."""
    async with monitored(series, 20.0) as (controller, monitor):
        assert await until(lambda: monitor.packets > READINGS_MAX * UP_EVERY), "the mean has all its readings"
        at_rest = monitor.arm_state().up
        controller.control("panel play")
        assert await until(lambda: monitor.newest.moving)
        assert await until(lambda: abs(monitor.newest.acceleration[2] + 9.82) > 0.8), "the sensor reads the motion"
        controller.control("panel stop")
        assert await until(lambda: not monitor.newest.moving)
        assert monitor.arm_state().up == pytest.approx(at_rest, abs=0.02)


async def test_in_motion_since_the_start_it_is_unknown_until_the_arm_rests() -> None:
    async with monitored("cb3", 0.0, lambda controller: controller.control("panel play")) as (controller, monitor):
        assert await until(lambda: monitor.newest.moving)
        controller.control("panel stop")
        assert await until(lambda: monitor.arm_state().up is not None)
        assert monitor.arm_state().up == pytest.approx((0.0, 0.0, 1.0), abs=1e-6)


@pytest.mark.parametrize(("payload_kg", "status"), [(0.0, CheckStatus.NOTE), (1.0, CheckStatus.OK)])
async def test_doctor_notes_a_payload_that_is_not_set(payload_kg: float, status: CheckStatus) -> None:
    controller = UrEmulator(UrEmulator.Settings(host=HOST, ready=True, payload_kg=payload_kg))
    await controller.start()
    result = await check_payload("arm", HOST)
    await controller.stop()
    assert (result.status, result.observed) == (status, f"{payload_kg:.2f} kg")


async def test_doctor_does_without_a_payload_that_older_software_does_not_report(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delitem(OUTPUTS, "payload")
    controller = UrEmulator(UrEmulator.Settings(host=HOST, ready=True))
    await controller.start()
    result = await check_payload("arm", HOST)
    await controller.stop()
    assert (result.status, result.observed) == (CheckStatus.OK, "not reported by this software")


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("mounting_deg", "refused"),
    [(90, "mounted on a wall"), (180, "mounted on the ceiling"), (15, "up 15° from"), (5, "")],
)
def test_on_the_emulated_cell_only_an_upright_arm_lifts(tmp_path: Path, mounting_deg: int, refused: str) -> None:
    options = ("--object", "bar", "--seed", 3, "--fps", 30, "--mounting-deg", mounting_deg)
    with cell(tmp_path, own_address(70), *options) as there, daemon(there) as client:
        patiently(lambda: client.submit(CalibrateRequest()))
        patiently(lambda: client.submit(GraspRequest(force_n=120.0)))
        wait_for(client, lambda state: state["phase"] == "holding" and not state["gripper"]["moving"], "no grip")
        if not refused:
            patiently(lambda: client.submit(LiftRequest(height_mm=20.0)))
            wait_for(client, lambda state: state["lifted_mm"] is not None and state["lifted_mm"] > 15.0, "no lift")
            return
        with pytest.raises(CommandRefused, match=refused) as caught:
            client.submit(LiftRequest())
        assert "\n" not in str(caught.value)
        assert "or let another program move it" in str(caught.value)
        assert not there.order("arm log 100").count('"moves"')
