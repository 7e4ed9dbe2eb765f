"""An emulated cell in a process of its own, for whoever drives it from a program."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import sys
from pathlib import Path
from typing import Any

from slipguard.errors import SlipguardError

READY_S = 30.0
ANSWER_S = 10.0
LINE_MAX_BYTES = 64 * 1024 * 1024
"""A whole log comes as one line."""


class CellProcess:
    """`slipguard emulate cell --json OPTIONS`. Raises SlipguardError with its last words where it does not start."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.config = folder / "config.toml"
        self._words = ["emulate", "cell", "--json", "--folder", str(folder), *options]
        self._process: asyncio.subprocess.Process | None = None

    async def start(self) -> None:
        """Until it can be connected to."""
        self._process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "slipguard",
            *self._words,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            limit=LINE_MAX_BYTES,
            process_group=0,  # a Ctrl-C at the terminal is for the parent, which ends it
        )
        with contextlib.suppress(OSError):  # it stands for other machines: none of the caller's priority is for it
            os.sched_setscheduler(self._process.pid, os.SCHED_OTHER, os.sched_param(0))
        await self._line_with("ready", READY_S)

    async def order(self, words: str) -> str:
        """A control word and its answer."""
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(words.encode() + b"\n")
        return str((await self._line_with("answer", ANSWER_S))["answer"])

    async def stop(self) -> None:
        """End it. Idempotent."""
        process, self._process = self._process, None
        if process is None:
            return
        with contextlib.suppress(ProcessLookupError):
            process.terminate()
        try:
            async with asyncio.timeout(ANSWER_S):
                await process.communicate()
        except TimeoutError:
            process.kill()
            await process.communicate()

    async def _line_with(self, key: str, within_s: float) -> dict[str, Any]:
        assert self._process is not None
        assert self._process.stdout is not None
        said = b""
        try:
            async with asyncio.timeout(within_s):
                while line := await self._process.stdout.readline():
                    said = line
                    if line.startswith(b"{") and key in (answer := json.loads(line)):
                        return dict(answer)
        except TimeoutError:
            raise SlipguardError(f"the emulated cell said nothing for {within_s:g} s") from None
        raise SlipguardError(f"the emulated cell ended: {said.decode(errors='replace').strip() or 'without a word'}")
