"""`python -m tests.campaigns`: long measurements for the developers of slipguard."""

import sys

from tests.campaigns.command_line import run

sys.exit(run())
