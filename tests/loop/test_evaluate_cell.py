"""The experiment on a cell with an operator: after any error the grip is kept and the arm is stopped."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.cli.app import run
from slipguard.config import parse_config
from slipguard.control.state import Phase
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import CalibrateRequest
from slipguard.daemon.loop.service import Service
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.daemon.loop.worker import FixedLatencyWorker
from slipguard.daemon.run import build_service
from slipguard.errors import SlipguardError
from slipguard.evaluation import real_lifts
from slipguard.evaluation.experiment import results
from slipguard.evaluation.protocol import LiftProtocol
from slipguard.evaluation.real_lifts import daemon_socket_held, run_on_cell
from slipguard.evaluation.report_data import report_json
from slipguard.evaluation.simulated_lifts import intrinsics_of, random_camera
from slipguard.sim.external_camera import ExternalCameraRenderer, LensModel, MarkerScene
from slipguard.sim.scenario import Scenario, scenario
from slipguard.sim.world import World
from slipguard.tools.parallel import Workers

SEED = 3
LENS = LensModel(640, 480, 560.0, (322.0, 238.0))
RECORDING = "001-spanner-1.mcap"
FPS = 20.0
"""Rate of the fingers' cameras."""


class RenderedCamera:
    """An external camera of the simulated cell, on the loop's clock. working: otherwise it never delivers an image."""

    def __init__(self, world: World, *, working: bool = True) -> None:
        self.world, self.working = world, working
        self.lost = False
        model, _ = random_camera(5)
        self.renderer = ExternalCameraRenderer(replace(model, lens=LENS), 1)
        self.task: asyncio.Task[None] | None = None

    def send_to(self, receiver: Callable[[NDArray[np.uint8]], None] | None) -> None:
        if self.task is not None:
            self.task.cancel()
        self.task = None
        if receiver is not None and self.working:
            self.task = asyncio.get_running_loop().create_task(self.deliver(receiver))

    async def deliver(self, receiver: Callable[[NDArray[np.uint8]], None]) -> None:
        while True:
            truth = self.world.truth(asyncio.get_running_loop().time())
            receiver(self.renderer.draw(MarkerScene(truth.rotation_deg, truth.height_mm, truth.slip_mm)))
            await asyncio.sleep(1 / 20)


class Bench:
    """A cell and its operator, with the state of the cell when the operator is asked to confirm the release."""

    def __init__(self, state: Path, out: Path, *, confirms: bool = True) -> None:
        self.world = World(seed=SEED)
        self.world.place(at_rate(FPS), 0.0)
        self.world.clear(0.0)
        self.out, self.confirms = out, confirms
        self.asked: list[str] = []
        self.service = service_of(self.world, state)
        self.ground_mm, self.lifted_mm, self.held = 0.0, -1.0, False

    async def ask(self, line: str, word: str) -> bool:
        self.asked.append(line)
        now_s = asyncio.get_running_loop().time()
        if word == "":
            assert "place spanner" in line
            self.world.clear(now_s)
            self.world.place(at_rate(FPS), now_s)
            self.ground_mm = self.world.arm_state(now_s).height_mm
            return True
        assert word == "release"
        assert "Hold the object; the jaws will open" in line
        self.lifted_mm, self.held = self.world.arm_state(now_s).height_mm - self.ground_mm, self.holds()
        return self.confirms

    async def run(self, camera: RenderedCamera | None = None, height_mm: float = 12.0) -> None:
        plan = LiftProtocol.model_validate(
            {
                "objects": [{"name": "spanner"}],
                "repeats": 1,
                "grip_force_n": 45.0,
                "lift_height_mm": height_mm,
                "lift_speed_mm_s": 80.0,
                "hold_s": 0.3,
            }
        )
        await run_on_cell(self.out, plan, self.service, camera, intrinsics_of(LENS), self.ask)  # type: ignore[arg-type]

    async def while_lifting(self, then: Callable[[], None] | None, camera: RenderedCamera | None = None) -> None:
        """Run, and call `then` during the lift; None: cancel, like Ctrl-C."""
        task = asyncio.create_task(self.run(camera, height_mm=60.0))  # longer than the time until `then`
        while self.service.phase is not Phase.LIFTING:
            assert not task.done()
            await asyncio.sleep(0.02)
        await asyncio.sleep(0.3)
        if then is None:
            task.cancel()
        else:
            then()
        await task

    def holds(self) -> bool:
        """Return whether the jaws hold the object at the world's last time."""
        return self.world.gripper_state(0.0).holding


def at_rate(fps: float) -> Scenario:
    """Return the grasp of all tests, with cameras at a rate that saves computing time."""
    grasp = scenario("wrench", 1)
    return replace(grasp, left=replace(grasp.left, fps=fps), right=replace(grasp.right, fps=fps))


def service_of(world: World, state: Path) -> Service:
    raw: dict[str, object] = {name: {"driver": "fake", "fake": {"draw": "inline"}} for name in ("left", "right")}
    raw["state"] = {"directory": str(state)}
    raw["guard"] = {"tuning": {"lower_speed_mm_s": 150.0}}
    config = parse_config(raw, where="test", sim=True)
    return build_service(config, world=world, make_worker=lambda name: FixedLatencyWorker(0.006))


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a state directory with both fingers' background images."""
    folder = tmp_path_factory.mktemp("cell") / "state"

    async def calibrate() -> None:
        service = service_of(World(seed=SEED), folder)
        running = asyncio.create_task(service.run())
        await asyncio.sleep(1.0)
        assert not service.waiting_for
        await RequestHandlers(service).submit(CalibrateRequest())
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    run_virtual(calibrate())
    return folder


