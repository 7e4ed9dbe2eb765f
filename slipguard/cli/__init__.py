"""The command line. `main` turns every expected failure into one line and an exit code."""

from __future__ import annotations

import io
import os
import signal
import sys

from slipguard.cli.interrupt import INTERRUPTED, InterruptHandler


def main() -> None:
    """Run the command line. Exit codes: 0 success, 1 failed or interrupted, 2 wrong usage."""
    handler = InterruptHandler()
    signal.signal(signal.SIGINT, handler)
    # The matrices of a frame are small. OpenBLAS threads would wait in a busy loop, forever at real-time priority.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if isinstance(sys.stdout, io.TextIOWrapper):  # None if the shell has closed it
        sys.stdout.reconfigure(errors="replace")  # a terminal without ° still shows the rest
    try:
        from slipguard.cli.app import run

        code = run()
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader of the pipe has exited: discard what is still buffered.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    except (Exception, KeyboardInterrupt) as error:
        if not handler.interrupted and isinstance(error, Exception):
            raise
        print(INTERRUPTED, file=sys.stderr)
        code = 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C while the interpreter exits would print a traceback
    sys.exit(code)
