"""A terminal, pipe or journal that accepts nothing blocks no program that logs; lost lines are counted and reported."""

from __future__ import annotations

import io
import json
import logging
import os
import pty
import socket
import sys
import termios
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import pytest
import structlog

from slipguard.daemon.log_queue import LogQueue
from slipguard.daemon.log_setup import configure, flush, lost_lines
from slipguard.daemon.loop.event_log import EventLog

LINES = 2000


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    yield
    structlog.reset_defaults()


def read_until(descriptor: int, last: bytes) -> bytes:
    read = b""
    while last not in read or not read.endswith(b"\n"):
        read += os.read(descriptor, 65536)
    return read


@contextmanager
def stopped_terminal() -> Iterator[tuple[int, int]]:
    """A terminal after Ctrl-S. Yields its two ends."""
    reader, writer = pty.openpty()
    termios.tcflow(writer, termios.TCOOFF)
    yield reader, writer
    os.close(reader)
    os.close(writer)


@contextmanager
def stalled_pipe() -> Iterator[tuple[int, int]]:
    reader, writer = os.pipe()
    yield reader, writer
    os.close(reader)
    os.close(writer)


@contextmanager
def stalled_journal() -> Iterator[tuple[int, int]]:
    """What systemd connects a service's stderr to."""
    reader, writer = socket.socketpair()
    with reader, writer:
        yield reader.fileno(), writer.fileno()


@pytest.mark.parametrize("output", [stopped_terminal, stalled_pipe, stalled_journal])
def test_an_output_that_stalls_blocks_no_logger_and_the_newest_lines_follow(
    output: Callable[[], AbstractContextManager[tuple[int, int]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    with output() as (reader, writer), os.fdopen(os.dup(writer), "w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        configure(json_lines=True)
        event_log = EventLog()

        def report() -> None:
            for number in range(LINES):
                event_log.fault("slip", f"number {number}", "wait" * 50)

        reporting = threading.Thread(target=report, daemon=True)
        reporting.start()
        reporting.join(30.0)
        assert not reporting.is_alive(), "the caller waits for the output"
        lost = lost_lines()
        assert lost > 0
        assert not flush(0.05)
        if output is stopped_terminal:
            termios.tcflow(writer, termios.TCOON)
        text = read_until(reader, f"{lost_lines()} lines are lost".encode())
        monkeypatch.undo()
    lines = [json.loads(line) for line in text.decode().splitlines() if line.startswith("{") and line.endswith("}")]
    assert f"{lost_lines()} lines are lost" in lines[-1]["event"]
    assert lines[-2]["observed"] == f"number {LINES - 1}"


def test_messages_of_libraries_take_the_same_way(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    configure()
    assert logging.lastResort is not None
    record = logging.LogRecord("asyncio", logging.ERROR, "", 0, "Task %s was destroyed", ("left",), None)
    logging.lastResort.handle(record)
    assert flush(30.0)
    line = json.loads(stream.getvalue())
    assert (line["event"], line["level"], line["logger"]) == ("Task left was destroyed", "error", "asyncio")


def test_no_error_of_the_output_ends_the_thread() -> None:
    written, release = list[str](), threading.Event()

    def write(entry: str) -> None:
        assert release.wait(30.0)
        if entry == "bad":
            raise TypeError(entry)
        written.append(entry)

    def fail(lines: int, blocked_s: float) -> None:
        raise RuntimeError(f"{lines} lines are lost")

    queue = LogQueue[str](write, fail, entries_max=2)
    for entry in ("one", "two", "three", "bad", "last"):
        queue.put(entry)
    release.set()
    assert queue.flush(30.0)
    assert queue.lost > 0
    assert written[-1] == "last"
