"""A small experiment in the simulated world, from the first grasp to the report; and what is done is not done again."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.cli.app import run
from slipguard.config import parse_config
from slipguard.daemon.controls import Controls
from slipguard.daemon.root import build_service
from slipguard.daemon.service import Service
from slipguard.daemon.virtual_time import run_virtual
from slipguard.daemon.worker import StatedLatencyWorker
from slipguard.lab.evaluate.on_cell import run_on_cell
from slipguard.lab.evaluate.protocol import Protocol
from slipguard.lab.evaluate.report import write_report
from slipguard.lab.evaluate.simulated import intrinsics_of, onlooker
from slipguard.lab.parallel import Workers
from slipguard.sim.onlooker import Lens, Scene, Studio
from slipguard.sim.scenario import scenario
from slipguard.sim.world import World

PROTOCOL = """
name = "two lifts"
repeats = 2
turn_deg = [8.0, 16.0]
hold_s = 0.3
objects = [{name = "bar", hard = "heavy"}]
"""


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("evaluate")
    (folder / "p.toml").write_text(PROTOCOL)
    out = folder / "out"
    assert (
        run(["evaluate", "run", "--sim", "--protocol", str(folder / "p.toml"), "--out", str(out), "--jobs", "1"]) == 0
    )
    return out


def test_the_report_says_what_the_truth_says(experiment: Path) -> None:
    report = json.loads((experiment / "report.json").read_text())
    assert report["lifts"] == report["lifts_compared"] == 2
    assert report["turn_error_mean_deg"] <= 0.5
    assert report["lag_error_frames"] <= 0.5
    assert report["aruco_error_mean_deg"] <= 0.3
    assert report["dice"]["mean"] > 0.9
    assert report["per_object"]["bar"]["hard"] == "heavy"
    assert all(7.0 <= abs(turn) <= 17.5 for turn in report["per_object"]["bar"]["turns_deg"])
    page = (experiment / "report.html").read_text()
    assert "data:image/png;base64," in page
    assert "http" not in page.replace("http-equiv", "")
    assert (experiment / "errors.png").stat().st_size > 5000


def test_what_is_done_is_not_done_again(experiment: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recordings = sorted((experiment / "lifts").glob("*.mcap"))
    before = [path.stat().st_mtime_ns for path in recordings]
    recordings[1].with_suffix(".json").write_text("{")
    protocol = str(experiment.parent / "p.toml")
    assert run(["evaluate", "run", "--sim", "--protocol", protocol, "--out", str(experiment), "--jobs", "1"]) == 0
    assert [path.stat().st_mtime_ns for path in recordings] == before
    assert run(["evaluate", "report", str(experiment), "--jobs", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["lifts"] == 2


def test_another_protocol_does_not_go_on_in_the_same_folder(
    experiment: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = experiment.parent / "other.toml"
    other.write_text(PROTOCOL.replace("repeats = 2", "repeats = 3"))
    assert run(["evaluate", "run", "--sim", "--protocol", str(other), "--out", str(experiment)]) == 2
    assert "holds another experiment" in capsys.readouterr().err


def test_a_cut_recording_is_one_line(experiment: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole = next((experiment / "lifts").glob("*.mcap")).read_bytes()
    (tmp_path / "lifts").mkdir()
    (tmp_path / "lifts" / "001-bar-1.mcap").write_bytes(whole[: len(whole) // 8])
    assert run(["evaluate", "report", str(tmp_path), "--jobs", "1"]) == 2
    said = capsys.readouterr().err
    assert "001-bar-1" in said
    assert said.count("\n") == 1


class Eye:
    """An external camera on the loop's own clock, before the simulated cell."""

    lost = False

    def __init__(self, world: World) -> None:
        self.world = world
        look, _ = onlooker(5)
        self.look = replace(look, lens=Lens(640, 480, 560.0, (322.0, 238.0)))
        self.task: asyncio.Task[None] | None = None

    def give_to(self, taker: Callable[[NDArray[np.uint8]], None] | None) -> None:
        if self.task is not None:
            self.task.cancel()
        self.task = None if taker is None else asyncio.get_running_loop().create_task(self.film(taker))

    async def film(self, taker: Callable[[NDArray[np.uint8]], None]) -> None:
        studio = Studio(self.look, 1)
        while True:
            truth = self.world.truth(asyncio.get_running_loop().time())
            taker(studio.draw(Scene(truth.turn_deg, truth.height_mm, truth.slide_mm)))
            await asyncio.sleep(1 / 30)


@pytest.mark.parametrize("filmed_by", ["slipguard", "somebody else"])
def test_on_a_cell_a_person_is_asked_before_every_lift_and_before_the_jaws_open(tmp_path: Path, filmed_by: str) -> None:
    world = World(seed=3)
    asked: list[str] = []

    def ask(line: str) -> bool:
        asked.append(line)
        if "place" in line:
            now_s = asyncio.get_running_loop().time()
            world.clear(now_s)
            world.place(scenario("wrench", 1), now_s)
        return True

    plan = Protocol.model_validate(
        {
            "objects": [{"name": "spanner"}],
            "repeats": 1,
            "grip_force_n": 45.0,
            "lift_height_mm": 35.0,
            "lift_speed_mm_s": 80.0,
            "hold_s": 0.3,
        }
    )
    raw: dict[str, object] = {name: {"driver": "fake", "fake": {"draw": "inline"}} for name in ("left", "right")}
    raw["state"] = {"directory": str(tmp_path / "state")}
    config = parse_config(raw, where="test", sim=True)

    def cell() -> Service:
        return build_service(config, world=world, make_worker=lambda name: StatedLatencyWorker(0.006))

    async def calibrate() -> None:
        service = cell()
        running = asyncio.create_task(service.run())
        await asyncio.sleep(1.0)
        assert not service.waiting_for
        await Controls(service).calibrate()
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)

    async def main() -> None:
        await calibrate()
        eye = Eye(world)
        lens = intrinsics_of(eye.look.lens)
        if filmed_by == "slipguard":
            await run_on_cell(tmp_path / "out", plan, cell(), eye, lens, ask)  # type: ignore[arg-type]
            return
        (tmp_path / "out" / "lifts").mkdir(parents=True)
        film = cv2.VideoWriter(
            str(tmp_path / "out" / "lifts" / "001-spanner-1.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (640, 480)
        )
        eye.give_to(lambda picture: film.write(picture))
        await run_on_cell(tmp_path / "out", plan, cell(), None, lens, ask)
        eye.give_to(None)
        film.release()

    run_virtual(main())
    (tmp_path / "out" / "lifts" / "001-spanner-1.json").unlink()
    assert len(asked) == 2
    assert "place spanner" in asked[0]
    assert "Hold the object; the jaws open" in asked[1]
    assert filmed_by != "slipguard" or "error 0." in asked[1]
    report = write_report(tmp_path / "out", Workers(1))
    assert report["lifts_compared"] == 1
    assert report["turn_error_mean_deg"] < 1.0
    assert report["lag_error_frames"] is None


def test_an_unknown_object_and_a_missing_camera_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "p.toml").write_text('objects = [{name = "mug"}]\n')
    protocol = str(tmp_path / "p.toml")
    assert run(["evaluate", "run", "--sim", "--protocol", protocol, "--out", str(tmp_path / "o")]) == 2
    assert "no simulated object 'mug'" in capsys.readouterr().err
    assert run(["evaluate", "run", "--protocol", protocol, "--out", str(tmp_path / "o")]) == 2
    assert "--config, --protocol and --intrinsics are needed" in capsys.readouterr().err
