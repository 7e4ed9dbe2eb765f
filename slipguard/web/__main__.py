"""The web process: `python -m slipguard.web SOCKET_FD`, started by the daemon and ended with it.

It stands back before anything else, for the imports alone take most of a second.
"""

from __future__ import annotations

import signal
import sys

from slipguard.thread_priority import set_batch_priority

NICENESS = 5
"""The loop comes first where there are too few cores."""


def main() -> None:
    """Deaf to the terminal's Ctrl-C: the daemon says when to stop."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_batch_priority(NICENESS)
    from slipguard.web.process import serve_and_exit

    serve_and_exit(int(sys.argv[1]))


if __name__ == "__main__":
    main()
