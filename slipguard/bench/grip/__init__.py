"""Grip controllers in closed loop with the simulated cell: slipguard, baselines, and two bounds of what is possible."""
