"""Questions on the terminal: earlier input does not count, and Ctrl-C takes effect at once."""

from __future__ import annotations

import asyncio
import os
import pty
import sys
from pathlib import Path

import pytest

from slipguard.cli.terminal import ask


async def test_neither_enter_nor_earlier_input_confirms(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    person, terminal = pty.openpty()
    with os.fdopen(terminal) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        os.write(person, b"release\n")
        pending = asyncio.create_task(ask("the jaws open", "release"))
        await _quiet(pending)
        os.write(person, b"\n")
        await _quiet(pending)
        os.write(person, b"release\n")
        assert await pending
        going_on = asyncio.create_task(ask("place it", ""))
        await _quiet(going_on)
        os.write(person, b"q\n")
        assert not await going_on
        left = asyncio.create_task(ask("place it", ""))
        await _quiet(left)
        left.cancel()
        with pytest.raises(asyncio.CancelledError):
            await left
    os.close(person)
    assert "type release and Enter" in capsys.readouterr().out


async def test_the_end_of_an_input_file_is_a_no(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "answers").write_text("\nrelease")
    with os.fdopen(os.open(tmp_path / "answers", os.O_RDONLY)) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        assert await ask("place it", "")
        assert await ask("the jaws open", "release")
        assert not await ask("place it", "")


async def _quiet(pending: asyncio.Task[bool]) -> None:
    """The question has had its chance and still waits."""
    for _ in range(20):
        await asyncio.sleep(0.001)
    assert not pending.done()
