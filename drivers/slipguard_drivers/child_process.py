"""A child process at the end of a packet socket: the home of work that must not stop the loop.

A packet has borders, so no framing is needed; an end of file says that the other side is gone, however it went.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys

PACKET_BYTES = 65536


class ChildProcess:
    """`python -m MODULE SOCKET_FD ARGUMENTS...`, started at once; `link` is this end of its socket, non-blocking.

    keep_fds: further file descriptors that the child inherits, under the same numbers.
    """

    def __init__(self, module: str, *arguments: str, keep_fds: tuple[int, ...] = ()) -> None:
        self.link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self.link.setblocking(False)
            # -P: the working directory of whoever started the daemon is no place to import from.
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, str(theirs.fileno()), *arguments],
                pass_fds=(theirs.fileno(), *keep_fds),
                stdin=subprocess.DEVNULL,
                process_group=0,  # a Ctrl-C at the terminal is for the parent alone
            )
        except BaseException:
            self.link.close()
            raise
        finally:
            theirs.close()

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it still runs."""
        return self._process.poll() is None

    def kill(self) -> None:
        """End it now and forget it. Idempotent. The link must have no reader in the loop any more."""
        self.link.close()
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()
        self._process.wait()  # at once: nothing outlives SIGKILL
