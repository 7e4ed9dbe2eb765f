"""Long measurements that only the developers of slipguard run: `python -m tests.campaigns --help`."""
