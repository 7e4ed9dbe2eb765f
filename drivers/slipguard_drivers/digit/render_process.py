"""The drawing process: `python -m slipguard_drivers.digit.render_process SOCKET_FD MEMORY_FD UNIT_SEED`.

It stands back before anything else, for the imports alone take half a second.
"""

from __future__ import annotations

import signal
import sys

from slipguard.thread_priority import set_batch_priority

NICENESS = 10


def main() -> None:
    """Stay out of the loop's way: nice, and deaf to its Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    set_batch_priority(NICENESS)
    from slipguard_drivers.digit.render_worker import serve_to_the_end

    serve_to_the_end(*(int(text) for text in sys.argv[1:4]))


if __name__ == "__main__":
    main()
