"""What a systemd unit may open when the kernel modules of its devices are loaded after its start."""

from __future__ import annotations

import grp
import json
import os
import subprocess
import threading
import time
from pathlib import Path

from plug import modprobe, settle

UNIT = Path("/run/systemd/system/slipguard.service")
SEEN = Path("/var/lib/slipguard/seen.json")
CAMERA, ADAPTER = Path("/dev/video0"), Path("/dev/ttyUSB0")
USB_SERIAL_MAJOR = 188
pause = threading.Event().wait
PROBE = f"""
import errno, json, os, time
while True:
    seen = {{}}
    for node in ("{CAMERA}", "{ADAPTER}"):
        try:
            os.close(os.open(node, os.O_RDWR | os.O_NONBLOCK))
            seen[node] = "opened"
        except OSError as error:
            seen[node] = errno.errorcode[error.errno]
    with open("{SEEN}.new", "w") as file:
        json.dump(seen, file)
    os.replace("{SEEN}.new", "{SEEN}")
    time.sleep(0.1)
"""


def modules_after_the_start(unit: str) -> dict[str, object]:
    """Start the unit with a probe as its program, then load the modules of camera and adapter."""
    before = Path("/proc/devices").read_text()
    subprocess.run(["mount", "-o", "remount,rw", "/"], check=True)
    Path("/run/probe.py").write_text(PROBE)
    replaced = {"ExecStart": "/usr/bin/python3 /run/probe.py", "Type": "exec", "WatchdogSec": "0"}
    lines = [f"{key}={replaced.get(key, value)}" if equals else key for key, equals, value in split(unit)]
    UNIT.write_text("\n".join(lines) + "\n")
    systemctl("daemon-reload")
    systemctl("start", UNIT.name)
    modprobe("vivid", "n_devs=1", "node_types=0x1", "num_inputs=1", "input_types=0x03")
    modprobe("ftdi_sio")
    settle()
    if not ADAPTER.exists():
        os.mknod(ADAPTER, 0o20660, os.makedev(USB_SERIAL_MAJOR, 0))
    os.chown(ADAPTER, 0, grp.getgrnam("dialout").gr_gid)
    os.chmod(ADAPTER, 0o660)
    loaded_at_s = time.time()
    while not SEEN.exists() or SEEN.stat().st_mtime < loaded_at_s + 0.5:
        pause(0.1)
    seen = json.loads(SEEN.read_text())
    return {"camera": seen[str(CAMERA)], "adapter": seen[str(ADAPTER)], "before": before.split()}


def split(unit: str) -> list[tuple[str, str, str]]:
    """Return the lines of a unit as key, equals sign and value, without comments."""
    return [line.partition("=") for line in unit.splitlines() if not line.startswith("#")]


def systemctl(*words: str) -> None:
    """Run systemctl; its error names the unit's."""
    done = subprocess.run(["systemctl", *words], capture_output=True, text=True, check=False)
    if done.returncode:
        status = subprocess.run(["systemctl", "status", UNIT.name], capture_output=True, text=True, check=False)
        raise AssertionError(f"{words}: {done.stderr}\n{status.stdout}")
