"""Observers of the service, such as recorder and metrics. None of them may end the guard by an exception."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import TypeVar

import structlog

from slipguard.daemon.loop.driver_failure import DRIVER_ERRORS, error_place
from slipguard.errors import describe_error

T = TypeVar("T")
log = structlog.get_logger()


class Observers(list[Callable[[T], object]]):
    """Called with each value, in order. An exception of one is counted, and reported the first time at each place.

    Attributes:
        errors: Exceptions so far.
        report: Receives one line about a new error; None: it is only logged.
    """

    def __init__(self, *observers: Callable[[T], object], report: Callable[[str], object] | None = None) -> None:
        super().__init__(observers)
        self.errors = 0
        self.report = report
        self._reported: set[str] = set()

    @contextlib.contextmanager
    def attached(self, observer: Callable[[T], object]) -> Iterator[None]:
        """Pass each value to this observer too."""
        self.append(observer)
        try:
            yield
        finally:
            self.remove(observer)

    def notify(self, value: T) -> None:
        """Pass a value to all observers."""
        for observer in [*self]:
            try:
                observer(value)
            except DRIVER_ERRORS as error:  # nothing is awaited here, so no CancelledError is for this task
                self.errors += 1
                place = error_place(observer, error)
                if place not in self._reported:
                    self._reported.add(place)
                    log.error(f"error in {place}", exc_info=error)
                    if self.report is not None:
                        self.report(f"error in {place}: {describe_error(error)}; the guard goes on without it")
