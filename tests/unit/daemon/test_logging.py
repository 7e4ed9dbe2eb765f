"""The daemon's log: JSON where a program reads, one line a second of each kind, and never in the guard's way."""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Iterator

import pytest
import structlog

from slipguard.daemon.log_setup import configure, set_level
from slipguard.daemon.loop import event_log as event_log_module
from slipguard.daemon.loop.event_log import KINDS_MAX, EventLog, OncePerSecond


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    yield
    structlog.reset_defaults()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def logged(monkeypatch: pytest.MonkeyPatch, stream: io.StringIO, **options: bool | None) -> str:
    monkeypatch.setattr(sys, "stderr", stream)
    configure(**options)  # type: ignore[arg-type]
    structlog.get_logger().warning("the grip slips", rotation_deg=3.5)
    return stream.getvalue()


def test_json_for_a_journal_and_colors_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    line = json.loads(logged(monkeypatch, io.StringIO()))
    assert (line["event"], line["level"], line["rotation_deg"]) == ("the grip slips", "warning", 3.5)
    assert line["timestamp"].endswith("Z")
    assert "\x1b[" in logged(monkeypatch, Terminal())
    assert json.loads(logged(monkeypatch, Terminal(), json_lines=True))
    assert "\x1b[" not in logged(monkeypatch, io.StringIO(), json_lines=False)


def test_an_exception_is_logged_without_the_values_of_variables(monkeypatch: pytest.MonkeyPatch) -> None:
    for stream in (Terminal(), io.StringIO()):
        monkeypatch.setattr(sys, "stderr", stream)
        configure()
        token = "".join(["sec", "ret"])
        try:
            raise KeyError(len(token))
        except KeyError:
            structlog.get_logger().exception("a request failed")
        assert "KeyError: 6" in stream.getvalue()
        assert "secret" not in stream.getvalue()


def test_the_log_level_can_be_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    configure()
    log = structlog.get_logger()
    set_level("error")
    log.warning("not logged")
    set_level("debug")
    log.debug("logged")
    assert [json.loads(line)["event"] for line in stream.getvalue().splitlines()] == ["logged"]


def test_a_failing_stream_is_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    class Gone(io.StringIO):
        def write(self, text: str) -> int:
            raise BrokenPipeError("the terminal was closed")

    assert logged(monkeypatch, Gone()) == ""
    closed = io.StringIO()
    monkeypatch.setattr(sys, "stderr", closed)
    configure()
    closed.close()
    structlog.get_logger().info("to a closed stream")


def test_similar_messages_are_logged_once_per_second_and_listeners_get_all(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stream, delivered, now_s = io.StringIO(), list[str](), 0.0
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(event_log_module, "_now_s", lambda: now_s)
    configure()
    event_log = EventLog()
    event_log.listeners.append(lambda event: delivered.append(event.line))
    for rotation in range(250):
        now_s = rotation * 0.01
        event_log.warning(f"left: its newest frame is {rotation}.5 ms old")
        if rotation == 100:
            event_log.info("something else")
    lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [line["event"] for line in lines] == [
        "left: its newest frame is 0.5 ms old",
        "left: its newest frame is 100.5 ms old",
        "something else",
        "left: its newest frame is 200.5 ms old",
    ]
    assert lines[1]["similar_held_back"] == 99
    assert len(delivered) == 251


def test_faults_are_never_held_back(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    configure()
    event_log = EventLog()
    for _ in range(3):
        event_log.fault("frames_lost", "no frames", "check the cable")
    assert len(stream.getvalue().splitlines()) == 3


def test_the_memory_of_message_kinds_is_bounded() -> None:
    limit = OncePerSecond()
    for number in range(20 * KINDS_MAX):
        kind = "".join(chr(ord("a") + int(digit)) for digit in str(number))
        assert limit.admit(kind, number * 0.1) == 0
    assert len(limit._until_s) <= KINDS_MAX
    assert limit._held_back == {}
