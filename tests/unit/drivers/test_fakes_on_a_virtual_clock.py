"""The fakes on a virtual clock: rate, stamps, latency, and the same run twice."""

from __future__ import annotations

import asyncio
import hashlib

import pytest

from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.devices import DriverContext, Frame
from slipguard.errors import ConfigError
from slipguard.sim.world import World
from slipguard_drivers.digit.fake import FakeSensor
from slipguard_drivers.robotiq.fake import FakeGripper
from slipguard_drivers.ur5.fake import FakeArm

SECONDS = 4.0
INLINE = FakeSensor.Settings(draw="inline")


def record(finger: str, seed: int = 3) -> list[tuple[float, Frame]]:
    """Every frame of a few seconds with the time at which it was handed out."""

    async def run() -> list[tuple[float, Frame]]:
        sensor = FakeSensor(INLINE, DriverContext(finger, World(seed=seed)))
        loop = asyncio.get_running_loop()
        await sensor.open()
        ends_s = loop.time() + SECONDS
        taken: list[tuple[float, Frame]] = []
        while loop.time() < ends_s:
            frame = await sensor.next_frame()
            taken.append((loop.time(), frame))
        await sensor.close()
        return taken

    return run_virtual(run())


def test_frames_come_at_the_cameras_rate_and_latency() -> None:
    model = World(seed=3).camera("left")
    taken = record("left")
    first, last = taken[0][1], taken[-1][1]
    assert (last.sequence - first.sequence) / model.fps == pytest.approx(
        last.captured_at_s - first.captured_at_s, abs=6 * model.jitter_s
    )
    lost = 1.0 - len(taken) / (last.sequence - first.sequence + 1)
    assert lost < 0.05
    for handed_out_at_s, frame in taken:
        age_s = handed_out_at_s - frame.captured_at_s
        assert age_s == pytest.approx(model.latency_s, abs=max(6 * model.jitter_s, 0.4 / model.fps))


def test_the_same_world_gives_the_same_frames() -> None:
    def digest(taken: list[tuple[float, Frame]]) -> str:
        sha = hashlib.sha256()
        for at_s, frame in taken:
            sha.update(f"{at_s} {frame.captured_at_s} {frame.sequence}".encode())
            sha.update(frame.image.tobytes())
        return sha.hexdigest()

    assert digest(record("left")) == digest(record("left"))
    assert digest(record("left")) != digest(record("right"))
    assert digest(record("left")) != digest(record("left", seed=4))


def test_the_schedule_does_not_drift() -> None:
    fps = World(seed=3).camera("right").fps
    errors_s = [frame.captured_at_s - 1000.0 - frame.sequence / fps for _, frame in record("right")]
    assert max(abs(error_s) for error_s in errors_s) <= 0.4 / fps + 1e-6
    assert abs(sum(errors_s[-100:])) / 100 < 0.0012


@pytest.mark.parametrize("driver", [FakeSensor, FakeGripper, FakeArm])
def test_without_a_world_a_fake_says_what_to_do(driver: type[FakeSensor | FakeGripper | FakeArm]) -> None:
    with pytest.raises(ConfigError, match="--sim"):
        driver(driver.Settings(), DriverContext("left"))  # type: ignore[arg-type]
