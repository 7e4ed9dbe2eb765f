"""An exception in an observer, such as recorder or metrics, is reported and counted, and the guard goes on."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest
import structlog
from loop_cell import Cell, play
from sampled import sampled
from structlog.testing import capture_logs

from slipguard.control.state import Phase
from slipguard.daemon.loop.observers import Observers


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
    assert [name.partition(",")[0] for name in named] == ["error in test_observers.fails (test_observers.py"]
    reported = any("cannot be recorded; the guard goes on" in line for line in cell.service.event_log.lines)
    assert reported is (observed != "events"), "an event about a failing listener would be the next one to fail"


def test_a_cancelled_error_of_an_observer_does_not_cancel_the_loop() -> None:
    def use_cancelled_future(value: int) -> None:
        raise asyncio.CancelledError

    observers: Observers[int] = Observers(use_cancelled_future)
    observers.notify(1)
    assert observers.errors == 1
