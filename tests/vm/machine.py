"""Boots the test machine and talks to it: scenes are played inside, their results come back."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PROJECT = Path(__file__).resolve().parents[2]
BOOT_S = 120.0
CONNECT_S = 10.0
MEMORY_MIB = 1024
CORES = 2
PRIORITY = -10
"""Where root starts it: what other programs of this machine do is no part of what is measured inside."""


class Machine:
    """One running QEMU.

    accelerator: "kvm", "tcg", or None for the faster one that works here.
    """

    def __init__(self, image: Path, accelerator: str | None = None) -> None:
        self.accelerator = accelerator or ("kvm" if kvm_works() else "tcg")
        self._folder = Path(tempfile.mkdtemp(prefix="slipguard-vm-"))
        self.console = self._folder / "console"
        begun_s = time.monotonic()
        listening = socket.socket(socket.AF_UNIX)
        listening.bind(str(self._folder / "agent"))
        listening.listen(1)
        self._qemu = subprocess.Popen(
            self._command(image), stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True
        )
        prefer(self._qemu.pid)
        listening.settimeout(CONNECT_S)
        try:
            self._agent, _ = listening.accept()
            self._lines = self._agent.makefile("rb")
            self.kernel = self._read(BOOT_S)["ready"]
        except TimeoutError:
            self._qemu.kill()
            raise AssertionError(f"QEMU does not start: {self._qemu.communicate()[1].decode()[-500:]}") from None
        except BaseException:
            self.stop()
            raise
        finally:
            listening.close()
        self.boot_s = time.monotonic() - begun_s

    def play(self, scene: str, limit_s: float = 60.0, **arguments: object) -> Any:
        """Play `module:function` of `tests/vm/guest` inside and return what it returns. Raises AssertionError."""
        order = {"scene": scene, "arguments": arguments, "limit_s": limit_s}
        self._agent.sendall(json.dumps(order).encode() + b"\n")
        answer = self._read(limit_s + 30.0)
        if "failed" in answer:
            raise AssertionError(f"{scene} failed in the test machine:\n{answer['failed']}")
        return answer["returned"]

    @contextlib.contextmanager
    def undisturbed(self) -> Iterator[None]:
        """Nothing else of this host runs before the machine, where that is allowed: for what is timed, and briefly."""
        self._schedule(os.SCHED_RR, first=2, others=1)  # first: its timers must not wait for its processors
        try:
            yield
        finally:
            self._schedule(os.SCHED_OTHER, first=0, others=0)

    def stop(self) -> None:
        """End the machine; its image was never changed."""
        self._qemu.kill()
        self._qemu.wait()
        if self._qemu.stderr is not None:
            self._qemu.stderr.close()
        for end in (getattr(self, "_lines", None), getattr(self, "_agent", None)):
            if end is not None:
                end.close()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _read(self, limit_s: float) -> dict[str, Any]:
        self._agent.settimeout(limit_s)
        try:
            line = self._lines.readline()
        except OSError:  # also when an earlier answer has not come
            line = b""
        if not line:
            raise AssertionError(f"no answer from the test machine within {limit_s:g} s; {self._last_lines()}")
        return dict(json.loads(line))

    def _schedule(self, policy: int, first: int, others: int) -> None:
        """Priority of QEMU's first thread, which keeps its clocks, and of all others."""
        for thread in (int(one.name) for one in Path(f"/proc/{self._qemu.pid}/task").iterdir()):
            with contextlib.suppress(OSError):
                os.sched_setscheduler(thread, policy, os.sched_param(first if thread == self._qemu.pid else others))

    def _last_lines(self) -> str:
        """What QEMU and the machine's console say."""
        console = self.console.read_text(errors="replace") if self.console.exists() else ""
        if self._qemu.poll() is None:
            return f"its console:\n{console[-4000:]}"
        stderr = self._qemu.stderr.read().decode(errors="replace") if self._qemu.stderr else ""
        return f"QEMU ended ({self._qemu.returncode}): {stderr}{console[-4000:]}"

    def _command(self, image: Path) -> list[str]:
        tcg = ["-accel", "tcg,thread=multi,tb-size=512", "-cpu", "Nehalem"]  # AVX is slow where it is emulated
        accelerator = ["-accel", "kvm", "-cpu", "host"] if self.accelerator == "kvm" else tcg
        share = f"local,path={PROJECT},mount_tag=project,security_model=none,readonly=on"
        return [
            *("qemu-system-x86_64", "-machine", "q35", *accelerator, "-smp", str(CORES), "-m", str(MEMORY_MIB)),
            *("-kernel", str(image / "kernel"), "-initrd", str(image / "initramfs")),
            *("-append", "console=ttyS0 quiet mitigations=off panic=1"),
            *("-drive", f"file={image / 'root.ext4'},if=virtio,format=raw,snapshot=on"),
            *("-virtfs", share, "-device", "virtio-rng-pci"),
            *("-device", "virtio-serial-pci", "-chardev", f"socket,id=agent,path={self._folder / 'agent'}"),
            *("-device", "virtserialport,chardev=agent,name=slipguard"),
            *("-nodefaults", "-nographic", "-no-reboot", "-serial", f"file:{self.console}"),
        ]


def prefer(pid: int) -> None:
    """Have the scheduler prefer a process that leads a session of its own, where that is allowed."""
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, PRIORITY)
        Path(f"/proc/{pid}/autogroup").write_text(str(PRIORITY))


def kvm_works() -> bool:
    """Whether the processor has virtualisation and this user may use it.

    Where only the device node is there, as on some virtual machines, a guest hangs at its first instructions.
    """
    flags = Path("/proc/cpuinfo").read_text().split()
    if "svm" not in flags and "vmx" not in flags:
        return False
    try:
        os.close(os.open("/dev/kvm", os.O_RDWR))
    except OSError:
        return False
    return True
