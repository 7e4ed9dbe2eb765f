"""`python -m tests.campaigns`: long measurements that only the developers of slipguard run."""

import sys

from tests.campaigns.command_line import run

sys.exit(run())
