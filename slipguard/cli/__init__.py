"""The command line: `main` turns every expected failure into one line and an exit code."""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType

INTERRUPTED = b"slipguard: interrupted\n"


def main() -> None:
    """Run the command line. Exit codes: 0 fine, 1 failed or interrupted, 2 misused."""
    # Libraries half imported answer a Ctrl-C with tracebacks of their own, and there is nothing to clean up yet.
    before = signal.signal(signal.SIGINT, _leave)
    try:
        from slipguard.cli.app import run

        signal.signal(signal.SIGINT, before)
        code = run()
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("slipguard: interrupted", file=sys.stderr)
        code = 1
    except BrokenPipeError:
        # The reader of a pipe has left; what is still buffered has nowhere to go.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the interpreter's last steps answer a Ctrl-C with a traceback, too
    sys.exit(code)


def _leave(number: int, frame: FrameType | None) -> None:
    os.write(2, INTERRUPTED)
    os._exit(1)
