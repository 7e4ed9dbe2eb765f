"""The command line: `main` turns every expected failure into one line and an exit code."""

from __future__ import annotations

import os
import sys


def main() -> None:
    """Run the command line. Exit codes: 0 fine, 1 failed, 2 misused."""
    try:
        from slipguard.cli.app import run

        code = run()
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("slipguard: interrupted", file=sys.stderr)
        code = 1
    except BrokenPipeError:
        # The reader of a pipe has left; what is still buffered has nowhere to go.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 1
    sys.exit(code)
