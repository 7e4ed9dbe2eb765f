"""Builds the Debian 12 in which the service is tried: `python tests/service/build_root.py`.

systemd, udev and Python from apt, and a virtual environment with everything slipguard needs but slipguard itself. It
lies in a cache folder named by what it is made of; a second call finds it and is done. The last line printed is the
folder: what SLIPGUARD_SERVICE wants. Needs root, and the packages of `TOOLS`; `--install` fetches those by apt-get.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import shutil
import sys
import tempfile
import tomllib
from importlib.metadata import version
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "vm"))

from build_image import PLATFORMS, SUITE, BuildError, check_tools, run

TOOLS = {"mmdebstrap": "mmdebstrap", "systemd-nspawn": "systemd-container"}
PACKAGES = ("systemd", "systemd-sysv", "udev", "procps", "python3", "python3-venv")
PREFIX = "opt/slipguard"
PROJECT = Path(__file__).resolve().parents[2]


def root_folder() -> Path:
    """Where the root of this state of the project belongs, built or not."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "slipguard-service"
    made_of = [Path(__file__).read_text(), *wheels()]
    return cache / hashlib.sha256("\n".join(made_of).encode()).hexdigest()[:16]


def wheels() -> list[str]:
    """What slipguard depends on, in the versions of this environment."""
    project = tomllib.loads((PROJECT / "pyproject.toml").read_text())["project"]
    return [f"{name}=={version(name)}" for name in (re.split(r"[<>=\[;]", one)[0] for one in project["dependencies"])]


def build(folder: Path, work: Path) -> None:
    """Make the root in `work`, and move it to `folder` when all is there."""
    root = work / "root"
    run(
        *("mmdebstrap", "--quiet", "--variant=minbase", f"--include={','.join(PACKAGES)}", "--format=directory"),
        *("--aptopt=Apt::Install-Recommends false", SUITE, str(root)),
    )
    run("chroot", str(root), "python3", "-m", "venv", f"/{PREFIX}")
    run(
        *(sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile"),
        *("--target", str(next((root / PREFIX / "lib").glob("python3*")) / "site-packages"), "--upgrade"),
        *("--python-version", "3.11", "--implementation", "cp", "--only-binary=:all:"),
        *(f"--platform={name}" for name in PLATFORMS),
        *wheels(),
    )
    run("chroot", str(root), f"/{PREFIX}/bin/python", "-m", "compileall", "-q", f"/{PREFIX}/lib")
    (root / "etc" / "machine-id").unlink(missing_ok=True)  # each start a machine of its own
    folder.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    run("mv", str(root), str(folder))  # owners and modes as they are, across file systems too


def try_out(root: Path) -> None:
    """Raise BuildError where containers cannot be started: in most containers they cannot."""
    words = ("--quiet", "--register=no", "--keep-unit", "--private-network", "--volatile=overlay")
    run("systemd-nspawn", *words, f"--directory={root}", "/bin/true")


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--install", action="store_true", help="apt-get install the tools that are missing")
    options = parser.parse_args()
    folder = root_folder()
    try:
        check_tools(TOOLS, install=options.install)
        if not folder.exists():
            if os.geteuid() != 0:
                raise BuildError("root is needed to build it (sudo, or a container)")
            with tempfile.TemporaryDirectory(prefix="slipguard-service-") as work:
                os.chmod(work, 0o755)  # apt drops its rights while it downloads
                build(folder, Path(work))
        try_out(folder)
    except (BuildError, OSError) as error:
        print(f"no place to try the service: {error}", file=sys.stderr)
        return 1
    print(folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())
