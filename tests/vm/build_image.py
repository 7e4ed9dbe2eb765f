"""Builds the virtual machine in which the DIGIT driver meets a real kernel: `python tests/vm/build_image.py`.

Debian 12 with its own kernel, udev and Python, and the wheels that the driver and its tests need, from apt and pip.
The image lies in a cache folder named by everything it is made of; a second call finds it and is done. The last line
printed is the folder: what SLIPGUARD_VM wants. Needs root (mmdebstrap, file owners) and the packages of `TOOLS`;
`--install` fetches those by apt-get.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from importlib.metadata import version
from pathlib import Path

SUITE = "bookworm"
TOOLS = {
    "qemu-system-x86_64": "qemu-system-x86",
    "mmdebstrap": "mmdebstrap",
    "busybox": "busybox-static",
    "modprobe": "kmod",
    "cpio": "cpio",
    "mke2fs": "e2fsprogs",
    "dpkg-deb": "dpkg",
}
PACKAGES = ("systemd", "udev", "kmod", "mount", "python3-minimal", "libpython3-stdlib", "iproute2")
WHEELS = ("numpy", "opencv-contrib-python-headless", "pydantic", "structlog", "pytest", "pytest-asyncio")
"""All that the driver and its contract suite import; in the versions of this environment."""
BOOT_MODULES = ("virtio_pci", "virtio_blk", "ext4", "crc32c_generic")
MODULES = ("vivid", "uvcvideo", "vhci-hcd", "ftdi_sio", "cdc-acm", "9pnet_virtio", "9p", "virtio_console", "virtio_rng")
PLATFORMS = ("manylinux2014_x86_64", "manylinux_2_17_x86_64", "manylinux_2_27_x86_64", "manylinux_2_28_x86_64")
SPARE_MIB = 64
HERE = Path(__file__).resolve().parent
INITRAMFS_INIT = """#!/bin/sh
mount -t proc proc /proc; mount -t sysfs sys /sys; mount -t devtmpfs dev /dev
for module in $(cat /order); do insmod /modules/$module; done
while [ ! -b /dev/vda ]; do sleep 0.02; done
mount -t ext4 -o ro /dev/vda /root
for there in proc sys dev; do mount --move /$there /root/$there; done
exec switch_root /root /sbin/vm-init
"""


class BuildError(Exception):
    """Why there is no image, in one line."""


def image_folder() -> Path:
    """Where the image of this state of the project belongs, built or not."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "slipguard-vm"
    made_of = [Path(__file__).read_bytes(), (HERE / "guest" / "vm-init").read_bytes()]
    made_of += [f"{name}=={version(name)}".encode() for name in WHEELS]
    return cache / hashlib.sha256(b"\n".join(made_of)).hexdigest()[:16]


def build(folder: Path, work: Path) -> None:
    """Make kernel, initramfs and root file system in `work`, and move them to `folder` when all is there."""
    root = work / "root"
    run(
        *("mmdebstrap", "--quiet", "--variant=minbase", f"--include={','.join(PACKAGES)}", "--format=directory"),
        *("--aptopt=Apt::Install-Recommends false", f"--customize-hook={kernel_download()}", SUITE, str(root)),
    )
    packages = list((root / "kernel").glob("*.deb"))
    if len(packages) != 1:
        raise BuildError(f"one kernel package was expected in {SUITE}, {len(packages)} came")
    run("dpkg-deb", "-x", str(packages[0]), str(work / "kernel"))
    shutil.rmtree(root / "kernel")
    kernel = next((work / "kernel" / "lib" / "modules").iterdir()).name
    run("depmod", "-b", str(work / "kernel"), kernel)
    result = work / "result"
    result.mkdir()
    shutil.copy(work / "kernel" / "boot" / f"vmlinuz-{kernel}", result / "kernel")
    make_initramfs(work, kernel, result / "initramfs")
    furnish(root, work / "kernel", kernel)
    used_mib = int(run("du", "-sm", str(root)).split()[0])
    run("mke2fs", "-q", "-t", "ext4", "-m", "0", "-d", str(root), str(result / "root.ext4"), f"{used_mib + SPARE_MIB}M")
    folder.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    shutil.move(result, folder)


def kernel_download() -> str:
    """Shell command that leaves the suite's newest kernel package in /kernel of the root it is given as $1."""
    newest = "apt-cache depends linux-image-amd64 | sed -n 's/.*Depends: \\(linux-image-6[^ ]*\\).*/\\1/p'"
    return f'mkdir "$1/kernel" && chroot "$1" sh -c \'cd /kernel && apt-get download -q $({escaped(newest)})\''


