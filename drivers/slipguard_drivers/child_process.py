"""A child process with a packet socket, for work that must not block the event loop.

Packets need no framing. An end of file means that the other side has ended, for any reason.
"""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys

PACKET_BYTES = 65536


class ChildProcess:
    """Runs `python -m MODULE SOCKET_FD ARGUMENTS...`, started at once.

    Attributes:
        link: this end of the socket, non-blocking.
    """

    def __init__(self, module: str, *arguments: str, keep_fds: tuple[int, ...] = ()) -> None:
        """keep_fds: file descriptors that the child inherits under the same numbers."""
        self.link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            self.link.setblocking(False)
            # -P: do not import from the working directory of the daemon.
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", module, str(theirs.fileno()), *arguments],
                pass_fds=(theirs.fileno(), *keep_fds),
                stdin=subprocess.DEVNULL,
                process_group=0,  # a Ctrl-C at the terminal is for the parent only
            )
        except BaseException:
            self.link.close()
            raise
        finally:
            theirs.close()

    @property
    def pid(self) -> int:
        """Return the process id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def kill(self) -> None:
        """End the process. Idempotent. The loop must have no reader on the link any more."""
        self.link.close()
        with contextlib.suppress(ProcessLookupError):
            self._process.kill()
        self._process.wait()  # returns at once after SIGKILL
