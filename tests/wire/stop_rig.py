"""An emulated cell that holds an object firmly, lifts of it, and the time at which its arm came to rest."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from cell_rig import Cell, cell, daemon, patiently, wait_for

from slipguard.daemon.api.client import Client
from slipguard.daemon.api.requests import CalibrateRequest, GraspRequest, LiftRequest, LowerRequest
from slipguard.daemon.store.state_dir import StateDir

WITHIN_S = 0.06
"""From a stop request to the arm's rest; at the default 50 mm/s, braking alone takes 20 ms."""


@dataclass(frozen=True, slots=True)
class StopRig:
    """A cell and its daemon. client: on the Unix socket. url, token: of the daemon's TCP port."""

    cell: Cell
    client: Client
    url: str
    token: str

    def lift(self) -> None:
        """Begin a lift at the default speed, and wait until it is beyond its slow part."""
        patiently(lambda: self.client.submit(LiftRequest(height_mm=60.0, speed_mm_s=50.0)))
        wait_for(self.client, lambda state: state["phase"] == "lifting" and state["lifted_mm"] > 20.0, "no lift")

    def rested_s(self) -> float:
        """Check that a stop has ended the lift; return when the arm came to rest, on the monotonic clock."""
        state = wait_for(self.client, lambda state: not state["arm"]["moving"], "it still moves")
        assert (state["phase"], state["stopped_by_request"]) == ("holding", True)
        assert state["lifted_mm"] < 55.0
        events = map(json.loads, self.cell.order("arm log 20").splitlines())
        return max(float(event["at_s"]) for event in events if event["event"] == "stands")

    def lower(self) -> None:
        """Go back to where the lift began."""
        patiently(lambda: self.client.submit(LowerRequest()))
        wait_for(self.client, lambda state: state["phase"] == "holding" and state["lifted_mm"] < 1.0, "still up")


@contextmanager
def stop_rig(folder: Path, host: str) -> Iterator[StopRig]:
    """Provide one with the object gripped."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        listen = f"127.0.0.1:{free.getsockname()[1]}"
    with cell(folder, host, "--object", "bar", "--seed", 3, "--fps", 30) as made:
        made.config.write_text(made.config.read_text().replace("[api]\n", f'[api]\nlisten = "{listen}"\n'))
        with daemon(made) as client:
            patiently(lambda: client.submit(CalibrateRequest()))
            patiently(lambda: client.submit(GraspRequest(force_n=120.0)))
            wait_for(client, lambda state: state["phase"] == "holding" and not state["gripper"]["moving"], "no grip")
            token = (StateDir(made.folder / "state").runtime_path / "token").read_text().strip()
            yield StopRig(made, client, f"http://{listen}", token)