def escaped(command: str) -> str:
    """`command` for use inside single quotes."""
    return command.replace("'", "'\\''")


def make_initramfs(work: Path, kernel: str, target: Path) -> None:
    """A busybox that loads what it takes to see the disk, and goes on there."""
    tree = work / "initramfs"
    for name in ("bin", "proc", "sys", "dev", "modules", "root"):
        (tree / name).mkdir(parents=True)
    busybox = shutil.which("busybox")
    assert busybox is not None
    shutil.copy(busybox, tree / "bin" / "busybox")
    for applet in ("sh", "mount", "insmod", "switch_root", "sleep", "cat"):
        (tree / "bin" / applet).symlink_to("busybox")
    files = module_files(work / "kernel", kernel, BOOT_MODULES)
    for file in files:
        shutil.copy(file, tree / "modules")
    (tree / "order").write_text(" ".join(file.name for file in files))
    (tree / "init").write_text(INITRAMFS_INIT)
    (tree / "init").chmod(0o755)
    run("sh", "-c", f"cd '{tree}' && find . | cpio -o -H newc --quiet | gzip -1 > '{target}'")


def module_files(base: Path, kernel: str, names: tuple[str, ...]) -> list[Path]:
    """The files of kernel modules and of all they need, in the order in which to load them."""
    found: dict[Path, None] = {}
    for name in names:
        for line in run("modprobe", "-d", str(base), "-S", kernel, "--show-depends", name).splitlines():
            kind, _, path = line.strip().partition(" ")
            if kind == "insmod":
                found[Path(path.split()[0])] = None
    return list(found)


def furnish(root: Path, base: Path, kernel: str) -> None:
    """Put kernel modules, wheels and the first process into the root."""
    for file in module_files(base, kernel, MODULES):
        target = root / "lib" / "modules" / file.relative_to(base / "lib" / "modules")
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, target)
    for name in ("modules.builtin", "modules.builtin.modinfo", "modules.order"):
        shutil.copy(base / "lib" / "modules" / kernel / name, root / "lib" / "modules" / kernel)
    run("depmod", "-b", str(root), kernel)
    run(
        *(sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile"),
        *("--target", str(root / "opt" / "wheels"), "--python-version", "3.11", "--implementation", "cp"),
        *(f"--platform={name}" for name in PLATFORMS),
        *("--only-binary=:all:", *(f"{name}=={version(name)}" for name in WHEELS)),
    )
    (root / "mnt" / "project").mkdir(parents=True)
    shutil.copy(HERE / "guest" / "vm-init", root / "sbin" / "vm-init")
    (root / "sbin" / "vm-init").chmod(0o755)


def run(*command: str) -> str:
    """Run a tool and return what it prints. Raises BuildError with its last words."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ | {"LC_ALL": "C"})
    except FileNotFoundError:
        raise BuildError(f"{command[0]} is not installed") from None
    except subprocess.CalledProcessError as error:
        last = re.sub(r"\s+", " ", (error.stderr or error.stdout).strip())[-400:]
        raise BuildError(f"{command[0]} failed ({error.returncode}): {last}") from None
    return done.stdout


def check_tools(tools: dict[str, str], *, install: bool) -> None:
    """Raise BuildError naming what is missing of `tools` (program: package); fetch it where allowed to."""
    missing = [package for tool, package in tools.items() if shutil.which(tool) is None]
    if missing and install:
        run("apt-get", "update", "-q")
        run("apt-get", "install", "-y", "-q", "--no-install-recommends", *missing)
    elif missing:
        raise BuildError(f"missing: {' '.join(missing)}; apt-get install them, or use --install")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--install", action="store_true", help="apt-get install the tools that are missing")
    options = parser.parse_args()
    folder = image_folder()
    try:
        check_tools(TOOLS, install=options.install)
        if not (folder / "root.ext4").exists():
            if os.geteuid() != 0:
                raise BuildError("root is needed to build the image (sudo, or a container)")
            with tempfile.TemporaryDirectory(prefix="slipguard-vm-") as work:
                os.chmod(work, 0o755)  # apt drops its rights while it downloads
                build(folder, Path(work))
    except (BuildError, OSError) as error:
        print(f"no virtual machine: {error}", file=sys.stderr)
        return 1
    print(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
