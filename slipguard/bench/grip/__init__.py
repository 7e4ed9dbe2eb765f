"""Grip controllers in closed loop with the simulated cell: slipguard, no guard, a fixed step and an oracle."""