@pytest.mark.campaign
@pytest.mark.parametrize("filmed_by", ["slipguard", "another program"])
def test_the_operator_is_asked_before_every_lift_and_before_the_jaws_open(
    tmp_path: Path, state: Path, filmed_by: str
) -> None:
    bench = Bench(state, tmp_path / "out")

    async def main() -> None:
        camera = RenderedCamera(bench.world)
        if filmed_by == "slipguard":
            await bench.run(camera, 35.0)
            return
        (bench.out / "lifts").mkdir(parents=True)
        video = cv2.VideoWriter(
            str(bench.out / "lifts" / "001-spanner-1.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (640, 480)
        )
        camera.send_to(lambda image: video.write(image))
        await bench.run(None, 35.0)
        camera.send_to(None)
        video.release()

    run_virtual(main())
    if filmed_by != "slipguard":  # the video was not complete yet when the lift was analyzed
        (bench.out / "lifts" / "001-spanner-1.json").unlink()
    assert len(bench.asked) == 2
    assert filmed_by != "slipguard" or "error 0." in bench.asked[1]
    assert bench.held
    assert abs(bench.lifted_mm) < 1.0
    assert not bench.holds()
    report = report_json(results(bench.out, Workers(1)))
    assert report["lifts_compared"] == 1
    assert report["turn_error_mean_deg"] < 1.0
    assert report["lag_error_frames"] is None


def test_a_fault_during_the_lift_is_named_with_the_height_and_the_release_is_offered(
    tmp_path: Path, state: Path
) -> None:
    bench = Bench(state, tmp_path / "out")
    run_virtual(bench.while_lifting(lambda: bench.world.faults.fail("arm", "protective_stop")))
    assert "arm in protective stop" in bench.asked[1]
    assert "this lift does not count" in bench.asked[1]
    assert f"The object is {bench.lifted_mm:.0f} mm above the table" in bench.asked[1]
    assert bench.held
    assert not bench.holds()
    assert not (tmp_path / "out" / "lifts" / RECORDING).exists()


def test_if_the_external_camera_is_lost_the_object_is_lowered_and_released_before_the_error(
    tmp_path: Path, state: Path
) -> None:
    bench = Bench(state, tmp_path / "out")
    camera = RenderedCamera(bench.world, working=False)
    with pytest.raises(SlipguardError, match="the external camera is disconnected") as error:
        run_virtual(bench.while_lifting(lambda: setattr(camera, "lost", True), camera))
    assert "grip" not in str(error.value)
    assert bench.held
    assert abs(bench.lifted_mm) < 1.0
    assert not bench.holds()
    assert not list((tmp_path / "out" / "lifts").iterdir())


def test_a_release_that_is_not_confirmed_keeps_the_grip(tmp_path: Path, state: Path) -> None:
    bench = Bench(state, tmp_path / "out", confirms=False)
    with pytest.raises(
        SlipguardError, match="stopped before the release; the arm is stopped and the grip is kept"
    ) as e:
        run_virtual(bench.run())
    assert "start `slipguard run`, support the object, then `slipguard ctl release`" in str(e.value)
    assert abs(bench.lifted_mm) < 1.0
    assert bench.holds()


@pytest.mark.parametrize("by", ["Ctrl-C", "timeout"])
def test_an_end_during_the_lift_stops_the_arm_and_keeps_the_grip(
    tmp_path: Path, state: Path, monkeypatch: pytest.MonkeyPatch, by: str
) -> None:
    bench = Bench(state, tmp_path / "out")
    order: list[str] = []
    stop, close = bench.service._arm_device.stop, bench.service._arm_device.close

    def log_call(name: str, what: Callable[[], Awaitable[None]]) -> Callable[[], Awaitable[None]]:
        async def noting() -> None:
            order.append(name)
            await what()

        return noting

    monkeypatch.setattr(bench.service._arm_device, "stop", log_call("stop", stop))
    monkeypatch.setattr(bench.service._arm_device, "close", log_call("close", close))
    if by == "timeout":
        monkeypatch.setattr(real_lifts._Cell, "_limit_s", lambda cell, height_mm, speed_mm_s: 0.3)
    expected = "interrupted" if by == "Ctrl-C" else "the lift does not end"
    with pytest.raises(SlipguardError, match=rf"{expected}.*; the arm is stopped and the grip is kept"):
        run_virtual(bench.while_lifting(None) if by == "Ctrl-C" else bench.run(height_mm=60.0))
    assert order[:2] == ["stop", "close"]
    assert len(bench.asked) == 1
    assert bench.holds()


def test_the_command_refuses_guard_mode_and_a_running_daemon_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    socket_path = tmp_path / "s.sock"
    config, plan, lens = (str(tmp_path / name) for name in ("c.toml", "p.toml", "lens.json"))
    Path(config).write_text(
        f'guard.mode = "guard"\napi.socket = "{socket_path}"\nstate.directory = "{tmp_path}"\n'
        'left.digit.serial = "D20001"\nright.digit.serial = "D20002"\narm.ur5.host = "192.0.2.1"\n'
        'gripper.robotiq.port = "/dev/none"\n'
    )
    Path(plan).write_text('objects = [{name = "spanner"}]\n')
    Path(lens).write_text(intrinsics_of(LENS).model_dump_json())
    out = str(tmp_path / "out")
    command = ["evaluate", "run", "--config", config, "--protocol", plan, "--intrinsics", lens, "--out", out]
    with daemon_socket_held(socket_path):
        assert run(command) == 1
    assert capsys.readouterr().err.endswith("stop it first\n")
    assert run(command) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert 'set it to "lift"' in message
    assert not socket_path.exists()
    assert not Path(out).exists()
