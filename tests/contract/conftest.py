"""The contract suites run on the simulated devices and on the real drivers connected to emulators.

They run on real hardware only if it is named: `--gripper /dev/ttyUSB0` (with `--gripper-object` while an object lies
between its jaws), `--arm 192.0.2.10`, `--digit D20479`; for other drivers see drivers/README.md. Tests that need a
fault are left out there. Remove everything breakable: gripper and arm move.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "wire"))
