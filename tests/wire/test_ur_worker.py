"""The arm's child process ends when its parent is gone."""

from __future__ import annotations

import json
import socket
import subprocess
import sys

from ur_scene import own_address

HURRIED = "import slipguard_drivers.ur5.motion_worker as worker; worker.CALL_MAX_S = 1; worker.main()"
RTDE_PORT = 30004


def test_a_worker_blocked_by_a_silent_controller_ends_after_its_daemon() -> None:
    with socket.create_server((own_address(91), RTDE_PORT)) as silent:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [sys.executable, "-P", "-c", HURRIED, str(theirs.fileno()), own_address(91)]
        worker = subprocess.Popen(command, pass_fds=(theirs.fileno(),))
        theirs.close()
        ours.send(json.dumps(["connect", 4.0, 2.5, [0.1, 0.2, 0.3], False]).encode())
        silent.settimeout(30.0)
        client, _ = silent.accept()  # it is in the call now
        ours.close()
        try:
            assert worker.wait(30.0) != 0
        finally:
            worker.kill()
            worker.wait()
            client.close()
