"""Recordings: what the guard observed and did, as MCAP files for Foxglove and `slipguard replay`."""
