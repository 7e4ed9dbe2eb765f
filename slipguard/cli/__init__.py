"""The command line: `main` turns every expected failure into one line and an exit code."""

from __future__ import annotations

import io
import os
import signal
import sys

from slipguard.cli.interrupt import SAID, Interrupt


def main() -> None:
    """Run the command line. Exit codes: 0 fine, 1 failed or interrupted, 2 misused."""
    interrupt = Interrupt()
    signal.signal(signal.SIGINT, interrupt)
    # A frame's matrices are small. OpenBLAS would wait for its helpers in a busy loop: at real-time priority for ever.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if isinstance(sys.stdout, io.TextIOWrapper):  # None where the shell has closed it
        sys.stdout.reconfigure(errors="replace")  # a terminal without ° must not cost the result
    try:
        from slipguard.cli.app import run

        code = run()
        if sys.stdout is not None:
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader of a pipe has left; what is still buffered has nowhere to go.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    except (Exception, KeyboardInterrupt) as error:
        if not interrupt.noticed and isinstance(error, Exception):
            raise
        print(SAID, file=sys.stderr)
        code = 1
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the interpreter's last steps answer a Ctrl-C with a traceback, too
    sys.exit(code)
