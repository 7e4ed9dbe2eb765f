"""An emulated cell in a process of its own, controlled by a program."""

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
"""A complete log is one line."""


class CellProcess:
    """Runs `slipguard emulate cell --json OPTIONS`. Raises SlipguardError with its last line if it does not start."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.config = folder / "config.toml"
        self._arguments = ["emulate", "cell", "--json", "--folder", str(folder), *options]
        self._process: asyncio.subprocess.Process | None = None

    async def start(self) -> None:
        """Start it and wait until clients can connect."""
        self._process = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "slipguard",
            *self._arguments,
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
            limit=LINE_MAX_BYTES,
            process_group=0,  # a Ctrl-C at the terminal is for the parent, which ends this process
        )
        with contextlib.suppress(OSError):  # it replaces other machines, so it must not inherit the caller's priority
            os.sched_setscheduler(self._process.pid, os.SCHED_OTHER, os.sched_param(0))
        await self._line_with("ready", READY_S)

    async def order(self, line: str) -> str:
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(line.encode() + b"\n")
        return str((await self._line_with("answer", ANSWER_S))["answer"])

    async def stop(self) -> None:
        """End the process. Idempotent."""
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
        last_line = b""
        try:
            async with asyncio.timeout(within_s):
                while line := await self._process.stdout.readline():
                    last_line = line
                    if line.startswith(b"{") and key in (message := json.loads(line)):
                        return dict(message)
        except TimeoutError:
            raise SlipguardError(
                f"no line from the emulated cell within {within_s:g} s; check the load of this machine"
            ) from None
        raise SlipguardError(f"the emulated cell ended: {last_line.decode(errors='replace').strip() or 'no message'}")
