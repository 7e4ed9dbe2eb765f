"""The daemon's log: JSON for programs, one line per second of each kind, and it never delays the guard."""

from __future__ import annotations

import contextlib
import io
import json
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import structlog

from slipguard.daemon import log_setup
from slipguard.daemon.journal import VALUE_MAX, JournalOutput
from slipguard.daemon.log_setup import configure, flush, set_level
from slipguard.daemon.loop import event_log as event_log_module
from slipguard.daemon.loop.event_log import KINDS_MAX, Event, EventLog, RepetitionLimit


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
    assert flush(30.0)
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
        assert flush(30.0)
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
    assert flush(30.0)
    assert [json.loads(line)["event"] for line in stream.getvalue().splitlines()] == ["logged"]


def test_similar_messages_are_logged_at_most_once_a_minute_and_steps_of_a_grasp_once_per_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stream, delivered, now_s = io.StringIO(), list[str](), 0.0
    monkeypatch.setattr(sys, "stderr", stream)
    monkeypatch.setattr(event_log_module, "_now_s", lambda: now_s)
    configure()
    event_log = EventLog()
    event_log.listeners.append(lambda event: delivered.append(event.line))
    for cycle in range(1300):
        now_s = cycle * 0.1
        event_log.warning(f"left: its newest frame is {cycle}.5 ms old", "device")
        if cycle < 15:
            event_log.info(f"slip of {cycle}°: tightening", "slip")
    assert flush(30.0)
    lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert [line["event"] for line in lines] == [
        "left: its newest frame is 0.5 ms old",
        "slip of 0°: tightening",
        "slip of 10°: tightening",
        "left: its newest frame is 600.5 ms old",
        "left: its newest frame is 1200.5 ms old",
    ]
    assert lines[3]["similar_held_back"] == 599
    assert len(delivered) == 1315
    assert event_log.last_slip is not None
    assert event_log.last_slip.text == "slip of 14°: tightening"


def test_faults_are_never_held_back(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)
    configure()
    event_log = EventLog()
    for _ in range(3):
        event_log.fault("frames_lost", "no frames", "check the cable")
    assert flush(30.0)
    assert len(stream.getvalue().splitlines()) == 3


def test_the_memory_of_message_kinds_is_bounded() -> None:
    limit = RepetitionLimit()
    for number in range(20 * KINDS_MAX):
        kind = "".join(chr(ord("a") + int(digit)) for digit in str(number))
        assert limit.admit(Event(number * 0.1, "info", kind)) == 0
    assert len(limit._until_s) <= KINDS_MAX
    assert limit._held_back == {}


def read_entry(datagram: bytes) -> dict[str, str]:
    """Return the fields of an entry as systemd's journal reads them."""
    fields, rest = {}, datagram
    while rest:
        line, _, rest = rest.partition(b"\n")
        name, equals, value = line.partition(b"=")
        if not equals:
            length = int.from_bytes(rest[:8], "little")
            value, rest = rest[8 : 8 + length], rest[9 + length :]
        fields[name.decode()] = value.decode()
    return fields


@pytest.fixture
def journal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[[], list[dict[str, str]]]]:
    """The log goes to a journal of this test; returns its new entries."""
    address, stream = str(tmp_path / "journal"), tmp_path / "stderr"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as receiver, stream.open("w") as stderr:
        receiver.bind(address)
        receiver.setblocking(False)
        monkeypatch.setattr(sys, "stderr", stderr)
        monkeypatch.setenv("JOURNAL_STREAM", f"{stream.stat().st_dev}:{stream.stat().st_ino}")
        monkeypatch.setattr(log_setup, "JournalOutput", lambda: JournalOutput(address))
        configure()

        def entries() -> list[dict[str, str]]:
            found = []
            assert flush(30.0)
            with contextlib.suppress(BlockingIOError):
                while True:
                    found.append(read_entry(receiver.recv(1 << 20)))
            return found

        yield entries
        assert stream.read_text() == "", "nothing is written twice"


def test_the_journal_gets_priorities_text_and_fields(journal: Callable[[], list[dict[str, str]]]) -> None:
    log = structlog.get_logger()
    set_level("debug")
    for level in ("debug", "info", "warning", "error", "critical"):
        getattr(log, level)("the grip slips", rotation_deg=3.5, tasks=["left", "right"])
    entries = journal()
    assert [entry["PRIORITY"] for entry in entries] == ["7", "6", "4", "3", "2"]
    assert entries[0] == {
        "PRIORITY": "7",
        "SYSLOG_IDENTIFIER": "slipguard",
        "SLIPGUARD_ROTATION_DEG": "3.5",
        "SLIPGUARD_TASKS": '["left", "right"]',
        "SLIPGUARD_EVENT": "the grip slips",
        "MESSAGE": "the grip slips rotation_deg=3.5 tasks=['left', 'right']",
    }


def test_the_journal_gets_faults_and_tracebacks_as_one_entry(journal: Callable[[], list[dict[str, str]]]) -> None:
    EventLog().fault("frames_lost", "no frames for 0.3 s", "check the cable")
    (fault,) = journal()
    assert (fault["PRIORITY"], fault["SLIPGUARD_CODE"]) == ("3", "frames_lost")
    assert "no frames for 0.3 s" in fault["MESSAGE"]
    try:
        raise KeyError("x" * 40_000)
    except KeyError:
        structlog.get_logger().exception("a request\nfailed")
    (entry,) = journal()
    assert entry["MESSAGE"].startswith("a request\nfailed\nTraceback")
    assert len(entry["MESSAGE"]) == VALUE_MAX


def test_a_journal_stream_of_another_program_is_not_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JOURNAL_STREAM", "8:12345")
    assert json.loads(logged(monkeypatch, io.StringIO()))["level"] == "warning"
