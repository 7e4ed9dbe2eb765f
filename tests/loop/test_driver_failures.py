"""An unexpected exception in a driver, a pipeline or an observer is named, and ends neither guard nor daemon."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import structlog
from loop_cell import Cell, on_cell, play
from loop_doubles import FlatSensor
from sampled import sampled
from structlog.testing import capture_logs

from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase
from slipguard.daemon.api.requests import ClearRequest
from slipguard.daemon.loop.observers import Observers

FAILURES = [
    TypeError("'NoneType' object is not subscriptable"),
    MemoryError(),
    ExceptionGroup("two", [OSError(5)]),
    asyncio.CancelledError(),
]


def raising(error: BaseException) -> Callable[..., object]:
    async def fail(*arguments: object) -> object:
        raise error

    return fail


def reported(cell: Cell, device: str, what: str) -> bool:
    return any(line.startswith(f"{device}: error in ") and what in line for line in cell.service.event_log.lines)


@pytest.mark.parametrize("error", FAILURES)
@pytest.mark.parametrize(("device", "code"), [("gripper", FaultCode.GRIPPER_SILENT), ("arm", FaultCode.ARM_SILENT)])
@on_cell()
async def test_a_driver_that_raises_is_named_tried_again_and_the_grip_stays(
    cell: Cell, device: str, code: FaultCode, error: BaseException
) -> None:
    await cell.grasp()
    driver = getattr(cell, device)
    driver.state = raising(error)
    await cell.faulted(code, 1.0)
    await cell.until(lambda: reported(cell, device, type(error).__name__), 1.0)
    assert reported(cell, device, f"loop_doubles.Logged{device.capitalize()} (test_driver_failures.py, line ")
    assert not cell.service.devices[device].health.ready
    del driver.state
    await cell.until(lambda: not cell.service.waiting_for, 2.0)
    await cell.submit(ClearRequest())
    await cell.until(cell.steady)
    assert [what for _, what, _ in cell.gripper.commands if what not in ("hold", "halt")] == []


@pytest.mark.parametrize("error", sampled(FAILURES))
@on_cell()
async def test_a_pipeline_that_raises_pauses_and_is_tried_again(cell: Cell, error: BaseException) -> None:
    await cell.grasp()
    pipeline, calls = cell.perceivers["left"][-1], 0

    def fail(frame: object) -> None:
        nonlocal calls
        calls += 1
        raise error

    pipeline.process = fail  # type: ignore[assignment,method-assign]
    await asyncio.sleep(2.0)
    assert 2 <= calls <= 6, "at 60 frames per second"
    assert reported(cell, "left", "loop_doubles.Oracle (test_driver_failures.py, line ")
    assert cell.phase is Phase.HOLDING, "the other finger guards"
    del pipeline.process
    await cell.until(lambda: not cell.service.waiting_for, 3.0)


INVALID = [
    ("gripper", "width_mm", None),
    ("gripper", "width_mm", math.nan),
    ("gripper", "force_n", None),
    ("gripper", "force_n", np.float32(40.0)),
    ("gripper", "measured_at_s", None),
    ("gripper", "measured_at_s", 1.8e9),
    ("gripper", "holding", np.True_),
    ("gripper", "fault", ""),
    ("arm", "height_mm", None),
    ("arm", "speed_mm_s", math.inf),
    ("arm", "measured_at_s", 1.8e9),
    ("arm", "position_mm", (1.0, 2.0)),
]


@pytest.mark.parametrize(("device", "field", "value"), INVALID)
@on_cell()
async def test_an_invalid_value_in_a_state_is_an_error_of_the_driver(
    cell: Cell, device: str, field: str, value: object
) -> None:
    """It would end the loop, or make a silent device look alive."""
    await cell.grasp()
    driver = getattr(cell, device)
    valid = driver.state

    async def state() -> object:
        return replace(await valid(), **{field: value})

    driver.state = state
    await cell.until(lambda: reported(cell, device, f"ValueError: state().{field} is "), 1.0)
    await cell.handlers.state()
    await cell.until(lambda: cell.phase is Phase.FAULT, 1.0)
    del driver.state
    await cell.until(lambda: not cell.service.waiting_for, 2.0)


@pytest.mark.parametrize(
    "change",
    [
        {"image": np.zeros((240, 320, 3), np.uint8)},
        {"image": np.zeros((320, 240, 3), np.float32)},
        {"image": None},
        {"captured_at_s": None},
        {"sequence": None},
        None,
    ],
)
@on_cell()
async def test_an_invalid_frame_is_an_error_of_the_driver(cell: Cell, change: dict[str, Any] | None) -> None:
    await cell.grasp()
    sensor = cell.sensors["left"]
    valid = sensor.next_frame

    async def next_frame() -> object:
        frame = await valid()
        return None if change is None else replace(frame, **change)

    sensor.next_frame = next_frame  # type: ignore[method-assign,assignment]
    await cell.until(lambda: reported(cell, "left", "loop_doubles.FlatSensor: "), 1.0)
    assert cell.phase is Phase.HOLDING, "the other finger guards"
    del sensor.next_frame
    await cell.until(lambda: not cell.service.waiting_for, 3.0)


def fails(value: object) -> None:
    raise ZeroDivisionError(f"{type(value).__name__} cannot be recorded")


OBSERVED: dict[str, Callable[[Cell], Observers]] = {  # type: ignore[type-arg]
    "decisions": lambda cell: cell.service.observers,
    "holds": lambda cell: cell.service.hold_observers,
    "events": lambda cell: cell.service.event_log.listeners,
    "frames": lambda cell: cell.service.fingers["left"].observers,
}


@pytest.mark.parametrize("observed", sampled(OBSERVED, every=2))
def test_an_observer_that_raises_is_named_and_counted_and_the_guard_goes_on(observed: str) -> None:
    seen: list[object] = []

    async def scene(cell: Cell) -> None:
        observers = OBSERVED[observed](cell)
        observers.append(fails)
        observers.append(seen.append)
        await cell.grasp()
        await cell.lift()
        assert cell.phase is Phase.HOLDING
        assert cell.truth.dropped is None
        assert 0 < len(seen) == cell.service.observer_errors, "the observers behind it are called"
        counters = await cell.handlers.counters()
        assert f'"observer_errors": {len(seen)}'.encode() in counters
        cell.observer_errors = len(seen)
        observers.remove(fails)

    structlog.reset_defaults()
    with capture_logs() as entries:
        cell = play(Cell("wrench", 1), scene)
    named = [entry["event"] for entry in entries if "exc_info" in entry]
    assert [name.partition(",")[0] for name in named] == [
        "error in test_driver_failures.fails (test_driver_failures.py"
    ]
    reported = any("cannot be recorded; the guard goes on" in line for line in cell.service.event_log.lines)
    assert reported is (observed != "events"), "an event about a failing listener would be the next one to fail"


@pytest.mark.parametrize("error", sampled(FAILURES))
@pytest.mark.parametrize("method", ["next_frame", "open", "close"])
@on_cell("wrench", 1)
async def test_a_sensor_that_raises_is_named_and_the_other_finger_guards_on(
    cell: Cell, method: str, error: BaseException
) -> None:
    await cell.grasp()
    sensor = cell.sensors["left"]
    setattr(sensor, method, raising(error))
    if method != "next_frame":
        cell.world.faults.fail("left", "disconnect")
        await asyncio.sleep(0.2)
        cell.world.faults.repair("left")
    await asyncio.sleep(1.5)
    assert reported(cell, "left", "loop_doubles.FlatSensor (test_driver_failures.py, line ")
    await cell.lift()
    assert cell.phase is Phase.HOLDING
    delattr(sensor, method)
    await cell.until(lambda: not cell.service.waiting_for, 3.0)


@on_cell()
async def test_one_exception_of_a_pipeline_costs_one_frame(cell: Cell) -> None:
    await cell.grasp()
    finger, pipeline = cell.service.fingers["left"], cell.perceivers["left"][-1]

    def fail_once(frame: object) -> None:
        del pipeline.process
        raise ZeroDivisionError

    pipeline.process = fail_once  # type: ignore[assignment,method-assign]
    await cell.until(lambda: finger.newest is None, 1.0)
    await cell.until(lambda: finger.newest is not None, 0.1)
    assert cell.phase is Phase.HOLDING


@on_cell()
async def test_a_state_of_the_wrong_type_is_an_error_of_the_driver(cell: Cell) -> None:
    async def state() -> dict[str, float]:
        return {"width_mm": 20.0}

    await cell.grasp()
    cell.gripper.state = state  # type: ignore[assignment,method-assign]
    wrong = "loop_doubles.LoggedGripper: TypeError: state() returned dict, not GripperState"
    await cell.until(lambda: reported(cell, "gripper", wrong), 1.0)


@on_cell()
async def test_remarks_that_raise_are_shown_as_an_error_of_the_driver(cell: Cell) -> None:
    class Sensor(FlatSensor):
        @property
        def remarks(self) -> tuple[str, ...]:
            return (None,)[1]  # type: ignore[return-value]

    await cell.ready()
    cell.sensors["left"].__class__ = Sensor
    (remark,) = cell.handlers.snapshot().fingers["left"].remarks
    assert remark.startswith("error in test_driver_failures.")
    assert "IndexError" in remark


def test_a_cancelled_error_of_an_observer_does_not_cancel_the_loop() -> None:
    def use_cancelled_future(value: int) -> None:
        raise asyncio.CancelledError

    observers: Observers[int] = Observers(use_cancelled_future)
    observers.notify(1)
    assert observers.errors == 1
