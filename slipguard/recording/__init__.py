"""Recordings: what the guard saw and did, as MCAP files that Foxglove shows and `slipguard replay` plays again."""
