"""The web process: `python -m slipguard.web SOCKET_FD`, started and stopped by the daemon."""

from __future__ import annotations

import signal
import sys

from slipguard.thread_priority import set_batch_priority

NICENESS = 5
"""The control loop has priority if there are too few cores."""


def main() -> None:
    """Serve until the daemon stops the process. Ctrl-C is ignored: it is handled by the daemon."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_batch_priority(NICENESS)  # before the imports, which take most of a second
    from slipguard.web.process import serve_and_exit

    serve_and_exit(int(sys.argv[1]))


if __name__ == "__main__":
    main()
