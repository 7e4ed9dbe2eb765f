"""A cell without an arm: the grip is guarded, lift and lower are refused with the reason, and every view shows it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from slipguard.cli.state_view import state_table
from slipguard.config import Config, parse_config
from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.daemon.api.snapshot import snapshot
from slipguard.daemon.api.state import State
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.daemon.loop.worker import FixedLatencyWorker
from slipguard.daemon.run import build_service
from slipguard.devices import DriverContext
from slipguard.errors import CommandRefused, ConfigError
from slipguard.sim.world import World
from slipguard_drivers.no_arm import NoArm


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
