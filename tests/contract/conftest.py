"""The contract suites run on the fakes, and on the real drivers against the doubles on the wire.

On real hardware only where it is named: `pytest tests/contract/test_gripper_contract.py --gripper /dev/ttyUSB0`
(`--gripper-object` with something to grip between the jaws), `--arm 192.0.2.10`, `--digit D20479`. What needs a hand
on the cable is left out there. Take everything breakable away: gripper and arm move.
"""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "wire"))
