"""What the daemon reports about a gel that nothing touches: drift and wear, once, with figures; nothing in contact."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from loop_cell import Cell

from slipguard.daemon.loop import gel_monitor as gel_monitor
from slipguard.daemon.loop.finger import ProcessedFrame
from slipguard.daemon.loop.gel_condition import GelStatus
from slipguard.daemon.loop.gel_monitor import GelMonitor
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import Frame, GripperState
from slipguard.perception.estimate import Estimate
from slipguard.sim.sensor_unit import background_image, random_unit

NOISE_BGR = (2.0, 2.0, 2.0)
OPEN = GripperState(True, False, False, False, 80.0, 0.0, None, 0.0)


def gel() -> np.ndarray:
    return np.clip(background_image(random_unit(np.random.default_rng(3))), 20, 220)


def cut(gel_image: np.ndarray) -> np.ndarray:
    worn = gel_image.copy()
    cv2.circle(worn, (90, 150), 8, (10, 10, 10), -1)
    return worn


class Bench:
    """A monitor of a service that does not run: it gets one frame per second of the test."""

    def __init__(self, store: Any = None) -> None:
        self.cell = Cell()
        self.service = self.cell.service
        self.known = BackgroundImage(gel(), NOISE_BGR, 30)
        if store is None:
            self.cell.store.kept["SIM-L"] = self.known
        else:
            self.service.store = store
        self.finger = self.service.fingers["left"]
        self.finger.capture.assume_serial("SIM-L")
        self.service.gripper.newest = OPEN
        self.reported: list[str] = []
        self.service.event_log.listeners.append(lambda event: self.reported.append(event.line))
        self.monitor = GelMonitor(self.service)
        self.now_s = 0.0
        self.rng = np.random.default_rng(0)

    async def show(self, gel_image: np.ndarray, for_s: float, *, contact: bool = False, renewed: bool = False) -> None:
        """The sensor delivers this image, with noise, for a while."""
        noisy = np.clip(gel_image + self.rng.normal(0.0, 2.0, gel_image.shape), 0, 255).astype(np.uint8)
        for second in range(round(for_s)):
            self.now_s += 1.0
            await asyncio.sleep(1.0)
            estimate = Estimate(second, self.now_s, self.now_s, contact, 4000 * contact, "oracle")
            frame = Frame(noisy, self.now_s, second)
            self.monitor.add_frame("left", ProcessedFrame(frame, self.now_s, False, renewed and second == 0, estimate))
        await asyncio.sleep(1.0)


def play(scene: Callable[[Bench], Coroutine[Any, Any, None]], store: Any = None) -> None:
    async def main() -> None:
        bench = Bench(store)
        watching = asyncio.create_task(bench.monitor.run())
        try:
            await scene(bench)
        finally:
            watching.cancel()
            await asyncio.gather(watching, return_exceptions=True)
            bench.service.close()

    run_virtual(main())


def test_a_cut_is_reported_once_with_its_size_and_what_to_do() -> None:
    async def scene(bench: Bench) -> None:
        await bench.show(cut(gel()), 150.0)
        assert bench.reported == []  # two minutes agree; three are needed
        assert "left" in bench.monitor.conditions
        assert bench.monitor.conditions["left"].status is GelStatus.WORN
        await bench.show(cut(gel()), 600.0)
        (line,) = bench.reported
        assert line.startswith("left (SIM-L): 1 lasting mark since the gel's first background image, ")
        assert "gray levels at x = 90, y = 150 px; clean the gel; if the marks stay, replace it and run" in line
        assert 0.5 <= bench.monitor.conditions["left"].marked_mm2 <= 1.5

    play(scene)


def test_drifting_light_is_reported_with_figures_and_no_more_after_a_calibration() -> None:
    async def scene(bench: Bench) -> None:
        warmer = np.clip(gel() + np.array([0.0, -4.0, 18.0]), 0, 255)
        await bench.show(warmer, 600.0)
        (line,) = bench.reported
        assert "red +18 gray levels" in line
        await bench.show(gel(), 300.0)
        await bench.show(warmer, 300.0)
        assert len(bench.reported) == 1  # it comes and goes
        assert line.endswith("; open and empty the jaws and run `slipguard calibrate`")
        bench.cell.store.kept["SIM-L"] = BackgroundImage(warmer.astype(np.uint8), NOISE_BGR, 30)
        await bench.show(warmer, 300.0, renewed=True)
        assert "left" in bench.monitor.conditions
        assert bench.monitor.conditions["left"].status is GelStatus.OK
        assert len(bench.reported) == 1

    play(scene)


@pytest.mark.parametrize("new_gel", [False, True])
def test_wear_does_not_hide_behind_the_next_calibration_but_a_new_gel_starts_fresh(
    tmp_path: Path, new_gel: bool
) -> None:
    store = StateDir(tmp_path)
    store.save_background("SIM-L", BackgroundImage(gel(), NOISE_BGR, 30))
    store.save_background("SIM-L", BackgroundImage(cut(gel()), NOISE_BGR, 30), new_gel=new_gel)

    async def scene(bench: Bench) -> None:
        await bench.show(cut(gel()), 300.0)
        assert "left" in bench.monitor.conditions
        assert bench.monitor.conditions["left"].status is (GelStatus.OK if new_gel else GelStatus.WORN)
        assert len(bench.reported) == (0 if new_gel else 1)
        assert bench.monitor.conditions["left"].light.marks == ()

    play(scene, store)
