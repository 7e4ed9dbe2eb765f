"""A daemon with simulated devices for the page's tests, in a process of its own: `python daemon_process.py CONFIG`.

Words on stdin: `fail DEVICE KIND`, `mend`, `fresh` (another object between the open jaws), `again` (the daemon
restarts on the same world). Each is answered with one line on stdout as soon as it is done, the last one
when the new daemon runs.
"""

from __future__ import annotations

import asyncio
import os
import queue
import signal
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

from slipguard.cli.run import bind_api
from slipguard.config import read_config
from slipguard.daemon import log_setup as log
from slipguard.daemon import run as root
from slipguard.daemon.loop.service import Service
from slipguard.sim.injected_faults import KINDS
from slipguard.sim.scenario import scenario
from slipguard.sim.world import World, WorldSettings

FPS = 20.0
"""A third of a real camera's rate: a browser draws on the same cores."""
LOOK_S = 0.02


class Stage:
    """A simulated world, and the daemon that runs in it, with restarts."""

    def __init__(self, config: Path) -> None:
        self.config = read_config(config, sim=True)
        self.world = World(WorldSettings(step_s=2e-3), seed=3)
        self.words: queue.Queue[str] = queue.Queue()
        self.again = True
        self.started = False

    def place(self) -> None:
        """Place a wrench that slips at the first grip; the cameras are slow, to save computing time."""
        drawn = scenario("wrench", 1)
        left, right = replace(drawn.left, fps=FPS), replace(drawn.right, fps=FPS)
        self.world.clear(time.monotonic())
        self.world.place(replace(drawn, left=left, right=right), time.monotonic())

    def obey(self, line: str) -> None:
        """One word."""
        match line.split():
            case ["fail", device, kind]:
                self.world.faults.fail(device, kind)
            case ["mend"]:
                for device in KINDS:
                    self.world.faults.repair(device)
            case ["fresh"]:
                self.place()
            case ["again"]:
                self.again = True
                os.kill(os.getpid(), signal.SIGTERM)
                return
            case _:
                raise ValueError(line)
        print("done", flush=True)

    async def listen(self, service: Service) -> None:
        """Execute commands while the daemon runs."""
        if self.started:
            print("done", flush=True)
        self.started = True
        while True:
            while not self.words.empty() and not self.again:
                self.obey(self.words.get())
            await asyncio.sleep(LOOK_S)

    def read(self) -> None:
        """Read commands from stdin, in a thread."""
        for line in sys.stdin:
            self.words.put(line)

    def run(self) -> None:
        """Run until a SIGTERM without a restart command."""
        threading.Thread(target=self.read, daemon=True).start()
        self.place()
        while self.again:
            self.again = False
            asyncio.run(root.run(self.config, bind_api, world=self.world, extra_task=self.listen))


if __name__ == "__main__":
    log.configure(json_lines=True)
    Stage(Path(sys.argv[1])).run()
